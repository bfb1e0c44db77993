# SPDX-License-Identifier: BSD-3-Clause
"""
Several views
=============

One view leaves shadows. A second one from another side fills them: a fitted map is updated with
it, or all views are fitted together. ::

    python examples/08_several_views.py [--picture FILE.png]
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import vprism_plan as vp
from vprism_plan.simulation import Camera, hidden_object_scene, render
from vprism_plan.viz import save_figure

parser = argparse.ArgumentParser(description="What a second view adds to a map.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/08.png"))
arguments = parser.parse_args()

# %%
# A generated scene: object 2 stands behind the large box 1, and not one pixel of it is seen from
# the first camera. The second camera looks from the other side. Both know their poses in one
# world frame, and ids mean the same object in both.
scene = hidden_object_scene(seed=3)
first = scene.observation
eye, middle = first.camera_center, np.array([0.0, 0.0, 0.08])
other_side = np.array([-eye[0], -eye[1], eye[2]])
second = render(scene, Camera.look_at(other_side, middle), noise=scene.noise, seed=4)
print(f"the first view shows objects {first.object_ids}, the second {second.object_ids}")

# %%
# ``update`` takes the old posterior as the prior of the new view. Here the new view shows an object
# that the map had no class for, so all views are fitted again together; ``vp.fit_map([first,
# second])`` asks for that from the start.
before = vp.fit_map(first)
after = before.update(second)
print(f"{len(before.hinge_points)} hinge points before, {len(after.hinge_points)} after")

# %%
# What the hidden space was worth: the map's belief in the box around the hidden object.
center = scene.solids[1].center
cube = center + 0.04 * (np.indices((9, 9, 9)).reshape(3, -1).T / 4.0 - 1.0)
truly = scene.signed_distance(cube) < 0
for name, m in (("one view", before), ("two views", after)):
    wrong = np.mean((m.occupancy(cube) - truly) ** 2)
    print(f"{name}: mean entropy {m.entropy(cube).mean():.2f} nats, Brier score {wrong:.3f}")

# %%
# The posterior now decides where a shadow made everything an obstacle: configurations behind the
# box that one view refused as occluded are free with two.
for name, m in (("one view", before), ("two views", after)):
    world = vp.World(m)
    known_free = (world.field.lower_bound(cube) > 0)[~truly].mean()
    print(f"{name}: {100 * known_free:.0f} % of the free points around it are known to be free")

# %%
# Entropy at half the hidden object's height. White: P(occupied) = 0.5. Dashed: true outlines.
x, y = (center[k] + np.arange(-0.25, 0.25, 0.004) for k in (0, 1))
points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), center[2])], axis=-1).reshape(
    -1, 3
)
truth = scene.signed_distance(points).reshape(len(y), len(x))
figure = Figure(figsize=(11, 4.6), layout="constrained")
axes = figure.subplots(1, 2)
for axis, name, m in ((axes[0], "one view", before), (axes[1], "two views", after)):
    extent = (x[0], x[-1], y[0], y[-1])
    shown = m.entropy(points).reshape(truth.shape)
    image = axis.imshow(shown, origin="lower", extent=extent, cmap="magma", vmin=0, vmax=np.log(4))
    axis.contour(x, y, m.occupancy(points).reshape(truth.shape), [0.5], colors="white")
    axis.contour(x, y, truth, [0.0], colors="#ff5fa2", linestyles="--")
    axis.set(title=f"entropy, {name}", xlabel="x (m)", ylabel="y (m)")
figure.colorbar(image, ax=axes, label="nats")
save_figure(figure, arguments.picture)
