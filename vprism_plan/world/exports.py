# SPDX-License-Identifier: BSD-3-Clause
"""Worlds as files of other stacks: OctoMap, MoveIt, distance fields, meshes, USD.

Every format says the same: which cells (cubes between the nodes of the distance field) hold any
point that may be an obstacle. A cell is free only if the bounds of the field are positive in all
of it, so nothing that the checker refuses by touch is free in a file. All cover the box of the
grid; outside of it they say nothing.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int16

from vprism_plan._files import optional, replacing
from vprism_plan.errors import ConfigError
from vprism_plan.world.grid import Vector, corners
from vprism_plan.world.visibility import SEEN

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.world.world import World

_PARTS = 3  # of a cell along each axis, when its smallest bound is sought
_SURE = 0.97  # P(occupied) in an OctoMap of what is an obstacle and not the map's to judge
_STEPS = 0.05  # log-odds between the values that cells of an OctoMap may have
_SLAB = 32  # layers of cells at once


@dataclass(frozen=True, eq=False)
class Cells:
    """Cubes between the nodes of a world's field.

    Attributes:
        origin: (3,) lower corner of cell (0, 0, 0), world, metres.
        spacing: edge of a cell, metres.
        distance: (nx, ny, nz) float32 metres: no point of the cell is nearer to any obstacle; not
            positive: the cell may hold an obstacle's point.
        source: (nx, ny, nz) int16, index into `names` of the nearest obstacle, -1 for none.
        names: as in `World.sources`, then `World.plane_names`.
    """

    origin: Vector
    spacing: float
    distance: Float32[np.ndarray, "nx ny nz"]
    source: Int16[np.ndarray, "nx ny nz"]
    names: tuple[str, ...]

    @classmethod
    def of(cls, world: "World") -> "Cells":
        """Bound the distance all over each cell: in a part of it by the bound at its middle, less
        the way there. Between nodes max_i d_i - |x - x_i| is one (see `DistanceField`), and changes
        by no more than the way."""
        field, grid = world.field, world.grid
        at = [np.array(c) for c in product((0.0, 1.0), repeat=3)]
        middles = (np.array(list(product(range(_PARTS), repeat=3))) + 0.5) / _PARTS
        far = 0.5 * np.sqrt(3.0) / _PARTS
        distance = np.empty([n - 1 for n in grid.shape], np.float32)
        source = np.empty(distance.shape, np.int16)
        for first in range(0, len(distance), _SLAB):
            layers = slice(first, first + _SLAB)
            nodes, sources = (a[first : first + _SLAB + 1] for a in (field.distance, field.source))
            around = [nodes[corner] for corner in corners(nodes.shape)]
            least = np.full_like(around[0], np.inf)
            for middle in middles:
                steps = [grid.spacing * (np.linalg.norm(middle - c) + far) for c in at]
                bounds = (d - np.float32(s) for d, s in zip(around, steps, strict=True))
                np.minimum(least, np.maximum.reduce(list(bounds)), out=least)
            nearest = np.argmin(around, axis=0)[None]
            owners = np.stack([sources[corner] for corner in corners(nodes.shape)])
            owner = np.take_along_axis(owners, nearest, axis=0)[0]
            points = grid.slab(first, first + len(nodes)).reshape(*nodes.shape, 3)
            for number, plane in enumerate(world.planes, start=len(world.sources)):
                height = points @ plane[:3] - plane[3]
                lowest = np.minimum.reduce([height[corner] for corner in corners(height.shape)])
                nearer = lowest < np.maximum(least, 0.0)
                owner = np.where(nearer & (least > 0.0), np.int16(number), owner)
                least = np.minimum(least, np.nextafter(lowest.astype(np.float32), -np.inf))
            distance[layers], source[layers] = least, owner
        names = (*world.sources, *world.plane_names)
        return cls(grid.origin, grid.spacing, distance, source, names)

    @property
    def occupied(self) -> Bool[np.ndarray, "nx ny nz"]:
        """Which may hold an obstacle's point."""
        return self.distance <= 0.0

    def centers(self, index: Int[np.ndarray, "n 3"]) -> Any:
        """World positions (n, 3) of the middles of some cells, metres."""
        return self.origin + self.spacing * (index + 0.5)

    def bodies(self) -> Iterator[tuple[str, Bool[np.ndarray, "nx ny nz"]]]:
        """Yield the name and the cells of every obstacle that has any."""
        occupied = self.occupied
        for number, name in enumerate(self.names):
            own = occupied & (self.source == number)
            if own.any():
                yield name, own

    def boxes(self, own: Bool[np.ndarray, "nx ny nz"]) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper corners (n, 3), world metres, of boxes that fill some cells:
        runs along z, as far as they are alike merged along y, then along x."""
        low = np.argwhere(own)
        high = low + 1
        for axis in (2, 1, 0):
            others = [a[:, k] for a in (low, high) for k in range(3) if k != axis]
            order = np.lexsort((low[:, axis], *others))
            low, high = low[order], high[order]
            alike = low[1:, axis] == high[:-1, axis]
            for values in others:
                alike &= values[order][1:] == values[order][:-1]
            first = np.flatnonzero(np.concatenate([[True], ~alike]))
            last = np.concatenate([first[1:], [len(low)]]) - 1
            ends = high[last, axis]
            low, high = low[first], high[first]
            high[:, axis] = ends
        return self.origin + self.spacing * low, self.origin + self.spacing * high

    def surface(self, own: Bool[np.ndarray, "nx ny nz"]) -> "trimesh.Trimesh":
        """Return the faces between some cells and all others, normals outward, world metres."""
        import trimesh

        quads = []
        padded = np.pad(own, 1).astype(np.int8)
        for axis in range(3):
            step = np.diff(padded, axis=axis)
            square = np.zeros((4, 3), np.int64)  # counter-clockwise, seen from the axis' far end
            square[[1, 2], (axis + 1) % 3] = square[[2, 3], (axis + 2) % 3] = 1
            for sign, corner in ((-1, square), (1, square[::-1])):
                # Where a step ends: the face lies at the far side of the cell in front of it.
                place = np.argwhere(step == sign) - 1 + (np.arange(3) == axis)
                quads.append((place[:, None] + corner).reshape(-1, 3))
        vertices = self.origin + self.spacing * np.concatenate(quads)
        first = 4 * np.arange(len(vertices) // 4)[:, None]
        faces = np.concatenate([first + np.array(three) for three in ((0, 1, 2), (0, 2, 3))])
        return trimesh.Trimesh(vertices, faces, process=True)


def export_world(world: "World", path: str | Path, frame_id: str = "world") -> Path:
    """See `World.export`."""
    path = Path(path)
    write = _WRITERS.get(path.suffix.lower())
    if write is None:
        raise ConfigError(f"no export to {path.name!r}: the suffix must be one of {SUFFIXES}")
    with replacing(path) as temporary:
        write(world, temporary, frame_id)
    return path


def _write_octomap(world: "World", path: Path, frame_id: str) -> None:
    pyoctomap = optional("pyoctomap", "export", "OctoMap files need")
    cells = Cells.of(world)
    occupied = cells.occupied
    tree = pyoctomap.OcTree(cells.spacing)
    # Cells that no camera saw past, and of which the map says nothing, stay unknown.
    index = np.argwhere(np.ones_like(occupied))
    points = cells.centers(index)
    map_ = world.map
    judged = map_.judges(points, world.config.min_support)
    held = occupied.reshape(-1)
    free = judged | (world.status(points) == SEEN)
    value = np.full(len(points), -np.inf)
    value[judged] = map_.occupancy_log_odds(points[judged])
    value[free & ~judged] = tree.getClampingThresMinLog()
    sure = np.log(_SURE / (1.0 - _SURE))
    value[held] = np.where(judged[held], np.maximum(value[held], _STEPS), sure)
    ids = np.array([name.startswith("object:") for name in cells.names])
    value[held & ~ids[cells.source.reshape(-1)]] = sure
    low, high = tree.getClampingThresMinLog(), tree.getClampingThresMaxLog()
    steps = np.ceil(value[held | free].clip(low, high) / _STEPS).astype(np.int64)
    points = points[held | free]
    for step in np.unique(steps):
        tree.updateNodes(points[steps == step], float(_STEPS * step), True)
    tree.updateInnerOccupancy()
    done = (tree.writeBinary if path.suffix == ".bt" else tree.write)(str(path))
    if not done:
        raise OSError(f"pyoctomap could not write {path}")


def _scene(world: "World") -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, middles and sizes (n, 3), metres, of the boxes of each collision object."""
    cells = Cells.of(world)
    for name, own in cells.bodies():
        low, high = cells.boxes(own)
        yield name, 0.5 * (low + high), high - low


