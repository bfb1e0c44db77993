# SPDX-License-Identifier: BSD-3-Clause
"""The distance to one obstacle of a world alone, whatever else is nearer."""

from collections.abc import Collection

import numpy as np

from vprism_plan.errors import WorldError
from vprism_plan.world.distance import (
    DistanceField,
    Lattice,
    NodeDistances,
    combine,
    distance_to_lattice,
    finish,
)
from vprism_plan.world.known import HalfSpace, KnownMesh, Primitive
from vprism_plan.world.marks import unmark
from vprism_plan.world.world import SUPPORT, World


def source_field(world: World, name: str, without: Collection[int] = ()) -> DistanceField:
    """Distance to one of `world.sources` alone; baked on first use and kept with the world.

    At no node is it below `world.field`, so neither are the bounds between nodes; the
    smallest over all sources is `world.field` wherever that is positive, less the end of what
    was judged, metres away. An object's own field holds its level set and its seen surfaces
    off it.

    Args:
        world: the world.
        name: one of `world.sources`.
        without: objects whose part of the occluded space, and of cells they share with this
            obstacle, is left out, as `World.fields_without` does; nothing is, of their own.

    Returns:
        The field; its `source` is -1 everywhere if there is no such obstacle.

    Raises:
        WorldError: the world has no such source, or the map no such object.
    """
    if name not in world.sources:
        raise WorldError(f"no source {name!r} in this world; it has {', '.join(world.sources)}")
    gone = frozenset(world._classes(without))
    if name.startswith(("known:", SUPPORT)) or name in {f"object:{i}" for i in without}:
        gone = frozenset()
    key = (name, gone)
    if key not in world._cache:
        world._cache[key] = _bake(world, name, gone)
    return world._cache[key]


def _bake(world: World, name: str, gone: frozenset[int]) -> DistanceField:
    index = world.sources.index(name)
    solid_outside = name == "unobserved" and world.config.unobserved == "occupied"
    beyond: DistanceField | None = None
    if name.startswith("known:"):
        solids: list[Primitive | KnownMesh] = [
            k
            for k in world.config.known
            if not isinstance(k, HalfSpace) and f"known:{k.name}" == name
        ]
        nodes = combine(world._known_distances(solids), world.grid)
    elif name == SUPPORT:
        nodes = combine(world._support_distances(world.grid), world.grid)
        rim = combine(world._support_distances(world._grid_beyond), world._grid_beyond)
        beyond = finish(rim, world._grid_beyond, world.sources, False)
    else:
        marks = world._without(world._unseen, gone) if gone else world._unseen
        mark = int(np.flatnonzero(world._sources_of_marks() == index)[0])
        own, found = distance_to_lattice(_only(marks, mark), world.grid)
        parts = [NodeDistances(own, found.astype(np.int16))]
        if index < len(world.map.object_ids):
            parts.append(world._object_distances([index + 1]))
        if world._marks_beyond is not None:
            far = unmark(world._marks_beyond, gone, None)
            beyond, inside = world._around(_only(far, mark), False)
            parts += inside
        nodes = combine(parts, world.grid)
    distance = nodes.distance
    if solid_outside:  # the world's own distances stop at the faces of the grid
        faces = world._unseen_distances(_nothing(world._unseen)).distance
        distance = np.minimum(distance, faces)
    named = np.where(np.isfinite(distance), np.int16(index), np.int16(-1))
    nodes = NodeDistances(distance, named)
    return finish(nodes, world.grid, world.sources, solid_outside, beyond)


def _nothing(marks: Lattice) -> Lattice:
    return Lattice(np.zeros_like(marks.labels), marks.corner, marks.factor)


def _only(marks: Lattice, label: int) -> Lattice:
    """Keep one label, and the whole of every obstacle cell that it has a corner of.

    A cell whose corners carry several labels counts for each: no part of an obstacle
    is lost between two names.
    """
    own = marks.labels == label
    box = _box(own)
    if box is not None:
        near, marked = own[box], marks.labels[box] > 0
        cell = np.ones(tuple(n - 1 for n in near.shape), dtype=bool)
        touched = np.zeros_like(cell)
        for corner in _corners(near.shape):
            cell &= marked[corner]
            touched |= near[corner]
        cell &= touched
        for corner in _corners(near.shape):
            near[corner] |= cell
    return Lattice(own.view(np.uint8), marks.corner, marks.factor)


def _box(mask: np.ndarray) -> tuple[slice, ...] | None:
    """Slices of the box of the true entries, one more on every side; None if there are none."""
    slices = []
    for axis, n in enumerate(mask.shape):
        others = tuple(a for a in range(mask.ndim) if a != axis)
        hits = np.flatnonzero(mask.any(axis=others))
        if len(hits) == 0:
            return None
        slices.append(slice(max(0, int(hits[0]) - 1), min(n, int(hits[-1]) + 2)))
    return tuple(slices)


def _corners(shape: tuple[int, ...]) -> list[tuple[slice, ...]]:
    """Windows of an array of nodes: the eight corners of all its cells."""
    return [
        tuple(slice(bit, n - 1 + bit) for bit, n in zip(bits, shape, strict=True))
        for bits in np.ndindex(2, 2, 2)
    ]
