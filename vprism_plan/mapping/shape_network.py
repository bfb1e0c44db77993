# SPDX-License-Identifier: BSD-3-Clause
"""A guess of the hidden side of every object: a crop of space in, two log-odds a voxel out.

A crop is a cube of 32 voxels around one object, its floor on the support surface, turned
so that the camera looks along +x: "behind" is the same direction in every crop. What the
views say of each voxel's centre goes through a small 3D U-Net (Cicek et al., MICCAI 2016),
which answers with the log-odds of "this object" and of "anything at all". All lengths are
counted in voxels, so that large objects are seen as small ones are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from scipy.ndimage import map_coordinates
from scipy.special import expit
from torch import Tensor, nn
from torch.nn import functional

from vprism_plan._files import reading
from vprism_plan._resources import data_path
from vprism_plan.errors import MapError
from vprism_plan.mapping.factors import run_per_class
from vprism_plan.mapping.prior import FLAT_OCCUPANCY, SIDE, Crop, Guess, object_crops
from vprism_plan.perception.camera import invert_transform, transform_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

CHANNELS = 10
_NEAR, _FAR = 4.0, 20.0  # voxels at which ways to the seen surface are cut off
_WIDTHS = (12, 32, 64, 96)


def crop_features(
    crop: Crop,
    views: Sequence[Observation],
    object_id: int,
    clouds: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> Float[np.ndarray, "c x y z"]:
    """Return what labelled views say of a crop's voxels, float32 within [-1, 1].

    Channels: signed way along the ray to the seen surface (positive in front of it; cut off
    at 4 voxels), way behind it (at 20), whether the pixel is labelled as this object, as
    another one, has a depth; height above the support surface; seen points of this object
    and of others in the voxel; edge of a voxel; whether any view looks there. Of several
    views, the one that sees farthest through a voxel speaks for it. `clouds` are what
    `Observation.points` says of the views, for who asks of many crops.
    """
    clouds = [view.points() for view in views] if clouds is None else clouds
    centers = crop.centers()
    best = np.full(len(centers), -np.inf)
    said = np.zeros((4, len(centers)), dtype=np.float32)  # own, other, depth, looked at
    counts = np.zeros((2, SIDE, SIDE, SIDE), dtype=np.float32)
    for view, (cloud, owner) in zip(views, clouds, strict=True):
        labels = view.labels
        assert labels is not None
        height, width = view.depth.shape
        T_camera_world = invert_transform(view.pose)
        local = transform_points(T_camera_world, centers)
        z = np.maximum(local[:, 2], 1e-6)
        column = np.rint(view.intrinsics[0, 0] * local[:, 0] / z + view.intrinsics[0, 2])
        row = np.rint(view.intrinsics[1, 1] * local[:, 1] / z + view.intrinsics[1, 2])
        inside = (local[:, 2] > 0.0) & (column >= 0) & (column < width)
        inside &= (row >= 0) & (row < height)
        r = np.where(inside, row, 0).astype(np.int64)
        c = np.where(inside, column, 0).astype(np.int64)
        depth, label = view.depth[r, c], labels[r, c]
        free = view.free_depth[r, c]
        # Beyond what is still known to be free, the label is of what was there before.
        valid = inside & (depth > 0.0) & ((free == depth) | (free > local[:, 2]))
        way = (free - local[:, 2]) * np.linalg.norm(local, axis=1) / z / crop.voxel
        # A ray without a return says nothing of the way: worse than any view that has one.
        way = np.where(valid, way, np.where(inside, -1e6, -np.inf))
        wins = way > best
        best = np.where(wins, way, best)
        spoken = np.stack([label == object_id, (label > 0) & (label != object_id), valid, inside])
        said[:, wins] = (spoken & inside)[:, wins]
        at = np.rint(crop.to_voxels(cloud[owner > 0])).astype(np.int64)
        owned = owner[owner > 0]
        held = ((at >= 0) & (at < SIDE)).all(axis=1)
        np.add.at(counts, (np.where(owned[held] == object_id, 0, 1), *at[held].T), 1.0)
    known = said[2] > 0.0
    up = ((np.arange(SIDE) + 0.5) * crop.voxel + crop.floor) / (SIDE * crop.voxel)
    shape = (SIDE, SIDE, SIDE)
    channels = [
        np.where(known, np.clip(best / _NEAR, -1.0, 1.0), 0.0).reshape(shape),
        np.where(known, np.clip(-best / _FAR, 0.0, 1.0), 0.0).reshape(shape),
        *said[:3].reshape(3, *shape),
        np.broadcast_to(np.clip(up, -1.0, 1.0), shape),
        *np.minimum(counts / 4.0, 1.0),
        np.full(shape, min(crop.voxel / 0.02, 1.0)),
        said[3].reshape(shape),
    ]
    return np.stack(channels).astype(np.float32)


def _layer(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, 3, padding=1, bias=False), nn.GroupNorm(4, outputs), nn.SiLU()
    )


class ShapeNetwork(nn.Module):
    """The U-Net: crops (N, C, 32, 32, 32) to log-odds (N, 2, 32, 32, 32)."""

    def __init__(self) -> None:
        super().__init__()
        first, *rest = _WIDTHS
        self.down = nn.ModuleList([_layer(CHANNELS, first)])
        for fine, coarse in zip(_WIDTHS, rest, strict=False):
            self.down.append(nn.Sequential(_layer(fine, coarse), _layer(coarse, coarse)))
        self.up = nn.ModuleList(
            _layer(fine + coarse, fine)
            for fine, coarse in reversed(list(zip(_WIDTHS, rest, strict=False)))
        )
        self.head = nn.Conv3d(first, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return log-odds of this object, and of anything."""
        passed = []
        for level, block in enumerate(self.down):
            x = block(functional.max_pool3d(x, 2) if level else x)
            passed.append(x)
        for block, beside in zip(self.up, reversed(passed[:-1]), strict=True):
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0), beside], dim=1))
        return self.head(x)


