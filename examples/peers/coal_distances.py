# SPDX-License-Identifier: BSD-3-Clause
"""
Coal measures the same distances
================================

Coal, the collision library of Pinocchio, holds the extracted surfaces against the robot's spheres.
Our clearance is a lower bound of that, and how far below it lies is printed. ::

    python examples/peers/coal_distances.py [--map MAP.safetensors]   # pip install coal
"""

import argparse
from pathlib import Path

import coal
import numpy as np

import vprism_plan as vp

DATA = Path(vp.__file__).parent / "data"
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Distances to extracted meshes by Coal.")
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
saved = parser.parse_args().map
m = vp.load_map(saved) if saved else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
world = vp.World(m)

# %%
# The surfaces of the objects, as Coal takes triangles.
surfaces = {}
for object_id, mesh in vp.extract_meshes(m, resolution=0.004).items():
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(mesh.faces), len(mesh.vertices))
    model.addVertices(np.asarray(mesh.vertices))
    model.addTriangles(np.asarray(mesh.faces, dtype=np.int32))
    model.endModel()
    surfaces[object_id] = model


def coal_distance(surface: coal.BVHModelOBBRSS, q: np.ndarray) -> float:
    """Metres from the spheres to a surface; Coal's meshes are hollow, so only from outside."""
    gaps = []
    for center, radius in zip(robot.sphere_centers(q), robot.sphere_radii, strict=True):
        place, result = coal.Transform3s(np.eye(3), np.array(center)), coal.DistanceResult()
        point = coal.Sphere(1e-9)
        coal.distance(surface, coal.Transform3s(), point, place, coal.DistanceRequest(), result)
        gaps.append(result.min_distance - radius)
    return min(gaps)


# %%
# Random postures, object by object.
rng, below = np.random.default_rng(0), []
for q in rng.uniform(robot.lower, robot.upper, (40, robot.dof)):
    for object_id, surface in surfaces.items():
        field = world.object_field(object_id)
        ours = float((field.lower_bound(robot.sphere_centers(q)) - robot.sphere_radii).min())
        if ours > 0.0:
            below.append(coal_distance(surface, q) - ours)
low, high = 1000 * min(below), 1000 * max(below)
print(f"{len(below)} distances: ours are {low:.1f} to {high:.1f} mm below Coal's")
