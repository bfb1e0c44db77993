# SPDX-License-Identifier: BSD-3-Clause
"""FCL's second opinion against the distance field, per query, and how often they disagree.

python -m experiments.benchmarks.mesh_checker

Everything is timed in one run, in turns, and the ratios of the medians are printed.
"""

import time

import numpy as np

import vprism_plan as vp
from experiments.benchmarks._common import demo_checker, in_turns
from vprism_plan.collision import compare

ROUNDS = 7
CONFIGURATIONS = 100
COMPARED = 2000


def timed(call) -> tuple[float, object]:
    """Seconds of one call, and its result."""
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def main() -> None:
    checker = demo_checker()
    robot = checker.robot
    build, meshes = {}, {}
    for name, options in {
        "solids, 2.5 mm mesh": {},
        "solids, 10 mm mesh": {"resolution": 0.01},
        "spheres, 2.5 mm mesh": {"links": "spheres"},
    }.items():
        build[name], meshes[name] = timed(lambda o=options: vp.MeshChecker.like(checker, **o))
    rng = np.random.default_rng(0)
    Q = rng.uniform(robot.lower, robot.upper, (20 * CONFIGURATIONS, robot.dof))
    free = Q[checker.is_valid_batch(Q)]
    near = free[np.argsort(checker.clearance_batch(free))][:CONFIGURATIONS]
    calls = {
        "field is_valid": lambda: [checker.is_valid(q) for q in near],
        "field clearance": lambda: [checker.clearance(q) for q in near],
        "link_poses": lambda: [robot.link_poses(q) for q in near],
    }
    for name, judge in meshes.items():
        calls[f"{name}: is_valid"] = lambda j=judge: [j.is_valid(q) for q in near]
        calls[f"{name}: clearance"] = lambda j=judge: [j.clearance(q) for q in near]
    took = in_turns(calls, ROUNDS)
    result = {name: 1e6 * float(np.median(t)) / CONFIGURATIONS for name, t in took.items()}
    print(f"Panda in the demo scene, {CONFIGURATIONS} free configurations near obstacles")
    for name, judge in meshes.items():
        faces = sum(len(mesh.faces) for mesh in judge.surfaces.meshes.values())
        print(f"  {name:28s} {len(judge.solids)} shapes, {faces} triangles, {build[name]:.1f} s")
    for name, value in result.items():
        base = "field clearance" if name.endswith("clearance") else "field is_valid"
        print(f"  {name:32s} {value:9.1f} us   {value / result[base]:7.0f} x {base}")
    judge = meshes["solids, 2.5 mm mesh"]
    path = near[:2]
    seconds, opinion = timed(lambda: judge.review(checker, path))
    print(f"review of one edge: {opinion.configurations} configurations, {seconds:.2f} s")
    sample = rng.uniform(robot.lower, robot.upper, (COMPARED, robot.dof))
    for name in ("solids, 2.5 mm mesh", "spheres, 2.5 mm mesh"):
        print(f"{name}: {compare(checker, meshes[name], sample).text()}")


if __name__ == "__main__":
    main()
