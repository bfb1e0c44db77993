# SPDX-License-Identifier: BSD-3-Clause
"""
A map from one image
====================

One depth image with an object id per pixel becomes a map that answers two questions at any
point in space: which object is there, and how sure is that. ::

    python examples/01_map_from_an_image.py [--picture FILE.png]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import vprism_plan as vp
from vprism_plan.viz import map_figure, save_figure

DATA = Path(vp.__file__).parent / "data"

parser = argparse.ArgumentParser(description="Fit a map to the bundled view and ask it.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/01.png"))
arguments = parser.parse_args()

# %%
# The view: depth in metres, labels (0 is background), camera intrinsics, and the camera's pose in
# the world (z up). Unlabelled views go through ``vp.segment_tabletop`` first, views without a pose
# through ``vp.align_to_table``. Your own arrays make an ``vp.Observation(depth, labels, intrinsics,
# T_world_camera)``.
view = vp.load_observation(DATA / "demo_scene")
points, labels = view.points()
print(f"{len(points)} points, objects {view.object_ids}, camera at {view.camera_center.round(2)} m")

# %%
# The fit: negative samples along the rays, hinge points near the objects, EM. The bound on the
# evidence never falls from one iteration to the next.
m = vp.fit_map(view, vp.MapConfig(), seed=0)
print(f"{len(m.hinge_points)} hinge points; bound {np.round(m.history).astype(int).tolist()} nats")

# %%
# Three places: on the tall box as the camera saw it, in front of it where rays passed, and behind
# it, where nothing was seen.
face = np.median(points[labels == 1], axis=0)
sight = (face - view.camera_center) * [1, 1, 0]
sight /= np.linalg.norm(sight)
places = {
    "on its face": face,
    "5 cm before": face - 0.05 * sight,
    "10 cm behind": face + 0.10 * sight,
}
asked = np.array(list(places.values()))
chances, nats, mass = m.predict_proba(asked), m.entropy(asked), m.support(asked)
for i, name in enumerate(places):
    k = int(chances[i].argmax())
    likely = "empty" if k == 0 else f"object {m.object_ids[k - 1]}"
    occupied = 1.0 - chances[i, 0]
    print(f"{name}: P(occupied) {occupied:.2f}, most probably {likely};", end=" ")
    print(f"entropy {nats[i]:.2f} nats, kernel mass {mass[i]:.1f}")

# %%
# Surfaces, and a file that gives the same answers bit by bit.
for object_id, mesh in vp.extract_meshes(m, level=0.5, resolution=0.01).items():
    print(f"object {object_id}: {1e6 * mesh.volume:.0f} cm^3, watertight: {mesh.is_watertight}")
with tempfile.TemporaryDirectory() as folder:
    m.save(Path(folder) / "map.safetensors")
    again = vp.load_map(Path(folder) / "map.safetensors")
print(
    "loaded map answers the same:",
    bool((again.predict_proba(asked) == m.predict_proba(asked)).all()),
)

# %%
# Occupancy and entropy on two slices. Hatched space is hidden from the camera: the entropy is high
# there, and by default a world built on this map treats it as an obstacle.
save_figure(map_figure(m), arguments.picture)
