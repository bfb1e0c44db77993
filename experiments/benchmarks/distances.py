# SPDX-License-Identifier: BSD-3-Clause
"""How much too near the distance field says that obstacles are, and what it costs.

python -m experiments.benchmarks.distances [--map FILE]

Every figure beside the same field without its near nodes (the grid alone), in the same process.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

import vprism_plan as vp
from experiments.benchmarks._common import GOAL, START, demo_checker, in_turns
from vprism_plan.world import Box, KnownMesh, WorldConfig
from vprism_plan.world.distance import NO_NEAR, NO_ROWS, Lattice, finish, lower_bounds

WITHIN = 0.03  # metres
ROUNDS = 40
CONFIGURATIONS = 4000


def grid_alone(field):
    return replace(field, near=NO_NEAR, rows=NO_ROWS)


def cells_of(lattices: list[Lattice], spacing: float) -> tuple[cKDTree, np.ndarray]:
    """All cells of the lattices: a tree of their middles, and half their edges."""
    middles, halves = [], []
    for lattice in lattices:
        marked = lattice.labels > 0
        for axis in range(3):
            low = marked.take(range(marked.shape[axis] - 1), axis)
            marked = low & marked.take(range(1, marked.shape[axis]), axis)
        index = np.argwhere(marked)
        edge = spacing / lattice.factor
        middles.append(edge * (index + lattice.corner + 0.5))
        halves.append(np.full(len(index), 0.5 * edge))
    return cKDTree(np.concatenate(middles)), np.concatenate(halves)


def distance_to(cells: tuple[cKDTree, np.ndarray], points: np.ndarray) -> np.ndarray:
    tree, half = cells
    near = tree.query(points, 24)[1]
    gap = np.abs(tree.data[near] - points[:, None]) - half[near][..., None]
    return np.sqrt((np.maximum(gap, 0.0) ** 2).sum(axis=-1)).min(axis=1)


def report(name: str, field, points: np.ndarray, truth: np.ndarray) -> None:
    chosen = (truth > 0) & (truth <= WITHIN)
    chosen &= ((points >= field.origin) & (points <= field.upper)).all(axis=1)
    for what, one in (("grid alone", grid_alone(field)), ("near nodes", field)):
        loss = 1e3 * (truth - np.maximum(one.lower_bound(points), 0.0))[chosen]
        print(f"  {name:34s} {what}  mean {loss.mean():5.2f}  95 % {np.quantile(loss, 0.95):5.2f}"
              f"  max {loss.max():5.2f}  least {loss.min():6.3f} mm")  # fmt: skip


def around(points: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Points up to `WITHIN` and a little more from some of those given."""
    way = rng.normal(size=(n, 3))
    way *= (rng.uniform(0, 1.2 * WITHIN, n) / np.linalg.norm(way, axis=1))[:, None]
    return rng.choice(points, n) + way


def refused(checker, cells, Q: np.ndarray) -> None:
    """How many configurations that the exact cells accept the field refuses."""
    robot = checker.robot
    moving = np.flatnonzero(~robot.arrays.link_fixed[robot.sphere_links])
    verdict = {"near nodes": 0, "grid alone": 0}
    free = close = 0
    plain = grid_alone(checker.world.field)
    for q in Q:
        centers, plane, _, bound = checker.sphere_clearances(q)
        own = checker.pair_gaps(q)[0].min()
        radii = robot.sphere_radii[moving]
        clear = distance_to(cells, centers[moving]) - radii
        margin = checker.config.margin
        if clear.min() > 0.05 or plane[moving].min() <= margin or own <= checker.config.self_margin:
            continue
        close += 1
        if clear.min() <= margin or checker.world.field.lower_bound(centers[moving]).min() <= 0:
            continue
        free += 1
        verdict["near nodes"] += bound[moving].min() <= margin
        alone = plain.lower_bound(centers[moving]) - radii
        verdict["grid alone"] += alone.min() <= margin
    print(f"configurations within 5 cm of an obstacle: {close}, of these free {free}; refused:")
    for what, n in verdict.items():
        print(f"  {what}  {n} ({n / max(free, 1):.1%})")