@dataclass(frozen=True, eq=False)
class NetworkGuess:
    """What the network thinks of one scene.

    Attributes:
        crops: one per object.
        log_odds: (C, 2, 32, 32, 32): this object, anything at all.
    """

    crops: tuple[Crop, ...]
    log_odds: Float[np.ndarray, "c 2 x y z"]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return P(class) at points (m, world)."""
        own = np.zeros((len(points), len(self.crops)))
        anything, weight = np.zeros(len(points)), np.zeros(len(points))
        low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
        for k, (crop, grids) in enumerate(zip(self.crops, self.log_odds, strict=True)):
            middle = transform_points(crop.T_world_crop, np.full((1, 3), 0.5 * SIDE * crop.voxel))
            if np.linalg.norm(middle - middle.clip(low, high)) > SIDE * crop.voxel:
                continue  # farther than its corners: who asks of one crop pays for few others
            at = crop.to_voxels(points)
            rows = np.flatnonzero(((at >= 0.0) & (at <= SIDE - 1.0)).all(axis=1))
            where = at[rows].T
            own[rows, k], other = (
                expit(map_coordinates(grid, where, order=1, mode="nearest")) for grid in grids
            )
            # The nearer to the middle of a crop, the more its network saw around a voxel.
            trust = 0.01 + (0.5 * SIDE - np.abs(at[rows] - 0.5 * (SIDE - 1)).max(axis=1)) ** 2
            anything[rows] += trust * other
            weight[rows] += trust
        covered = weight > 0.0
        anything = np.where(covered, anything / np.maximum(weight, 1e-12), FLAT_OCCUPANCY)
        together = own.sum(axis=1)
        occupied = np.clip(np.maximum(anything, together), 1e-6, 1.0 - 1e-6)
        # What is no object of its own is some object's: the likeliest ones take the rest.
        share = (own + 1e-4) / (together + 1e-4 * own.shape[1])[:, None]
        return np.column_stack([1.0 - occupied, occupied[:, None] * share])


class ShapePrior:
    """The package's own prior: a network that was shown generated scenes (`docs/stages/map.md`).

    Args:
        weights: a safetensors file of a `ShapeNetwork`; the package's own by default.
        device: where the network runs.

    Attributes:
        network: the one that was read.

    Raises:
        MapError: the file holds no such network.
    """

    def __init__(self, weights: str | Path | None = None, device: str = "cpu") -> None:
        path = data_path("shape_prior.safetensors") if weights is None else Path(weights)
        self.network = ShapeNetwork()
        with reading(path, "the weights of a shape prior", MapError):
            state = {name: value.float() for name, value in load_file(path).items()}
            self.network.load_state_dict(state)
        self.network.eval().to(device)
        self._device = device

    def __call__(
        self, views: Sequence[Observation], object_ids: tuple[int, ...], plane: Plane
    ) -> Guess:
        """Return what the network thinks of every object; the same views give the same bits."""
        crops = object_crops(views, object_ids, plane)
        clouds = [view.points() for view in views]
        # Always two at a time, the last one with itself: a batch's bits may depend on its size, and
        # torch leaves batches of one, of so few channels, to convolutions of a quarter the speed.
        pairs = -(-len(crops) // 2)
        found = np.empty((2 * pairs, 2, SIDE, SIDE, SIDE))

        def ask(pair: int) -> None:
            features = [
                crop_features(crops[k], views, object_ids[k], clouds)
                for k in (2 * pair, min(2 * pair + 1, len(crops) - 1))
            ]
            x = torch.from_numpy(np.stack(features)).to(self._device)
            x = x.contiguous(memory_format=torch.channels_last_3d)  # faster on a CPU
            with torch.inference_mode():
                found[2 * pair : 2 * pair + 2] = self.network(x).double().cpu().numpy()

        run_per_class(ask, pairs)
        return NetworkGuess(crops, found[: len(crops)])


@cache
def own_prior() -> ShapePrior:
    """Return the package's own prior, read once."""
    return ShapePrior()
