# SPDX-License-Identifier: BSD-3-Clause
"""What is thought of the hidden side before the map looks: the prior mean of every logit.

The logits of a map with a prior are z(x) = o(x) + phi(x) . w: a guess o, kept on a small grid
around each object, and V-PRISM's weighted kernels, which correct it. The weights are zero
before anything is seen, wide where a camera looks and narrow where none does, so that what
was seen overrules the guess, and what was not leaves it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree
from scipy.special import ndtr
from torch import Tensor
from torch.nn.functional import grid_sample

from vprism_plan._arguments import number
from vprism_plan._kernels import world as kernels
from vprism_plan._shapes import Chosen, Indices, Points, Values
from vprism_plan._threads import run_chunked
from vprism_plan.errors import MapError
from vprism_plan.perception.camera import invert_transform, project, transform_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

SIDE = 32  # voxels
_FINEST = 0.0075  # metres of a voxel, at least
_ACROSS = 20.0  # voxels that the seen part of an object spans, at most
_BEHIND = 3.0  # voxels by which the crop lies behind the middle of what was seen
_BELOW, _ABOVE = 2.0, 3.0  # voxels under the support surface, and of room above the object
_SEEN = 0.015  # metres in front of what was seen ...
_WINDOW = 3  # ... by all pixels around: nothing is there
FADE = 2.0  # voxels from the side of a grid to where it alone counts
_COARSE = 0.025  # metres between the nodes around the grids ...
_AROUND = 0.1  # ... and how far they reach beyond them
_MOST_NODES = 200_000
MOST = 7.0  # log-odds: no guess is surer than 0.999
FLAT_OCCUPANCY = 0.2  # P(occupied) where nobody guesses


@dataclass(frozen=True, eq=False)
class Crop:
    """A cube of `SIDE` voxels around one object.

    Attributes:
        T_world_crop: crop to world; its origin is the cube's lowest corner.
        voxel: edge of a voxel, m.
        floor: height of the cube's lowest corner above the support surface, m.
    """

    T_world_crop: Float[np.ndarray, "4 4"]
    voxel: float
    floor: float

    @classmethod
    def around(
        cls, points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, " 3"], plane: Plane,
        zoom: float = 1.0,
    ) -> "Crop":  # fmt: skip
        """Return the crop of an object whose seen points (m, world) these are.

        Args:
            points: at least one.
            camera: optical centre of the view that shows the object best, m, world.
            plane: support surface.
            zoom: factor of the voxel's usual edge.
        """
        up = plane.normal
        low, high = np.quantile(points, [0.02, 0.98], axis=0)
        ahead = 0.5 * (low + high) - camera
        ahead = ahead - (ahead @ up) * up
        length = float(np.linalg.norm(ahead))
        ahead = ahead / length if length > 1e-6 else plane.axes()[0]
        rotation = np.stack([ahead, np.cross(up, ahead), up], axis=1)
        low, high = np.quantile(points @ rotation, [0.02, 0.98], axis=0)
        voxel = zoom * max(_FINEST, float((high - low).max()) / _ACROSS)
        # What stands on others, or lies lower than the surface, moves the crop up or down.
        floor = -_BELOW * voxel
        floor = max(floor, high[2] - plane.offset - (SIDE - _ABOVE) * voxel)
        floor = min(floor, low[2] - plane.offset - _BELOW * voxel)
        middle = 0.5 * (low + high)[:2] + [_BEHIND * voxel, 0.0]
        corner = np.array([*(middle - 0.5 * SIDE * voxel), floor + plane.offset])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rotation @ corner
        return cls(pose, voxel, floor)

    def centers(self) -> Float[np.ndarray, "n 3"]:
        """Return the voxels' centres, m, world; z runs fastest."""
        axis = (np.arange(SIDE) + 0.5) * self.voxel
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return transform_points(self.T_world_crop, grid)

    def T_voxel_world(self) -> Float[np.ndarray, "3 4"]:  # noqa: N802
        """Return the map from world points (m) to voxels, whose centres are at whole numbers."""
        inverse = invert_transform(self.T_world_crop)[:3] / self.voxel
        inverse[:, 3] -= 0.5
        return inverse

    def to_voxels(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return where world points (m) lie, counted in voxels; centres are at whole numbers."""
        pose = self.T_voxel_world()
        return points @ pose[:, :3].T + pose[:, 3]


# What some prior thinks of one scene: points (n, 3), m, world -> P(class), (n, K), "empty" first,
# then the objects; rows sum to 1.
Guess = Callable[[np.ndarray], np.ndarray]
# Anything that guesses what objects look like where no camera looked: labelled views, the ids of
# their objects and the support surface -> a guess.
Prior = Callable[[Sequence[Observation], tuple[int, ...], Plane], Guess]


class MeshPrior:
    """Hypotheses of objects' shapes: from a mesh library, a generative model, a CAD file.

    Args:
        hypotheses: object id -> pairs of a closed `trimesh.Trimesh` in the world frame (m) and
            a weight. Weights of an object sum to at most 1; what they lack is the flat prior's.
        blur: how far (m) an observed surface may lie from a hypothesis's, one standard
            deviation.

    Raises:
        MapError: a mesh that is not closed, a weight that is no share, or a blur of 0.
    """

    def __init__(
        self, hypotheses: Mapping[int, Sequence[tuple[Any, float]]], blur: float = 0.005
    ) -> None:
        for object_id, pairs in hypotheses.items():
            for mesh, weight in pairs:
                number(f"weight of a mesh of object {object_id}", weight, 0.0, 1.0, error=MapError)
                if not mesh.is_watertight:
                    raise MapError(
                        f"a mesh of object {object_id} is not closed; close it (trimesh's "
                        "fill_holes) or give its convex hull"
                    )
            total = sum(weight for _, weight in pairs)
            number(f"sum of the weights of object {object_id}", total, 0.0, 1.0 + 1e-9,
                   error=MapError)  # fmt: skip
        self._hypotheses = dict(hypotheses)
        self._blur = number("blur", blur, 0.0, unit="metres", above=True, error=MapError)

    def __call__(
        self, views: Sequence[Observation], object_ids: tuple[int, ...], plane: Plane
    ) -> Guess:
        """Return the guess; ids that have no hypothesis keep the flat prior.

        Raises:
            MapError: a hypothesis for an object that no view shows.
        """
        strange = sorted(set(self._hypotheses) - set(object_ids))
        if strange:
            raise MapError(f"the prior has objects {strange}; the views show {list(object_ids)}")

        def guess(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
            own = np.empty((len(points), len(object_ids)))
            for column, object_id in enumerate(object_ids):
                pairs = self._hypotheses.get(object_id, ())
                rest = 1.0 - sum(weight for _, weight in pairs)
                own[:, column] = rest * FLAT_OCCUPANCY / len(object_ids)
                for mesh, weight in pairs:
                    own[:, column] += weight * self._held(mesh, points)
            return with_empty(own)

        return guess

    def _held(self, mesh: Any, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """P(inside) of points, the surface moved by a normal error of `blur`."""
        spacing = 0.5 * self._blur
        surface, _ = mesh.sample(int(mesh.area / spacing**2) + 100, return_index=True, seed=0)
        low, high = mesh.bounds
        reach = 4.0 * self._blur
        near = np.flatnonzero(((points > low - reach) & (points < high + reach)).all(axis=1))
        distance, _ = cKDTree(surface).query(points[near])
        held = np.zeros(len(points))
        held[near] = ndtr(np.where(mesh.contains(points[near]), distance, -distance) / self._blur)
        return held


@dataclass(frozen=True, eq=False)
class PriorField:
    """Prior mean of the objects' logits, that of "empty" being 0; continuous everywhere.

    Around each object its own grid; elsewhere one coarse grid, whose border goes on for ever.
    Near the sides of a grid the one fades into the other, because a step would look to a level
    set's bound like a surface.

    Attributes:
        T_voxel_world: (C, 3, 4) world (m) to voxels of each object's grid.
        log_odds: (C, n, n, n) float32, at the voxels' centres.
        T_node_world: (3, 4) world (m) to nodes of the coarse grid.
        elsewhere: (a, b, c) float32, log-odds of every single object at its nodes.
        own: whether the prior is the user's, which no file holds: an update must be given it.
    """

    T_voxel_world: Float[np.ndarray, "c 3 4"]
    log_odds: Float[np.ndarray, "c n n n"]
    T_node_world: Float[np.ndarray, "3 4"]
    elsewhere: Float[np.ndarray, "x y z"]
    own: bool = False

    @property
    def voxel(self) -> float:
        """Edge of the finest grid's voxels, m."""
        return float(1.0 / np.linalg.norm(self.T_voxel_world[:, 0, :3], axis=1).max())

    @cached_property
    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Corners (m, world) of a box that holds all that the grids do not call surely empty."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for pose, grid in zip(self.T_voxel_world, self.log_odds, strict=True):
            found = np.argwhere(grid > 1.0 - MOST)
            if len(found):
                ends = np.stack([found.min(axis=0) - 1.0, found.max(axis=0) + 1.0])
                cube = np.array(list(product(*ends.T)))
                world = np.linalg.solve(pose[:, :3], (cube - pose[:, 3]).T)
                low, high = np.minimum(low, world.min(axis=1)), np.maximum(high, world.max(axis=1))
        return low, high

    def logits(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
        """Return the prior means of all logits at points (m), differentiable, on their device."""
        last = self.log_odds.shape[1] - 1
        places = [_transformed(pose, points) for pose in self.T_voxel_world]
        # From 0 at the sides of a grid and outside of it to 1 a few voxels inside.
        shares = [
            (torch.minimum(at, last - at).amin(dim=1) / FADE).clamp(0.0, 1.0) for at in places
        ]
        covered = torch.stack(shares).amax(dim=0)
        flat = _sampled(self.elsewhere, _transformed(self.T_node_world, points))
        other = flat + covered * (-MOST - flat)  # in another object's grid it is not this one
        columns = [torch.zeros_like(flat)]
        for grid, at, share in zip(self.log_odds, places, shares, strict=True):
            rows = (share > 0.0).nonzero()[:, 0]
            own = _sampled(grid, at[rows])
            mixed = other[rows] + share[rows] * (own - other[rows])
            columns.append(other.index_put((rows,), mixed))
        return torch.stack(columns, dim=1)

    def covers(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points (m) lie in the grid of an object, where it alone counts."""
        last, left = self.log_odds.shape[1] - 1, np.arange(len(points))
        for pose in self.T_voxel_world:
            at = points[left] @ pose[:, :3].T + pose[:, 3]
            left = left[(np.minimum(at, last - at) < FADE).any(axis=1)]
        inside = np.ones(len(points), dtype=bool)
        inside[left] = False
        return inside

    def nearest(self, points: Points) -> tuple[Indices, Points]:
        """Return the grid whose part that alone counts is nearest to each point (m), and where in
        it, voxels."""
        end = self.log_odds.shape[1] - 1 - FADE
        best, grid = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        place = np.zeros((len(points), 3))
        for k, pose in enumerate(self.T_voxel_world):
            at = points @ pose[:, :3].T + pose[:, 3]
            inside = at.clip(FADE, end)
            away = np.linalg.norm(at - inside, axis=1) / np.linalg.norm(pose[0, :3])
            nearer = away < best
            best[nearer], grid[nearer], place[nearer] = away[nearer], k, inside[nearer]
        return grid, place

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return the same for numpy points, float64."""
        out = np.empty((len(points), 1 + len(self.log_odds)))
        points = np.ascontiguousarray(points, dtype=np.float64)
        run_chunked(
            lambda s: kernels.guesses(points, *self._grids, out, s.start, s.stop), len(out), 4096
        )
        return out

    @property
    def _grids(self) -> tuple[Any, ...]:
        """What the kernels take after points."""
        return self.T_voxel_world, self.log_odds, self.T_node_world, self.elsewhere, FADE, -MOST

    def bounds(
        self, centers: Float[np.ndarray, "n 3"], half: float
    ) -> tuple[Float[np.ndarray, "n c"], Float[np.ndarray, "n c"]]:
        """Return the least and the greatest the objects' logits may be in cubes of edge 2 `half` m.

        What a trilinear grid says in a cube lies between the least and the greatest of the
        nodes around it.
        """
        low, high = np.empty((2, len(centers), len(self.log_odds)))
        centers = np.ascontiguousarray(centers)
        run_chunked(
            lambda s: kernels.guess_bounds(
                centers, half, *self._grids, low, high, s.start, s.stop
            ),
            len(centers), 512,
        )  # fmt: skip
        return low, high


def _transformed(pose: Float[np.ndarray, "3 4"], points: Float[Tensor, "n 3"]) -> Tensor:
    """Apply (3, 4) to points term by term, so that a point's bits do not depend on its company."""
    matrix = torch.as_tensor(pose).to(points)
    out = matrix[:, 3]
    for axis in range(3):
        out = out + points[:, axis, None] * matrix[:, axis]
    return out


def _sampled(grid: Float[np.ndarray, "x y z"], at: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the trilinear value of a grid at (n, 3) indices; its border goes on for ever."""
    # grid_sample wants the last axis first, scaled to [-1, 1].
    last = torch.tensor(grid.shape).to(at) - 1.0
    scaled = (at * (2.0 / last) - 1.0).flip(1)[None, :, None, None]
    values = torch.as_tensor(grid).to(at)[None, None]
    found = grid_sample(values, scaled, align_corners=True, padding_mode="border")
    return found.reshape(-1)


def with_empty(own: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n k"]:
    """Return P(class) of P(object): objects that contradict each other share what there is."""
    together = own.sum(axis=1)
    own = own * np.minimum(1.0, (1.0 - 1e-6) / np.maximum(together, 1e-12))[:, None]
    return np.column_stack([1.0 - own.sum(axis=1), own])


def object_crops(
    views: Sequence[Observation], object_ids: tuple[int, ...], plane: Plane
) -> tuple[Crop, ...]:
    """Return the crop of every object, seen from the view that shows most of it."""
    clouds = [view.points() for view in views]
    crops = []
    for k in object_ids:
        own = [points[labels == k] for points, labels in clouds]
        best = int(np.argmax([len(points) for points in own]))
        crops.append(Crop.around(np.concatenate(own), views[best].camera_center, plane))
    return tuple(crops)


def hidden_depth(points: Points, views: Sequence[Observation], window: int = 1) -> Values:
    """Return how far (m) points lie behind what the views saw, negative in front of it.

    Of several views the one that sees farthest counts. What no view shows, or only pixels
    without a return, is infinitely far behind. With a `window` (pixels) the nearest thing around
    a point's pixel counts, and a pixel without a return there is as good as none.
    """
    behind = np.full(len(points), np.inf)
    for view in views:
        local = transform_points(invert_transform(view.pose), points)
        pixels, z = project(local, view.intrinsics)
        height, width = view.depth.shape
        with np.errstate(invalid="ignore"):
            column, row = np.rint(pixels).T
            inside = (z > 0.0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = view.free_depth if window == 1 else minimum_filter(view.free_depth, window)
        depth = np.zeros(len(points))
        depth[inside] = seen[row[inside].astype(np.int64), column[inside].astype(np.int64)]
        known = depth > 0.0
        behind[known] = np.minimum(behind[known], (z - depth)[known])
    return behind


def seen_through(points: Points, views: Sequence[Observation]) -> Chosen:
    """Return where a view saw so far past points (m) that no guess puts anything there."""
    return hidden_depth(points, views, _WINDOW) < -_SEEN


def _checked(proba: Any, shape: tuple[int, int]) -> Float[np.ndarray, "n k"]:
    """Return a guess as probabilities, or say why it is none."""
    found = np.array(proba, dtype=np.float64)
    if found.shape != shape:
        raise MapError(f"the prior's guess has shape {found.shape}; it must be {shape}")
    if not (found >= 0.0).all() or not np.allclose(found.sum(axis=1), 1.0, atol=1e-6):
        raise MapError("the prior's guess is no probability: a row is below 0, NaN or not of sum 1")
    return found


def prior_field(
    guess: Guess,
    crops: Sequence[Crop],
    empty: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]],
    occupancy: float,
    own: bool,
) -> PriorField:
    """Put a guess onto the objects' grids; where space is known to be empty, nothing is.

    Args:
        guess: the prior's.
        crops: one per object.
        empty: which points (m) are seen to be free, or under the table.
        occupancy: P(occupied) where no grid reaches and no view looked.
        own: see `PriorField`.
    """
    grids, corners = [], []
    tiny = math.exp(-MOST)
    for index, crop in enumerate(crops):
        points = crop.centers()
        proba = _checked(guess(points), (len(points), len(crops) + 1))
        odds = np.log(np.maximum(proba[:, index + 1], tiny) / np.maximum(proba[:, 0], tiny))
        odds = np.where(empty(points), -MOST, np.clip(odds, -MOST, MOST))
        grids.append(odds.reshape(SIDE, SIDE, SIDE).astype(np.float32))
        corners += [points.min(axis=0), points.max(axis=0)]
    lower, upper = np.min(corners, axis=0) - _AROUND, np.max(corners, axis=0) + _AROUND
    step = max(_COARSE, float(np.prod(upper - lower) / _MOST_NODES) ** (1.0 / 3.0))
    shape = np.ceil((upper - lower) / step).astype(np.int64) + 1
    nodes = lower + step * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    # Of each object, so that all together say `occupancy`.
    unknown = math.log(occupancy / (1.0 - occupancy) / len(crops))
    flat = np.where(empty(nodes), -MOST, unknown)
    return PriorField(
        np.stack([crop.T_voxel_world() for crop in crops]),
        np.stack(grids),
        np.column_stack([np.eye(3), -lower]) / step,
        flat.reshape(shape).astype(np.float32),
        own,
    )
