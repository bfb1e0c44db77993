# SPDX-License-Identifier: BSD-3-Clause
"""A map and all that it does not say, composed into obstacles."""

import logging
import time
from collections.abc import Collection
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan.errors import WorldError
from vprism_plan.world import visibility
from vprism_plan.world.config import WorldConfig
from vprism_plan.world.distance import (
    DistanceField,
    Lattice,
    NodeDistances,
    checked_points,
    combine,
    distance_to_lattice,
    finish,
    round_down,
)
from vprism_plan.world.forgotten import forgotten_points
from vprism_plan.world.grid import Grid, choose_grid
from vprism_plan.world.known import HalfSpace, KnownMesh, Primitive
from vprism_plan.world.levelset import lattice_refinement, trace_level_set
from vprism_plan.world.rasterize import rasterize_level_set, rasterize_mesh

_log = logging.getLogger(__name__)

_CELLS = 2  # cells per grid step for everything that is seen or not seen
# Marks on that lattice; where several apply the largest wins.
_UNOBSERVED, _OCCLUDED, _BACKGROUND = 1, 2, 3  # and 3 + k: seen surface of class k
_MAX_OBJECTS = 250


class World:
    """Obstacles made of a map, what its cameras saw and did not see, and known geometry.

    Observed points of an object that lie more than a voxel off the level set (parts
    too thin for the map's kernels) are obstacles of that object, too.

    Everything is baked on construction. Sources, in this order: one per object, then
    "background", "occluded", "unobserved", then known geometry; the support surface
    and known half-spaces are not in the field but in `planes`.

    Args:
        map: a `VPrismMap`.
        config: resolution, level, policies and known geometry.

    Attributes:
        map: the map.
        config: the configuration.
        grid: nodes of the field.
        field: distance to objects, background, occluded or unobserved space (by policy)
            and known geometry.
        planes: (P, 4) float64 rows (nx, ny, nz, offset): obstacles {x : n . x < offset},
            metres; the support surface first, if the map has one.
        plane_names: their names.
        sources: names that `field.source` indexes.
        timings: seconds per step of the bake.

    Raises:
        WorldError: the map says "occupied" without evidence, or the grid is too large.
    """

    def __init__(self, map: Any, config: WorldConfig | None = None) -> None:
        self.map = map
        self.config = WorldConfig() if config is None else config
        self.timings: dict[str, float] = {}
        if len(map.object_ids) > _MAX_OBJECTS:
            raise WorldError(
                f"the map has {len(map.object_ids)} objects; a world holds at most {_MAX_OBJECTS}"
            )
        names = [f"object:{i}" for i in map.object_ids]
        solids = [k for k in self.config.known if not isinstance(k, HalfSpace)]
        self.sources: tuple[str, ...] = (
            *names,
            "background",
            "occluded",
            "unobserved",
            *(f"known:{k.name}" for k in solids),
        )
        self.plane_names, self.planes = self._half_spaces()
        self._factor = lattice_refinement(self.config.resolution, map.kernel_length)
        fine = self.config.resolution / self._factor
        self._level_set = self._timed("level set", trace_level_set, map, fine, self.config.level)
        box = self._level_set.box()
        self.grid: Grid = choose_grid(
            map, self.config, None if box is None else (box[0] * fine, box[1] * fine)
        )
        self._views = [
            visibility.make_view(view, self.config.occlusion_tolerance, map.plane)
            for view in map.views
        ]
        everything = [self._timed("distance to objects", self._object_distances, None)]
        self._unseen = self._timed("visibility", self._mark_unseen, everything[0])
        known = self._timed("known geometry", self._known_distances, solids)
        self._known: NodeDistances = combine(known, self.grid)
        others = self._timed("distance to the unseen", self._unseen_distances, self._unseen)
        objects = self._timed("distance to objects", self._object_distances, None)
        self.field: DistanceField = self._timed(
            "combine", self._field, [objects, others, self._known]
        )
        self._cache: dict[tuple[str, frozenset[int]], DistanceField] = {}
        _log.debug("world baked: %s nodes, %s", self.field.distance.size, self.timings)

    def _timed(self, name: str, step: Any, *args: Any) -> Any:
        start = time.perf_counter()
        result = step(*args)
        self.timings[name] = time.perf_counter() - start
        return result

    # --- parts -----------------------------------------------------------------

    def _half_spaces(self) -> tuple[tuple[str, ...], Float[np.ndarray, "p 4"]]:
        names, rows = [], []
        if self.map.plane is not None:
            names.append("support surface")
            rows.append([*self.map.plane.normal, self.map.plane.offset])
        for item in self.config.known:
            if isinstance(item, HalfSpace):
                names.append(f"known:{item.name}")
                rows.append([*item.normal, item.offset])
        return tuple(names), np.array(rows, dtype=np.float64).reshape(-1, 4)

    def _mark_unseen(self, objects: NodeDistances) -> Lattice:
        """Mark occluded and unobserved cells, as the policies say, and seen surfaces that no
        object of the map holds."""
        config, grid = self.config, self.grid
        spacing = grid.spacing / _CELLS
        cells = tuple(_CELLS * (n - 1) for n in grid.shape)
        shape = (cells[0], cells[1], cells[2])
        nodes = np.zeros(tuple(n + 1 for n in shape), dtype=np.uint8)
        if config.occluded != "free" or config.unobserved != "free":
            status = visibility.classify_cells(
                self._views, self.map.plane, grid.origin, spacing, shape
            )
            shadow = 0 if config.occluded == "free" else _OCCLUDED
            unseen = 0 if config.unobserved == "free" else _UNOBSERVED
            marks = np.zeros(4, dtype=np.uint8)
            marks[kernels.OCCLUDED] = shadow
            marks[kernels.PARTLY] = shadow or unseen
            marks[kernels.UNOBSERVED] = unseen
            if config.occluded == "posterior":
                self._trust_posterior(status, spacing)
            _mark_corners(marks[status], nodes)
        points, half = visibility.background_points(
            self.map.views, self.map.plane, config.background_height
        )
        kernels.mark_boxes(points, half, grid.origin, spacing, np.uint8(_BACKGROUND), nodes)
        for k, points, half in forgotten_points(
            self.map.views,
            self.map.object_ids,
            self.map.plane,
            config.background_height,
            objects.distance,
            grid,
        ):
            label = np.uint8(_BACKGROUND + k)
            kernels.mark_boxes(points, half, grid.origin, spacing, label, nodes)
        return Lattice(nodes, grid.first * _CELLS, _CELLS)

    def _trust_posterior(self, status: UInt8[np.ndarray, "nx ny nz"], spacing: float) -> None:
        """Call occluded cells free where the map has support: its level set decides there."""
        origin = self.grid.origin
        lower, upper = (np.asarray(c) for c in self.map.support_bounds())
        first = np.clip(np.floor((lower - origin) / spacing).astype(int), 0, status.shape)
        last = np.clip(np.ceil((upper - origin) / spacing).astype(int), 0, status.shape)
        for x in range(int(first[0]), int(last[0])):
            part = status[x, first[1] : last[1], first[2] : last[2]]
            hidden = np.argwhere((part == kernels.OCCLUDED) | (part == kernels.PARTLY))
            if len(hidden) == 0:
                continue
            index = np.column_stack([np.full(len(hidden), x), hidden + first[1:]])
            centers = origin + spacing * (index + 0.5)
            known = np.asarray(self.map.support(centers)) >= self.config.min_support
            where = tuple(hidden[known].T)
            whole = part[where] == kernels.OCCLUDED
            part[where] = np.where(whole, kernels.FREE, kernels.UNOBSERVED)

    def _unseen_distances(self, lattice: Lattice) -> NodeDistances:
        names = np.full(256, -1, dtype=np.int16)
        names[_BACKGROUND] = self.sources.index("background")
        names[_OCCLUDED] = self.sources.index("occluded")
        names[_UNOBSERVED] = self.sources.index("unobserved")
        classes = len(self.map.object_ids)
        names[_BACKGROUND + 1 : _BACKGROUND + 1 + classes] = np.arange(classes)
        distance, label = distance_to_lattice(lattice, self.grid)
        source = names[label]
        if self.config.unobserved == "occupied":
            faces = _distance_to_faces(self.grid)
            closer = faces < distance
            np.copyto(distance, faces, where=closer)
            np.copyto(source, names[_UNOBSERVED], where=closer)
        return NodeDistances(distance, source)

    def _object_distances(self, classes: Collection[int] | None) -> NodeDistances:
        """Distance to the level set (of some classes only); class k is source k - 1."""
        lattice = rasterize_level_set(self._level_set, self._factor, classes)
        if lattice is None:
            nothing = np.full(self.grid.shape, np.inf, dtype=np.float32)
            return NodeDistances(nothing, np.full(self.grid.shape, -1, dtype=np.int16))
        distance, label = distance_to_lattice(lattice, self.grid)
        return NodeDistances(distance, label.astype(np.int16) - np.int16(1))

    def _known_distances(self, solids: list[Primitive | KnownMesh]) -> list[NodeDistances]:
        parts = []
        for item in solids:
            index = self.sources.index(f"known:{item.name}")
            if isinstance(item, KnownMesh):
                lattice = rasterize_mesh(item, self.grid, _CELLS)
                distance, _ = distance_to_lattice(lattice, self.grid)
            else:
                distance = np.empty(self.grid.shape, dtype=np.float32)
                for start in range(0, self.grid.shape[0], 16):
                    stop = min(start + 16, self.grid.shape[0])
                    exact = item.signed_distance(self.grid.slab(start, stop))
                    outside = np.maximum(exact - 1e-9, 0.0)
                    distance[start:stop] = round_down(outside).reshape(-1, *self.grid.shape[1:])
            source = np.full(self.grid.shape, index, dtype=np.int16)
            parts.append(NodeDistances(distance, source))
        return parts

    def _field(self, parts: list[NodeDistances]) -> DistanceField:
        nodes = combine(parts, self.grid)
        return finish(nodes, self.grid, self.sources, self.config.unobserved == "occupied")

    # --- queries ---------------------------------------------------------------

    def object_field(self, object_id: int) -> DistanceField:
        """Distance to one object alone: where P(occupied) >= level and it is the likeliest.

        Which object a point belongs to is resolved to half the grid's resolution.

        Raises:
            WorldError: the map has no such object.
        """
        (k,) = self._classes([object_id])
        key = ("only", frozenset([k]))
        if key not in self._cache:
            nodes = self._object_distances([k])
            self._cache[key] = finish(nodes, self.grid, self.sources, solid_outside=False)
        return self._cache[key]

    def fields_without(self, object_ids: Collection[int]) -> DistanceField:
        """Return the combined field without some objects, for contacts that are allowed.

        Occluded space inside the left-out objects' level set goes with them; occluded
        space beyond it stays, as do all other sources.

        Raises:
            WorldError: the map has no such object.
        """
        gone = frozenset(self._classes(object_ids))
        if not gone:
            return self.field
        key = ("without", gone)
        if key not in self._cache:
            rest = set(range(1, len(self.map.object_ids) + 1)) - gone
            kept = self._object_distances(rest)
            unseen = self._unseen_distances(self._unseen_outside(gone))
            self._cache[key] = self._field([kept, unseen, self._known])
        return self._cache[key]

    def _classes(self, object_ids: Collection[int]) -> list[int]:
        valid = list(self.map.object_ids)
        unknown = sorted(set(object_ids) - set(valid))
        if unknown:
            raise WorldError(f"no object {unknown[0]} in the map; it has {valid}")
        return [valid.index(i) + 1 for i in object_ids]

    def _unseen_outside(self, classes: Collection[int]) -> Lattice:
        """Return the unseen marks less some objects' seen surfaces, and less occluded nodes
        inside their level set."""
        labels = self._unseen.labels.copy()
        labels[np.isin(labels, [_BACKGROUND + k for k in classes])] = 0
        inside = rasterize_level_set(self._level_set, self._factor, classes)
        if inside is None:
            return Lattice(labels, self._unseen.corner, _CELLS)
        ratio = self._factor // _CELLS
        first = -(-inside.corner // ratio)  # first unseen node not below the fine corner
        skip = first * ratio - inside.corner
        fine = inside.labels[skip[0] :: ratio, skip[1] :: ratio, skip[2] :: ratio]
        start = first - self._unseen.corner
        low = np.maximum(start, 0)
        high = np.minimum(start + np.array(fine.shape), labels.shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        part = fine[tuple(slice(a, b) for a, b in zip(low - start, high - start, strict=True))]
        target = labels[window]
        target[(part != 0) & (target == _OCCLUDED)] = 0
        return Lattice(labels, self._unseen.corner, _CELLS)

    def status(self, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """What the cameras know of each world point, whatever the policies say.

        0: some view saw past it or up to it. 1 (occluded): behind what a view saw, or
        under the support surface. 2 (unobserved): outside every image, or no depth
        return. 3: outside the grid.

        Raises:
            WorldError: a point is not finite.
        """
        points = checked_points(points)
        status = visibility.classify_points(self._views, points)
        if self.map.plane is not None:
            status[self.map.plane.signed_distance(points) < 0.0] = visibility.OCCLUDED
        outside = ((points < self.grid.origin) | (points > self.grid.upper)).any(axis=1)
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

    @cached_property
    def empty(self) -> bool:
        """Whether nothing but half-spaces is an obstacle."""
        return bool((self.field.source < 0).all())


def _mark_corners(cells: UInt8[np.ndarray, "x y z"], nodes: UInt8[np.ndarray, "x1 y1 z1"]) -> None:
    """Give every node the largest mark of the eight cells around it."""
    x, y, z = cells.shape
    grown = np.zeros((x + 1, y, z), dtype=np.uint8)
    grown[:-1] = cells
    np.maximum(grown[1:], cells, out=grown[1:])
    wider = np.zeros((x + 1, y + 1, z), dtype=np.uint8)
    wider[:, :-1] = grown
    np.maximum(wider[:, 1:], grown, out=wider[:, 1:])
    nodes[:, :, :-1] = wider
    np.maximum(nodes[:, :, 1:], wider, out=nodes[:, :, 1:])


def _distance_to_faces(grid: Grid) -> np.ndarray:
    """Distance from every node to the nearest face of the grid's box, metres."""
    x, y, z = (np.minimum(np.arange(n), np.arange(n)[::-1]) for n in grid.shape)
    steps = np.minimum(np.minimum(x[:, None, None], y[None, :, None]), z)
    return round_down(grid.spacing * steps.astype(np.float64))
