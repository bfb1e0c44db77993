# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of the stages that no example draws, made of the bundled scene when they are absent."""

from pathlib import Path
from typing import Any

import numpy as np
from demo_map import fitted
from sphinx.application import Sphinx

_STEP = 0.004  # metres per pixel
_HEIGHT = 0.05  # metres above the table


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw before the pages are read."""
    app.connect("builder-inited", _draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _draw(app: Sphinx) -> None:
    folder = Path(app.srcdir) / "images" / "generated"
    if all((folder / name).is_file() for name in ("view.png", "world.png", "distance.png")):
        return
    import vprism_plan as vp
    from vprism_plan.viz import save_figure, scene_figure

    folder.mkdir(parents=True, exist_ok=True)
    world = vp.World(fitted())
    save_figure(scene_figure(world.map.views[0]), folder / "view.png")
    save_figure(_world_figure(world), folder / "world.png")
    save_figure(_distance_figure(world), folder / "distance.png")


def _slice(world: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.arange(-0.3, 0.45, _STEP), np.arange(-0.35, 0.35, _STEP)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), _HEIGHT)], axis=-1)
    return x, y, grid.reshape(-1, 3)


def _world_figure(world: Any) -> Any:
    """What the space at one height is, by where the knowledge of it comes from."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from vprism_plan.viz import object_color

    x, y, points = _slice(world)
    names = ("seen to be empty", "occluded", "unobserved")
    colors = np.array([[0.97, 0.97, 0.95], [0.45, 0.45, 0.48], [0.80, 0.83, 0.88]])
    picture = colors[np.minimum(world.status(points), 2)]
    entries = [Patch(color=tuple(c), label=n) for n, c in zip(names, colors, strict=True)]
    chances = world.map.predict_proba(points)
    for k, object_id in enumerate(world.map.object_ids, start=1):
        inside = (1.0 - chances[:, 0] >= 0.5) & (chances[:, 1:].argmax(axis=1) == k - 1)
        picture[inside] = object_color(object_id)
        entries.append(Patch(color=tuple(object_color(object_id)), label=f"object {object_id}"))
    figure = Figure(figsize=(7.4, 5.2), dpi=90, layout="constrained")
    axis = figure.subplots()
    axis.imshow(
        picture.reshape(len(y), len(x), 3), origin="lower", extent=(x[0], x[-1], y[0], y[-1])
    )
    axis.set(xlabel="x (m); the camera looks along +x", ylabel="y (m)")
    axis.set_title(f"{100 * _HEIGHT:.0f} cm above the table")
    figure.legend(handles=entries, loc="outside center right")
    return figure


def _distance_figure(world: Any) -> Any:
    """The bound that a checker reads, on the same slice."""
    from matplotlib.figure import Figure

    x, y, points = _slice(world)
    bound = 100 * world.field.lower_bound(points).reshape(len(y), len(x))
    figure = Figure(figsize=(8.2, 5.2), dpi=90, layout="constrained")
    axis = figure.subplots()
    levels = np.arange(-6.0, 24.1, 2.0)
    lines = axis.contourf(x, y, bound, levels=levels, cmap="RdYlBu", extend="both")
    axis.contour(x, y, bound, levels=[0.0], colors="black")
    axis.set_aspect("equal")
    axis.set(xlabel="x (m); the camera looks along +x", ylabel="y (m)")
    axis.set_title("lower bound of the distance; black: 0")
    figure.colorbar(lines, label="cm")
    return figure