def _write_scene(world: "World", path: Path, frame_id: str) -> None:
    lines = ["vprism_plan"]
    for name, middles, sizes in _scene(world):
        lines += [f"* {name}", "0 0 0", "0 0 0 1", str(len(sizes))]
        for (x, y, z), (a, b, c) in zip(middles.tolist(), sizes.tolist(), strict=True):
            lines += ["box", f"{a:.9g} {b:.9g} {c:.9g}", f"{x:.9g} {y:.9g} {z:.9g}"]
            lines += ["0 0 0 1", "0 0 0 0"]
        lines.append("0")
    path.write_text("\n".join([*lines, ".", ""]), encoding="utf-8")


def _write_planning_scene(world: "World", path: Path, frame_id: str) -> None:
    import yaml  # type: ignore[import-untyped]

    turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}

    def pose(at: list[float]) -> dict[str, Any]:
        return {"position": dict(zip("xyz", at, strict=True)), "orientation": dict(turn)}

    objects = [
        {
            "header": {"frame_id": frame_id},
            "id": name,
            "pose": pose([0.0, 0.0, 0.0]),
            "primitives": [{"type": 1, "dimensions": size} for size in sizes.round(9).tolist()],
            "primitive_poses": [pose(at) for at in middles.round(9).tolist()],
            "operation": 0,
        }
        for name, middles, sizes in _scene(world)
    ]
    message = {"name": "vprism_plan", "is_diff": True, "world": {"collision_objects": objects}}
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text = yaml.dump(message, Dumper=dumper, default_flow_style=None, sort_keys=False)
    path.write_text(text, encoding="utf-8")


