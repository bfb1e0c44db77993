# SPDX-License-Identifier: BSD-3-Clause
"""
A table that changes
====================

Somebody works at the table: a cup is pushed aside, a bottle is taken away, a can is put down. Every
step is seen once, the last from another side. ``update`` notices what has moved, left and come,
whatever the labels are numbered by; nothing of the old places stays. ::

    python examples/10_a_table_that_changes.py [--picture FILE.png]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import vprism_plan as vp
from vprism_plan.simulation import Box, Camera, DepthNoise, Scene, cylinder, render
from vprism_plan.simulation.scenes import upright
from vprism_plan.viz import save_figure

parser = argparse.ArgumentParser(description="A map that follows a table that changes.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/10.png"))
arguments = parser.parse_args()


# %%
# The recorded sequence: what stands where, and who looks, ten seconds apart.
def stand(height: float, x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return upright(np.array([x, y]), height, yaw)


cereal = Box((0.03, 0.09, 0.12), pose=stand(0.12, 0.04, 0.12, 0.3))
cup = cylinder(0.04, 0.05, stand(0.05, -0.06, -0.04))
bottle = cylinder(0.032, 0.11, stand(0.11, 0.06, -0.12))
can = cylinder(0.034, 0.05, stand(0.05, -0.12, 0.16))
pushed = replace(cup, pose=stand(0.05, -0.08, -0.2))
front = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.95, np.pi, 0.65)
side = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.95, 0.55 * np.pi, 0.75)
steps = [
    ("at first", {1: cereal, 2: cup, 3: bottle}, front),
    ("the cup is pushed aside", {1: cereal, 2: pushed, 3: bottle}, front),
    ("the bottle is taken away", {1: cereal, 2: pushed}, front),
    ("a can is put down", {1: cereal, 2: pushed, 4: can}, side),
]

# %%
# Segmentation starts anew in every image: its numbers mean nothing from one to the next.
rng = np.random.default_rng(3)
scenes, views = [], []
for step, (_, solids, camera) in enumerate(steps):
    scene = Scene(tuple(solids.values()), tuple(solids), camera, DepthNoise(), seed=step)
    seen = render(scene, camera, noise=scene.noise, seed=step)
    numbers = np.zeros(10, dtype=np.int32)
    numbers[list(solids)] = rng.permutation(len(solids)) + 1
    scenes.append(scene)
    views.append(replace(seen, labels=numbers[seen.labels], time=10.0 * step))

# %%
# The first view makes the map, every other one updates it. What is older than a minute is
# forgotten: its place is hidden then, not free. Nothing here is so old.
maps = [vp.fit_map(views[0])]
for (what, _, _), view in zip(steps[1:], views[1:], strict=True):
    maps.append(maps[-1].update(view, forget=60.0))
    found = maps[-1].changes
    print(f"{what}: moved {found.moved}, left {found.left}, came {found.came}, kept {found.kept}")

# %%
# Above: what the camera saw. Below: the most that is occupied 3 to 18 cm over the table, as the map
# believes; dashed: the true outlines, at 4 cm.
figure = Figure(figsize=(3.6 * len(steps), 7.0), layout="constrained")
axes = figure.subplots(2, len(steps))
x = y = np.arange(-0.3, 0.3, 0.005)
columns = np.stack(np.meshgrid(x, y, np.arange(0.03, 0.18, 0.03)), axis=-1)
slices = columns[:, :, 0] + [0.0, 0.0, 0.01]
for k, ((what, _, _), scene, view, m) in enumerate(zip(steps, scenes, views, maps, strict=True)):
    axes[0, k].imshow(view.color[60:420, 100:540])
    axes[0, k].set(title=f"{10 * k} s: {what}", xticks=[], yticks=[])
    occupied = m.occupancy(columns.reshape(-1, 3)).reshape(columns.shape[:3]).max(axis=2)
    extent = (x[0], x[-1], y[0], y[-1])
    axes[1, k].imshow(occupied, origin="lower", extent=extent, cmap="magma", vmin=0.0, vmax=1.0)
    truth = scene.signed_distance(slices.reshape(-1, 3)).reshape(slices.shape[:2])
    axes[1, k].contour(x, y, truth, [0.0], colors="#7fd4ff", linestyles="--")
    newest = m.views[-1]
    for i in newest.object_ids:
        at = newest.point_image()[(newest.labels == i) & (newest.depth > 0)].mean(axis=0)
        axes[1, k].annotate(str(i), at[:2], color="k", ha="center", va="center")
    axes[1, k].plot(*(0.3 * view.camera_center[:2]), "w^")
    axes[1, k].set(xlabel="x (m)")
axes[1, 0].set(ylabel="y (m)")
save_figure(figure, arguments.picture)