def known_shapes(map_, rng: np.random.Generator) -> None:
    shift = np.array([0.1, 0.05, 0.6])  # above everything else
    shapes = {
        "known Box": Box("box", [0.1, 0.07, 0.05], turned(shift)),
        "known mesh (icosphere)": KnownMesh(
            "ball", trimesh.creation.icosphere(3, 0.05).apply_translation(shift)
        ),
    }
    for name, shape in shapes.items():
        start = time.perf_counter()
        world = vp.World(map_, WorldConfig(known=(shape,)))
        took = world.timings["known geometry"]
        total = time.perf_counter() - start
        mesh = shape.mesh if isinstance(shape, KnownMesh) else None
        seeds = mesh.sample(500) if mesh is not None else shift + rng.uniform(-0.05, 0.05, (500, 3))
        points = around(seeds, 3000, rng)
        if mesh is not None:
            truth = -trimesh.proximity.signed_distance(mesh, points)
        else:
            truth = shape.signed_distance(points)
        print(f"{name}: {took:.2f} s of a bake of {total:.2f} s")
        report(name, world.source_field(f"known:{shape.name}"), points, truth)


def turned(shift: np.ndarray) -> np.ndarray:
    pose = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)
    pose[:3, 3] = shift
    return pose


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the distance field.")
    parser.add_argument("--map", type=Path, help="a saved map to use instead of fitting one")
    arguments = parser.parse_args()
    checker = demo_checker(arguments.map)
    world, rng = checker.world, np.random.default_rng(0)
    field = world.field
    grid_bytes = field.distance.nbytes + field.source.nbytes
    near_bytes = field.near.nbytes + field.rows.nbytes
    parts = [world._objects, *world._others, world._known]

    start = time.process_time()
    world._field(parts)
    with_near = time.process_time() - start
    start = time.process_time()
    vp.World(world.map)
    bake = time.process_time() - start
    print(f"grid {grid_bytes / 1e6:.1f} MB, near nodes {near_bytes / 1e6:.1f} MB "
          f"({1 + near_bytes / grid_bytes:.2f} times); processor time of a bake {bake:.2f} s, "
          f"of it the combined field {with_near:.2f} s")  # fmt: skip

    print(f"loss within {1e3 * WITHIN:g} mm of a surface")
    lattices = [e for p in parts for e in p.exact if isinstance(e, Lattice)]
    cells = cells_of(lattices, field.spacing)
    points = around(cells[0].data, 40_000, rng)
    for part in world._from_beyond:  # rough bounds of what lies outside the grid
        points = points[lower_bounds(points, world.grid, part.distance) > 2 * WITHIN]
    report("cells of objects and marks", field, points, distance_to(cells, points))
    meshes = [
        trimesh.Trimesh(mesh.vertices, mesh.faces)
        for mesh in vp.extract_meshes(world.map, resolution=0.0025).values()
    ]
    points = around(np.concatenate([m.sample(1000, seed=0) for m in meshes]), 3000, rng)
    truth = -np.max([trimesh.proximity.signed_distance(m, points) for m in meshes], axis=0)
    objects = finish(world._objects, world.grid, world.sources, False, near=True)
    report("level set of all objects", objects, points, truth)
    cover = cells_of(list(world._objects.exact), field.spacing)
    loss = 1e3 * (truth - distance_to(cover, points))[(truth > 0) & (truth <= WITHIN)]
    print(f"  of that the cells that cover it: mean {loss.mean():.2f}, max {loss.max():.2f} mm")

    known_shapes(world.map, rng)
    robot = checker.robot
    Q = rng.uniform(robot.lower, robot.upper, (CONFIGURATIONS, robot.dof))
    way = rng.uniform(0.0, 1.0, (len(Q), 1))
    beside = (1 - way) * START + way * GOAL + rng.normal(0.0, 0.3, Q.shape)
    refused(checker, cells, np.clip(beside, robot.lower, robot.upper))

    full = checker._world
    alone = (full[0], full[1], NO_NEAR, full[3])
    free = np.resize(Q[checker.is_valid_batch(Q)], (1000, robot.dof))

    def ask(packed, rows):
        checker._world = packed
        for q in rows:
            checker.is_valid(q)

    tasks = {
        "free, near nodes": lambda: ask(full, free),
        "free, grid alone": lambda: ask(alone, free),
        "random, near nodes": lambda: ask(full, Q[:1000]),
        "random, grid alone": lambda: ask(alone, Q[:1000]),
    }
    for name, took in in_turns(tasks, ROUNDS).items():
        print(f"is_valid, {name:20s} {1e3 * np.min(took):6.2f} us")


if __name__ == "__main__":
    main()
