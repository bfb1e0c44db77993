# SPDX-License-Identifier: BSD-3-Clause
"""What every method is judged against in one scene: grid points, the truth and what is known.

Nothing here depends on a method. Visibility comes from the depth image, support from a
lattice of fixed size around what was seen, so all methods answer for the same points.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8
from scipy.spatial import cKDTree

from experiments.protocols import TrueScene
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.hinges import lattice_hinges
from vprism_plan.mapping.training_data import box_centers
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.world import visibility

if TYPE_CHECKING:
    import trimesh

PARTS = ("visible", "occluded", "visible, outside support", "occluded, outside support")
VISIBLE, OCCLUDED, VISIBLE_OUTSIDE, OCCLUDED_OUTSIDE, ELSEWHERE = range(5)
SPACING = 0.015  # metres between grid points
REACH = 0.2  # metres from an object's true centre to the sides of its grid
CLOUD = 10_000  # points on each surface
_TABLE = Plane((0.0, 0.0, 1.0), 0.0)
_TOLERANCE = 0.01  # metres behind a return where shadow begins, at least
_MIN_SUPPORT = 0.5  # kernel mass
_CHUNK = 1 << 14
# The hinge points of the first tables' default preset. They stay when presets change, or
# figures of methods would no longer be about the same points.
_REFERENCE = MapConfig(
    gamma=1000.0, kernel_cutoff=1e-5, hinge_spacing=0.034, hinge_radius=0.12, hinge_margin=0.08,
    hinge_depth=0.05, box_trim=0.01, surface_hinges=0, max_hinges=100_000,
)  # fmt: skip


def cube_nodes(
    center: Float[np.ndarray, " 3"], spacing: float, reach: float = REACH, shift: float = 0.0
) -> tuple[Int64[np.ndarray, " 3"], Int64[np.ndarray, " 3"]]:
    """Return the first and last index (i, j, k) of the lattice nodes around a centre (m).

    Nodes are at spacing * ((i, j, k) + shift); around is within `reach` (m) along every axis.
    """
    first = np.ceil((np.asarray(center) - reach) / spacing - shift)
    last = np.floor((np.asarray(center) + reach) / spacing - shift)
    return first.astype(np.int64), last.astype(np.int64)


@dataclass(frozen=True, eq=False)
class NodeUnion:
    """The nodes of several overlapping cubes on one lattice, each node once.

    Node (i, j, k) is at spacing * ((i, j, k) + shift), metres, world.

    Attributes:
        spacing, shift: of the lattice.
        first, last: (C, 3) corners of each cube, inclusive.
        origin: (3,) lowest index of the box around all.
        inside: (nx, ny, nz) the nodes of that box that belong to a cube.
    """

    spacing: float
    shift: float
    first: Int64[np.ndarray, "c 3"]
    last: Int64[np.ndarray, "c 3"]
    origin: Int64[np.ndarray, " 3"]
    inside: Bool[np.ndarray, "nx ny nz"]

    @classmethod
    def around(
        cls, centers: Float[np.ndarray, "c 3"], spacing: float, shift: float = 0.0
    ) -> "NodeUnion":
        """Return the nodes within `REACH` of any centre (m), at least one."""
        corners = [cube_nodes(center, spacing, shift=shift) for center in centers]
        first, last = np.array([c[0] for c in corners]), np.array([c[1] for c in corners])
        origin = first.min(axis=0)
        union = cls(spacing, shift, first, last, origin, np.zeros(last.max(0) + 1 - origin, bool))
        for cube in range(len(first)):
            union.inside[union.window(cube)] = True
        return union

    def window(self, cube: int) -> tuple[slice, ...]:
        """Return where a cube lies in arrays shaped like `inside`."""
        low, high = self.first[cube] - self.origin, self.last[cube] + 1 - self.origin
        return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Return all nodes (m), in the order of `inside`."""
        return self.spacing * (np.argwhere(self.inside) + self.origin + self.shift)

    def members(self, cube: int) -> Bool[np.ndarray, " n"]:
        """Return which of `points` belong to a cube."""
        own = np.zeros_like(self.inside)
        own[self.window(cube)] = True
        return own[self.inside]


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A scene as methods are judged on it.

    Attributes:
        object_ids: the objects that count: labelled pixels with depth in the observation.
        hidden: labelled objects that no such pixel shows; they are only counted.
        pixels: of each object that counts.
        centers: (C, 3) middle of each one's true bounding box, m.
        grid: points `SPACING` apart within `REACH` of a centre along each axis. None lies
            on the table's plane, where touching objects would be in or out by rounding.
        ids: (N,) true object at each grid point; 0 none, -1 clutter.
        part: (N,) index into `PARTS`, or ELSEWHERE.
        clouds: `CLOUD` points on each true surface, m.
    """

    object_ids: tuple[int, ...]
    hidden: tuple[int, ...]
    pixels: tuple[int, ...]
    centers: Float[np.ndarray, "c 3"]
    grid: NodeUnion
    ids: Int64[np.ndarray, " n"]
    part: UInt8[np.ndarray, " n"]
    clouds: dict[int, Float[np.ndarray, "m 3"]]

    @classmethod
    def of(cls, scene: TrueScene) -> "SceneTruth":
        """Work out the truth of a scene; some tenths of a second to a few seconds."""
        seen = scene.observation
        object_ids = seen.require_objects()
        meshes = scene.truth_meshes()
        centers = np.array([np.asarray(meshes[k].bounds).mean(axis=0) for k in object_ids])
        grid = NodeUnion.around(centers, SPACING, shift=0.5)
        points = grid.points()
        returned = seen.depth > 0
        assert seen.labels is not None
        return cls(
            object_ids,
            tuple(k for k in scene.object_ids if k not in object_ids),
            tuple(int(((seen.labels == k) & returned).sum()) for k in object_ids),
            centers,
            grid,
            np.asarray(scene.object_of(points), dtype=np.int64),
            what_is_known(seen, points),
            {k: surface_points(meshes[k], seed=[scene.seed, k]) for k in object_ids},
        )


def surface_points(mesh: "trimesh.Trimesh", seed: list[int]) -> Float[np.ndarray, "m 3"]:
    """Return `CLOUD` seeded points (m), spread evenly by area over a surface."""
    rng = np.random.default_rng(seed)
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    which = rng.choice(len(triangles), CLOUD, p=area / area.sum())
    u, v = rng.random((2, CLOUD, 1))
    outside = u + v > 1.0
    u, v = np.where(outside, 1.0 - u, u), np.where(outside, 1.0 - v, v)
    return np.asarray(a[which] + u * (b - a)[which] + v * (c - a)[which])


def what_is_known(seen: Observation, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """Return the part of space in which each point (m) lies, whatever the method.

    VISIBLE is in front of what the view saw, OCCLUDED behind it. Where the reference hinge
    points have a kernel mass below 0.5 it is VISIBLE_OUTSIDE or OCCLUDED_OUTSIDE. ELSEWHERE is
    outside the image, behind missing returns, or under the table z = 0.
    """
    view = visibility.make_view(seen, _TOLERANCE, _TABLE)
    status = visibility.classify_points([view], points)
    outside = kernel_mass(points, reference_hinges(seen)) < _MIN_SUPPORT
    part = np.full(len(points), ELSEWHERE, dtype=np.uint8)
    for code, inner, outer in (
        (visibility.SEEN, VISIBLE, VISIBLE_OUTSIDE),
        (visibility.OCCLUDED, OCCLUDED, OCCLUDED_OUTSIDE),
    ):
        part[status == code] = np.where(outside, outer, inner)[status == code]
    part[points[:, 2] < 0.0] = ELSEWHERE
    return part


def reference_hinges(seen: Observation) -> Float[np.ndarray, "h 3"]:
    """Return the hinge points (m) around the seen objects that decide what has support."""
    points, labels = seen.points()
    lower, upper = box_centers(points, labels, seen.require_objects(), _REFERENCE.box_trim)
    return lattice_hinges(lower, upper, _TABLE.normal, _TABLE.offset, _REFERENCE)


def kernel_mass(
    points: Float[np.ndarray, "n 3"], hinges: Float[np.ndarray, "h 3"]
) -> Float[np.ndarray, " n"]:
    """Return the sum of the reference kernel over all hinge points at each point (m)."""
    mass, tree = np.zeros(len(points)), cKDTree(hinges)
    radius, gamma = _REFERENCE.cutoff_radius, _REFERENCE.gamma
    for start in range(0, len(points), _CHUNK):
        piece = cKDTree(points[start : start + _CHUNK])
        near = piece.sparse_distance_matrix(tree, radius, output_type="ndarray")
        weight = np.exp(-gamma * near["v"] ** 2)
        mass[start : start + _CHUNK] = np.bincount(near["i"], weight, minlength=piece.n)
    return mass
