# SPDX-License-Identifier: BSD-3-Clause
"""A map and all that it does not say, composed into obstacles."""

import logging
import time
from collections.abc import Collection, Iterable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vprism_plan._threads import beside
from vprism_plan.errors import WorldError
from vprism_plan.mapping.posterior import nothing
from vprism_plan.world import visibility
from vprism_plan.world.config import HalfSpace, Known, KnownMesh, OccludedPolicy, WorldConfig
from vprism_plan.world.distance import (
    DistanceField,
    Lattice,
    NodeDistances,
    at_nodes,
    bounds_on,
    checked_points,
    combine,
    distance_to_lattice,
    finish,
    round_down,
)
from vprism_plan.world.grid import Grid, Points, Vector, choose_grid, grid_beyond
from vprism_plan.world.levelset import (
    LevelSet,
    lattice_refinement,
    rasterize_level_set,
    trace_level_set,
)
from vprism_plan.world.marks import Evidence, only, rasterize_mesh, unmark
from vprism_plan.world.posterior_worlds import PosteriorWorlds, classes_of
from vprism_plan.world.seen import RIM, seen_support
from vprism_plan.world.sources import LAST_MARK, MARKED, SUPPORT, object_id

_log = logging.getLogger(__name__)

_MAX_OBJECTS = min(250, 255 - LAST_MARK)  # marks are bytes