def _write_field(world: "World", path: Path, frame_id: str) -> None:
    cells = Cells.of(world)
    np.savez_compressed(
        path, esdf=cells.distance, occupied=cells.occupied, source=cells.source,
        names=np.array(cells.names), origin=cells.origin + 0.5 * cells.spacing,
        spacing=cells.spacing, frame_id=frame_id,
        convention=(
            "esdf[i, j, k] (metres, positive outside obstacles as in nvblox; cuRobo wants -esdf) "
            "bounds the distance from every point of the cell around origin + spacing * (i, j, k)"
        ),
    )  # fmt: skip


def _write_mesh(world: "World", path: Path, frame_id: str) -> None:
    import trimesh

    cells = Cells.of(world)
    if not cells.occupied.any():
        raise ConfigError("nothing is an obstacle in this world, and a mesh of nothing is no file")
    if path.suffix.lower() in (".obj", ".glb"):
        bodies: Any = {re.sub(r"\W", "_", name): cells.surface(own) for name, own in cells.bodies()}
        trimesh.Scene(bodies).export(path)
    else:  # no names: one surface, without faces between two obstacles
        cells.surface(cells.occupied).export(path)


def _write_usd(world: "World", path: Path, frame_id: str) -> None:
    optional("pxr", "export", "USD files need usd-core's")
    from pxr import Usd, UsdGeom, UsdPhysics, Vt

    path.unlink()  # made by `replacing`; USD opens what exists
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/world").GetPrim())
    cells = Cells.of(world)
    for name, own in cells.bodies():
        mesh = cells.surface(own)
        prim = UsdGeom.Mesh.Define(stage, "/world/" + re.sub(r"\W", "_", name))
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices.astype(np.float32)))
        prim.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
        prim.CreateFaceVertexIndicesAttr(mesh.faces.ravel().tolist())
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        UsdPhysics.CollisionAPI.Apply(prim.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(prim.GetPrim()).CreateApproximationAttr("none")
    stage.GetRootLayer().Save()


_WRITERS: dict[str, Callable[["World", Path, str], None]] = {
    **dict.fromkeys((".bt", ".ot"), _write_octomap),
    ".scene": _write_scene,
    **dict.fromkeys((".yaml", ".yml"), _write_planning_scene),
    ".npz": _write_field,
    **dict.fromkeys((".obj", ".glb", ".stl", ".ply"), _write_mesh),
    **dict.fromkeys((".usd", ".usda", ".usdc"), _write_usd),
}
SUFFIXES = ", ".join(_WRITERS)
