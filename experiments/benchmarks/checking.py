# SPDX-License-Identifier: BSD-3-Clause
"""A whole state check against its own kinematics, and against FCL on the same spheres.

python -m experiments.benchmarks.checking

Everything is timed in one run, in turns, and the ratios of the medians are printed.
"""

import fcl
import numpy as np

import vprism_plan as vp
from experiments.benchmarks._common import demo_checker, in_turns
from vprism_plan._kernels import checking as kernels

ROUNDS = 15
CONFIGURATIONS = 1000
FCL_CONFIGURATIONS = 60


class FclSpheres:
    """The robot's moving spheres against the extracted meshes, broad phase included."""

    def __init__(self, checker: vp.CollisionChecker) -> None:
        self.checker = checker
        robot = checker.robot
        self.moving = np.flatnonzero(~robot.arrays.link_fixed[robot.sphere_links])
        self.meshes = fcl.DynamicAABBTreeCollisionManager()
        bodies = []
        self.faces = 0
        for mesh in vp.extract_meshes(checker.world.map).values():
            model = fcl.BVHModel()
            model.beginModel(len(mesh.vertices), len(mesh.faces))
            model.addSubModel(np.asarray(mesh.vertices), np.asarray(mesh.faces))
            model.endModel()
            bodies.append(fcl.CollisionObject(model, fcl.Transform()))
            self.faces += len(mesh.faces)
        self.meshes.registerObjects(bodies)
        self.meshes.setup()
        self.spheres = [
            fcl.CollisionObject(fcl.Sphere(float(robot.sphere_radii[s]))) for s in self.moving
        ]

    def free(self, q: np.ndarray) -> bool:
        """Whether no sphere touches a mesh (the inside of a mesh is not seen by FCL)."""
        centers = self.checker.sphere_clearances(q)[0]
        for s, body in zip(self.moving, self.spheres, strict=True):
            body.setTranslation(centers[s])
            data = fcl.CollisionData()
            self.meshes.collide(body, data, fcl.defaultCollisionCallback)
            if data.result.is_collision:
                return False
        return True


def main() -> None:
    checker = demo_checker()
    robot = checker.robot
    rng = np.random.default_rng(0)
    Q = rng.uniform(robot.lower, robot.upper, (CONFIGURATIONS, robot.dof))
    free = Q[checker.is_valid_batch(Q)]
    free = np.resize(free, (CONFIGURATIONS, robot.dof))
    few = free[:FCL_CONFIGURATIONS]
    placed = np.empty((3, len(robot.sphere_radii)))
    rf, ri = checker._rf, checker._ri
    peer = FclSpheres(checker)
    calls = {
        "kinematics": lambda: [kernels.place_spheres(q, rf, ri, placed) for q in free],
        "is_valid, free": lambda: [checker.is_valid(q) for q in free],
        "is_valid, random": lambda: [checker.is_valid(q) for q in Q],
        "is_valid_batch, free": lambda: checker.is_valid_batch(free),
        "clearance, free": lambda: [checker.clearance(q) for q in few],
        "python-fcl, free": lambda: [peer.free(q) for q in few],
    }
    n = dict.fromkeys(calls, CONFIGURATIONS)
    n["clearance, free"] = n["python-fcl, free"] = FCL_CONFIGURATIONS
    took = in_turns(calls, ROUNDS)
    result = {name: 1e6 * float(np.median(t)) / n[name] for name, t in took.items()}
    print(
        f"Panda, {len(robot.sphere_radii)} spheres, {len(robot.collision_pairs)} link pairs; "
        f"{checker.world.field.distance.size} nodes; FCL meshes of {peer.faces} faces; "
        f"{checker.is_valid_batch(Q).mean():.0%} of random configurations are free"
    )
    for name, value in result.items():
        print(f"  {name:22s} {value:9.2f} us per configuration")
    valid = result["is_valid, free"]
    against = valid / result["kinematics"]
    print(f"is_valid / kinematics of the same spheres: {against:.2f} (target <= 3)")
    print(f"python-fcl / is_valid: {result['python-fcl, free'] / valid:.0f} (target >= 30)")


if __name__ == "__main__":
    main()