class World:
    """Obstacles made of a map, what its cameras saw and did not see, and known geometry.

    Observed points of an object that lie more than a voxel off the level set (parts too thin for
    the map's kernels) are obstacles of that object, too.

    Everything is baked on construction. Sources, in this order: one per object, then "background",
    "occluded", "unobserved", labelled objects without any depth return, then known geometry; the
    support surface and known half-spaces are not in the field but in `planes`.

    What was seen outside the grid, and its shadow, is kept on a coarse grid around it (nodes 10 cm
    apart, 4.4 m beyond its faces), so an obstacle there is up to two such steps nearer than it is.
    Beyond that nothing was judged: everything counts as "unobserved" and as an obstacle, whatever
    the policies say.

    Args:
        map: a `VPrismMap`; None where there is none and no camera: then nothing but known geometry
            is an obstacle, and all other space is free (`unobserved="occupied"`: all that lies
            outside of the grid is an obstacle, and all in it).
        config: resolution, level, policies and known geometry.
        known: more known geometry, beside that of the configuration; an empty list says that there
            is none.

    Attributes:
        map: that map; one without objects and views where none was given.
        grid: nodes of the field.
        field: distance to objects, background, occluded or unobserved space (by policy) and known
            geometry.
        planes: (P, 4) float64 rows (nx, ny, nz, offset): obstacles {x : n . x < offset}, metres;
            the support surface first, if the map has one. Read-only.
        plane_names: their names.
        sources: names that `field.source` indexes.
        timings: seconds per step of the bake; some steps run at the same time.

    Raises:
        WorldError: the map says "occupied" without evidence, the grid is too large, or there is
            neither a map nor known geometry.
    """

    def __init__(
        self,
        map: Any = None,
        config: WorldConfig | None = None,
        known: Iterable[Known] | None = None,
        _traced: LevelSet | None = None,
    ) -> None:
        config = WorldConfig() if config is None else config
        if map is None and known is None and not config.known:
            raise WorldError(
                "a World is made of a map (fit_map) or of known=[Box(...), ...]; known=[] says "
                "that there is no obstacle at all"
            )
        self.map = map = nothing() if map is None else map
        self.config = replace(config, known=(*config.known, *known)) if known else config
        self.timings: dict[str, float] = {}
        self._evidence = Evidence(map, self.config)
        self._bounded = self._evidence.bounded
        lost = self._evidence.without_depth
        count = len(map.object_ids) + len(lost)
        if count > _MAX_OBJECTS:
            raise WorldError(f"the map has {count} objects; a world holds at most {_MAX_OBJECTS}")
        solids = [k for k in self.config.known if not isinstance(k, HalfSpace)]
        self.sources: tuple[str, ...] = (
            *(f"object:{i}" for i in map.object_ids),
            *MARKED,
            *(f"object:{i}" for i in lost),
            *([SUPPORT] if self._bounded else []),
            *(f"known:{k.name}" for k in solids),
        )
        self.plane_names, self.planes = self._half_spaces()
        # Before the level set, whose tracing for a grid too large even so takes minutes.
        self.grid: Grid = choose_grid(map, self.config, None)
        self._support = seen_support(map.views, map.plane) if self._bounded else None
        self._factor = lattice_refinement(self.config.resolution, map)
        fine = self.config.resolution / self._factor
        with beside(self._all_hidden) as hidden:
            self._level_set = _traced or self._timed(
                "level set", trace_level_set, map, fine, self.config.level
            )
            found = hidden()
        box = self._level_set.box()
        grid = choose_grid(
            map, self.config, None if box is None else (box[0] * fine, box[1] * fine)
        )
        if (grid.first != self.grid.first).any() or grid.shape != self.grid.shape:
            self.grid = grid
            found = self._all_hidden()
        marks, self._marks_beyond, self._beyond, self._from_beyond = found
        self._objects: NodeDistances = self._timed(
            "distance to objects", self._object_distances, None
        )
        self._unseen: Lattice = self._timed(
            "seen", self._evidence.with_seen, marks, self.grid, self._objects.distance
        )
        sure = self._timed("known geometry", self._known_distances, solids)
        sure += self._solid_distances(self._support, SUPPORT, self.grid)
        self._known: NodeDistances = combine(sure, self.grid)
        self._others = self._timed("distance to the unseen", self._unseen_distances, self._unseen)
        self.field: DistanceField = self._timed(
            "combine", self._field, [self._objects, *self._others, self._known]
        )
        self._said: tuple[str, ...] = ()
        self._lowered: World | None = None
        self._cache: dict[tuple[str, frozenset[int]], DistanceField] = {}
        self._draws: dict[tuple[int, int, float], PosteriorWorlds] = {}
        _log.debug("world baked: %s nodes, %s", self.field.distance.size, self.timings)

    def __getstate__(self) -> dict[str, Any]:
        """Other threads may add to the caches while they are copied."""
        return {**self.__dict__, "_cache": dict(self._cache), "_draws": dict(self._draws)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.planes.setflags(write=False)

    def _timed(self, name: str, step: Any, *args: Any) -> Any:
        start = time.perf_counter()
        result = step(*args)
        self.timings[name] = time.perf_counter() - start
        return result

    def _half_spaces(self) -> tuple[tuple[str, ...], Float[np.ndarray, "p 4"]]:
        names, rows = [], []
        if self.map.plane is not None and not self._bounded:
            names.append(SUPPORT)
            rows.append([*self.map.plane.normal, self.map.plane.offset])
        for item in self.config.known:
            if isinstance(item, HalfSpace):
                names.append(f"known:{item.name}")
                rows.append([*item.normal, item.offset])
        planes = np.array(rows, dtype=np.float64).reshape(-1, 4)
        planes.setflags(write=False)
        return tuple(names), planes

    def _unseen_distances(self, marks: Lattice) -> list[NodeDistances]:
        faces = [self._faces(self.grid)] if self.config.unobserved == "occupied" else []
        return [self._marked_distances(marks, self.grid), *faces]

    def _marked_distances(self, marks: Lattice, grid: Grid) -> NodeDistances:
        distance, label = distance_to_lattice(marks, grid)
        return NodeDistances(distance, self._sources_of_marks()[label])

    def _sources_of_marks(self) -> np.ndarray:
        """Index into `sources` of each mark of `world.marks`, -1 for none, (256,)."""
        classes, lost = len(self.map.object_ids), len(self._evidence.without_depth)
        index = np.full(256, -1, dtype=np.int16)
        for name, mark in MARKED.items():
            index[mark] = self.sources.index(name)
        first = classes + len(MARKED)
        marks = LAST_MARK + 1 + np.arange(classes + lost)
        index[marks] = [*range(classes), *range(first, first + lost)]
        return index

    def _all_hidden(
        self,
    ) -> tuple[Lattice, Lattice | None, DistanceField | None, list[NodeDistances]]:
        """What does not depend on the level set: marks of hidden space, and all beyond the grid."""
        occluded = self.config.occluded
        marks = self._timed("visibility", self._evidence.hidden, occluded, self.grid)
        beyond = self._timed("beyond", self._mark_beyond)
        return marks, beyond, *self._around(beyond, True)

    def _mark_beyond(self) -> Lattice | None:
        """Mark what was seen outside the grid, unless all of that is an obstacle anyway."""
        if self.config.unobserved == "occupied" or not self.map.views:
            return None
        occluded: OccludedPolicy = "free" if self.config.occluded == "free" else "occupied"
        marks = self._evidence.hidden(occluded, self._grid_beyond, self.grid)
        return self._evidence.with_seen(marks, self._grid_beyond, None, self.grid)

    @property
    def _grid_beyond(self) -> Grid:
        return grid_beyond(self.grid, self.map.plane, self._bounded)

    def _around(
        self, marks: Lattice | None, faces: bool
    ) -> tuple[DistanceField | None, list[NodeDistances]]:
        """The field of marks outside the grid, and what it says inside, if there are any. With
        `faces`, everything farther away is an obstacle as well."""
        if marks is None:
            return None, []
        grid = self._grid_beyond
        nodes, inside = self._marked_distances(marks, grid), []
        if np.isfinite(nodes.distance).any():
            within = bounds_on(finish(nodes, grid, self.sources, False), self.grid)
            # All of it lies outside: the grid's faces are nearer.
            np.maximum(within.distance, self._faces(self.grid).distance, out=within.distance)
            inside = [within]
        if faces:
            support = self._solid_distances(self._support, SUPPORT, grid)
            nodes = combine([nodes, *support, self._faces(grid)], grid)
        return finish(nodes, grid, self.sources, faces), inside

    def _solid_distances(self, solid: Any, name: str, grid: Grid) -> list[NodeDistances]:
        """Distances of nodes to what has a signed distance, rounded down; none to None."""
        if solid is None:
            return []
        distance = at_nodes(grid, lambda points: solid.signed_distance(points) - 1e-9)
        return [NodeDistances(distance, self._all_of(name, grid))]

    def _all_of(self, name: str, grid: Grid) -> np.ndarray:
        return np.full(grid.shape, self.sources.index(name), dtype=np.int16)

    def _faces(self, grid: Grid) -> NodeDistances:
        """Distance from every node to the nearest face of a grid's box: beyond is unobserved."""
        x, y, z = (np.minimum(np.arange(n), np.arange(n)[::-1]) for n in grid.shape)
        steps = np.minimum(np.minimum(x[:, None, None], y[None, :, None]), z)
        distance = round_down(grid.spacing * steps.astype(np.float64))
        return NodeDistances(distance, self._all_of("unobserved", grid))

    def _object_distances(self, classes: Collection[int] | None) -> NodeDistances:
        """Distance to the level set (of some classes only); class k is source k - 1."""
        lattice = rasterize_level_set(self._level_set, self._factor, classes)
        if lattice is None:
            return combine([], self.grid)
        distance, label = distance_to_lattice(lattice, self.grid)
        return NodeDistances(distance, label.astype(np.int16) - np.int16(1))

    def _known_distances(self, solids: list[Any]) -> list[NodeDistances]:
        parts = []
        for item in solids:
            name = f"known:{item.name}"
            if isinstance(item, KnownMesh):
                distance, _ = distance_to_lattice(rasterize_mesh(item, self.grid), self.grid)
                parts.append(NodeDistances(distance, self._all_of(name, self.grid)))
            else:
                parts += self._solid_distances(item, name, self.grid)
        return parts

    def _field(self, parts: list[NodeDistances], without: Collection[int] = ()) -> DistanceField:
        beyond, inside = self._beyond, self._from_beyond
        if without and self._marks_beyond is not None:
            beyond, inside = self._around(unmark(self._marks_beyond, without), True)
        nodes = combine([*parts, *inside], self.grid)
        outside = self.config.unobserved == "occupied"
        return finish(nodes, self.grid, self.sources, outside, beyond)

    def object_field(self, object_id: int) -> DistanceField:
        """Distance to one object alone: where P(occupied) >= level and it is the likeliest, to
        half the grid's resolution; WorldError if the map has none."""
        (k,) = classes_of(self.map, [object_id])
        key = ("only", frozenset([k]))
        if key not in self._cache:
            nodes = self._object_distances([k])
            self._cache[key] = finish(nodes, self.grid, self.sources, solid_outside=False)
        return self._cache[key]

    def fields_without(self, object_ids: Collection[int]) -> DistanceField:
        """Return the combined field without some objects, for contacts that are allowed.

        Occluded space inside the left-out objects' level set goes with them; occluded space beyond
        it stays, as do all other sources. WorldError if the map has no such object.
        """
        gone = frozenset(classes_of(self.map, object_ids))
        if not gone:
            return self.field
        key = ("without", gone)
        if key not in self._cache:
            parts = [self._object_distances(self._rest(gone))]
            parts += self._unseen_distances(self._without(self._unseen, gone))
            self._cache[key] = self._field([*parts, self._known], gone)
        return self._cache[key]

    def certain_field(self, without: Collection[int] = (), seen: bool = False) -> DistanceField:
        """Distance to what is an obstacle whatever the posterior says: background, seen parts that
        the level set misses, known geometry, and unobserved and occluded space by their policies.
        The rest is for `posterior_worlds` to say. The objects `without`, and their seen parts, are
        left out. With `seen`, whatever was seen of an object belongs to it, wherever the level set
        is. WorldError if the map has no such object."""
        gone = frozenset(classes_of(self.map, without))
        key = ("certain, all that was seen" if seen else "certain", gone)
        if key not in self._cache:
            others = self._others
            if seen or gone:
                marks = self._without(self._all_seen if seen else self._unseen, gone)
                others = self._unseen_distances(marks)
            self._cache[key] = self._field([*others, self._known], gone)
        return self._cache[key]

    @cached_property
    def _all_seen(self) -> Lattice:
        return self._evidence.with_seen(self._unseen, self.grid)

    def source_field(self, name: str, without: Collection[int] = ()) -> DistanceField:
        """Distance to one of `sources` alone; baked on first use and kept.

        At no node is it below `field`, so neither are the bounds between nodes; the smallest over
        all sources is `field` wherever that is positive, less the end of what was judged, metres
        away. An object's own field holds its level set and its seen surfaces off it. Of the objects
        `without` the part of the occluded space, and of cells they share with this obstacle, is
        left out, as `fields_without` does; nothing is, of their own. `source` is -1 everywhere if
        there is no such obstacle.
        """
        if name not in self.sources:
            raise WorldError(f"no source {name!r} in this world; it has {', '.join(self.sources)}")
        gone = frozenset(classes_of(self.map, without))
        if name.startswith(("known:", SUPPORT)) or object_id(name) in without:
            gone = frozenset()
        key = (name, gone)
        if key not in self._cache:
            self._cache[key] = self._bake_source(name, gone)
        return self._cache[key]

    def _bake_source(self, name: str, gone: frozenset[int]) -> DistanceField:
        index, solid_outside = self.sources.index(name), False
        beyond: DistanceField | None = None
        if name.startswith("known:"):
            parts = self._known_distances(
                [k for k in self.config.known if f"known:{k.name}" == name]
            )
        elif name == SUPPORT:
            far = self._grid_beyond
            parts = self._solid_distances(self._support, name, self.grid)
            rim = self._solid_distances(self._support, name, far)
            beyond = finish(combine(rim, far), far, self.sources, False)
        else:
            mark = int(np.flatnonzero(self._sources_of_marks() == index)[0])
            marks = only(self._without(self._unseen, gone), mark)
            parts = [self._marked_distances(marks, self.grid)]
            if index < len(self.map.object_ids):
                parts.append(self._object_distances([index + 1]))
            if self._marks_beyond is not None:
                far_marks = only(unmark(self._marks_beyond, gone), mark)
                beyond, inside = self._around(far_marks, False)
                parts += inside
            solid_outside = name == "unobserved" and self.config.unobserved == "occupied"
        nodes = combine(parts, self.grid)
        distance = nodes.distance
        if solid_outside:  # the world's own distances stop at the faces of the grid
            distance = np.minimum(distance, self._faces(self.grid).distance)
        named = np.where(np.isfinite(distance), np.int16(index), np.int16(-1))
        nodes = NodeDistances(distance, named)
        return finish(nodes, self.grid, self.sources, solid_outside, beyond)

    def posterior_worlds(
        self,
        n_worlds: int = 256,
        seed: int = 0,
        reach: float = 0.2,
        resolution: float | None = None,
    ) -> PosteriorWorlds:
        """Return joint draws of the map on voxels of this world's resolution, or a multiple of it,
        as `PosteriorWorlds` does, and of objects that nobody saw (`WorldConfig.hidden_objects`);
        those with at least this reach are kept and shared."""
        voxel = self.config.resolution if resolution is None else resolution
        kept = self._draws.get((n_worlds, seed, voxel))
        if kept is None or kept.reach < reach:
            unseen = self._evidence.unseen
            if unseen is not None:
                unseen = unseen.coarser(round(voxel / self.config.resolution))
            kept = PosteriorWorlds(self.map, n_worlds, seed, voxel, reach, unseen=unseen)
            self._draws[n_worlds, seed, voxel] = kept
        return kept

    def _without(self, marks: Lattice, classes: Collection[int]) -> Lattice:
        if not classes:
            return marks
        inside = rasterize_level_set(self._level_set, self._factor, classes)
        return unmark(marks, classes, inside)

    def _rest(self, gone: Collection[int]) -> set[int]:
        return set(range(1, len(self.map.object_ids) + 1)) - set(gone)

    def status(self, points: Points) -> UInt8[np.ndarray, " n"]:
        """What the cameras know of each world point, whatever the policies say.

        0: some view saw past it or up to it. 1 (occluded): behind what a view saw, or under the
        support surface. 2 (unobserved): outside every image, or no depth return. 3: outside the
        grid and what was judged around it. WorldError if one is not finite.
        """
        points = checked_points(points)
        status = visibility.classify_points(self._evidence.views, points)
        if self.map.plane is not None and not self._bounded:
            status[self.map.plane.signed_distance(points) < 0.0] = visibility.OCCLUDED
        judged = self.field if self._beyond is None else self._beyond
        outside = ((points < judged.origin) | (points > judged.upper)).any(axis=1)
        status[outside] = visibility.OUTSIDE
        return status

    def occupancy_slice(
        self, height: float
    ) -> tuple[
        Float[np.ndarray, "nx ny"], Float[np.ndarray, "nx ny"], Float[np.ndarray, "nx ny 3"]
    ]:
        """P(occupied), entropy (nats) and positions of the grid's nodes at z = height (metres)."""
        nx, ny = self.grid.shape[:2]
        steps = np.moveaxis(np.indices((nx, ny)), 0, -1)
        points = np.full((nx, ny, 3), float(height))
        points[..., :2] = self.grid.origin[:2] + self.grid.spacing * steps
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        occupancy = np.asarray(self.map.occupancy(flat)).reshape(nx, ny)
        entropy = np.asarray(self.map.entropy(flat)).reshape(nx, ny)
        return occupancy, entropy, points

    def export(self, path: Any, frame_id: str = "world") -> Path:
        """Write what is an obstacle in the box of the grid for another stack; return the path.

        Nothing in that box that is an obstacle is free in the file: cells of `config.resolution`
        are given whole. Beyond the box a file says nothing, and most readers take that for free:
        `WorldConfig(bounds=...)` has to hold all that the robot can reach. A bound on risk
        (`CheckerConfig.max_risk`) is not in it.

        Args:
            path: its suffix says what is written. `.bt`, `.ot`: OctoMap; P(occupied) of the map,
                0.97 for other obstacles, unknown where nobody looked (extra `export`). `.scene`,
                `.yaml`: MoveIt's planning scene as text and as message, one collision object of
                boxes for each of `sources` and `plane_names`. `.npz`: distance field and
                occupancy, with their convention. `.obj`, `.glb`, `.stl`, `.ply`: surfaces of the
                cells. `.usd`, `.usda`, `.usdc`: the same as colliders (extra `export`).
            frame_id: name of the world frame in formats that have one.

        Raises:
            ConfigError: another suffix; a mesh of a world without obstacles.
            MissingDependencyError: the library that owns the format is not installed.
        """
        from vprism_plan.world.exports import export_world

        return export_world(self, path, frame_id)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is usable but odd about what this world was made of."""
        return (*getattr(self.map, "warnings", ()), *self._said)

    def for_base(self, base: Vector) -> "World":
        """Return the world for a robot whose base stands there (world, metres): this one, or with
        `support="auto"` and a base more than 5 cm below the support plane one whose support surface
        ends where it was seen to end; baked once. PlaneNotFoundError if too little was seen to say
        where."""
        plane = self.map.plane
        if self.config.support != "auto" or plane is None:
            return self
        lower = -float(plane.signed_distance(np.asarray(base, dtype=np.float64)))
        if lower <= RIM:
            return self
        if self._lowered is None:
            lowered = replace(self.config, support="seen")
            self._lowered = World(self.map, lowered, _traced=self._level_set)
            self._lowered._said = (
                f"the robot's base stands {lower:.2f} m below the support plane, so the support "
                f"surface counts only where it was seen and {RIM:g} m around; "
                'WorldConfig(support="unbounded") makes all below its plane an obstacle',
            )
        return self._lowered

    @cached_property
    def empty(self) -> bool:
        """Whether nothing but half-spaces is an obstacle in the grid."""
        return bool((self.field.source < 0).all())
