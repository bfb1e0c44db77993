# SPDX-License-Identifier: BSD-3-Clause
"""
Look before you reach
=====================

Two hand poses behind a box. One view says of neither whether it is free. ``next_view`` says which
of 64 views would settle it; with that view in the map both are reached, the second over an object
that nobody had seen. ::

    python examples/09_look_before_you_reach.py [--picture FILE.png] [--view]
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import vprism_plan as vp
from vprism_plan.simulation import Camera, hidden_object_scene, render
from vprism_plan.viz import save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]  # radians

parser = argparse.ArgumentParser(description="Which view would let a motion through?")
parser.add_argument("--picture", type=Path, default=Path("out/examples/09.png"))
parser.add_argument("--view", action="store_true", help="then show it in the browser")
arguments = parser.parse_args()

# %%
# The scene: a box, and object 2 behind it, of which the first camera sees nothing.
scene = hidden_object_scene(seed=3)
first = scene.observation
base = np.eye(4)
base[0, 3] = -0.55
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=base)
m = vp.fit_map(first)

# %%
# Where the finger tips shall go, the hand straight down: 14 cm over the table, 14 and 10 cm behind
# the middle of the box. And where a camera could be: 64 places around the table.
box, eye = scene.solids[0].center, first.camera_center
behind = -(eye * [1.0, 1.0, 0.0]) / np.hypot(*eye[:2])
aside = np.array([-behind[1], behind[0], 0.0])
reaches = {}
for name, way in (("far", 0.14), ("near", 0.10)):
    hand = np.eye(4)
    hand[:3, :3] = np.column_stack([-behind, aside, [0.0, 0.0, -1.0]])
    hand[:3, 3] = [*(box + way * behind)[:2], 0.14]
    reaches[name] = hand
cameras = [
    Camera.orbit(np.array([0.0, 0.0, 0.08]), 0.9, azimuth, elevation)
    for azimuth in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    for elevation in (0.5, 0.7, 0.9, 1.1)
]
views = np.array([camera.T_world_camera for camera in cameras])

# %%
# Plan; if that is too risky, look where it would help most, and plan again.
maps, chosen = {}, {}
for name, hand in reaches.items():
    maps[name] = [m]
    for _ in range(3):
        checker = vp.CollisionChecker(vp.World(maps[name][-1]), robot)
        look = vp.next_view(checker, START, hand, views)
        print(f"{name}: {look.plan.status}, {look.plan.message.split(';')[0]}")
        if look.plan.solved or look.best is None:
            break
        print(f"  {look.text()}")
        chosen.setdefault(name, (look, cameras[look.best], checker))
        seen = render(scene, cameras[look.best], noise=scene.noise, seed=look.best)
        maps[name].append(maps[name][-1].update(seen))

# %%
# Left: what the first view leaves open, 2 to 20 cm over the table, and the candidate views
# around it, the better the brighter. Middle: what the best one sees. Right: what is known then.
look, camera, checker = chosen["far"]
figure = Figure(figsize=(13.5, 4.6), layout="constrained")
axes = figure.subplots(1, 3)
x = y = np.arange(-0.3, 0.3, 0.005)
heights = np.arange(0.02, 0.2, 0.03)
columns = np.stack(np.meshgrid(x, y, heights), axis=-1)
truth = scene.signed_distance(columns.reshape(-1, 3)).reshape(columns.shape[:3]).min(axis=2)
for axis, map_, title in (
    (axes[0], maps["far"][0], "one view"), (axes[2], maps["far"][-1], "and the chosen one"),
):  # fmt: skip
    occupied = map_.occupancy(columns.reshape(-1, 3)).reshape(columns.shape[:3]).max(axis=2)
    extent = (x[0], x[-1], y[0], y[-1])
    shown = axis.imshow(occupied, origin="lower", extent=extent, cmap="magma", vmin=0.0, vmax=1.0)
    axis.contour(x, y, truth, [0.0], colors="#ff5fa2", linestyles="--")
    for name, hand in reaches.items():
        axis.plot(*hand[:2, 3], "o" if name == "far" else "X", color="#7fd4ff")
    axis.set(title=f"largest P(occupied), {title}", xlabel="x (m)", ylabel="y (m)")
figure.colorbar(shown, ax=axes[2])
away = 0.33 * views[:, :2, 3]
worth = np.array([value.utility for value in look.values])
axes[0].scatter(*away.T, c=worth, cmap="viridis", s=18, vmin=0.0)
axes[0].plot(*away[look.best], "o", ms=11, mfc="none", color="#7fd4ff")
axes[0].plot(*(0.33 * eye[:2]), "w^")
axes[1].imshow(np.where(render(scene, camera).labels > 0, render(scene, camera).labels, np.nan))
axes[1].set(title="what the chosen view sees", xticks=[], yticks=[])
save_figure(figure, arguments.picture)

# %%
# The same in the browser: what was seen, the refused motion and its risk, the view to take.
if arguments.view:
    from vprism_plan.viz.viewer import Viewer

    viewer = Viewer(maps["far"][0], checker=checker, look=look)
    print(f"open {viewer.url}")
    viewer.wait()
