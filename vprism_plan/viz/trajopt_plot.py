# SPDX-License-Identifier: BSD-3-Clause
"""What the optimiser did: where the hand went before and after, and how the costs fell."""

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan.viz._figures import PALETTE, legend, line, name_axes, new_figure, object_color
from vprism_plan.viz.plan_plot import GOAL_COLOR, HAND_COLOR, START_COLOR, hand_path, resample
from vprism_plan.world.sources import source_of

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.trajopt import OptimizeResult

_BEGUN: dict[str, Any] = {"color": "0.62", "linestyle": ":"}
_ENDED: dict[str, Any] = {"color": "#2f6d8f", "linewidth": 0.9}
_GIVEN: dict[str, Any] = {"color": "#1b1b1b", "dashes": (4, 2)}
_BEST: dict[str, Any] = {"color": HAND_COLOR, "linewidth": 2.4}
_UNSEEN = np.array([0.80, 0.80, 0.80])
_OTHER = np.array([0.45, 0.42, 0.40])
_PAD = 0.06  # metres around what is shown
_TERMS = ("#1b1b1b", "#d1603d", "#2f7ebc", "#5a9e4b", "#c9a227", "#7b3294")
_LOWEST = 1e-6  # of a cost that is drawn, as a share of the largest


def trajopt_figure(
    checker: "CollisionChecker",
    result: "OptimizeResult",
    *,
    given: Float[np.ndarray, "t dof"] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw the hand's paths over the world from above and from the side, and the costs' history.

    Args:
        checker: the one that was optimised with, over a `World` with z up.
        result: of `optimize`; one that never began (an invalid start) has no history.
        given: an initial path (t, dof), to be drawn as it was given.
        title: above all panels.

    Raises:
        ValueError: the optimisation never began.
    """
    history, begun, ended = result.history, result.begun, result.ended
    if history is None or begun is None or ended is None:
        raise ValueError(f"there is nothing to draw: {result.message}")
    world: Any = checker.world
    ways = [(path, {**_BEGUN, "linewidth": 0.9}) for path in begun]
    ways += [(path, {**_ENDED, "alpha": 0.8}) for path in ended]
    entries: list[Line2D | Patch] = [
        line("seeds as they began", **_BEGUN),
        line("seeds as they ended", **_ENDED),
    ]
    if given is not None:
        ways.append((np.asarray(given, dtype=np.float64), {**_GIVEN, "linewidth": 1.4}))
        entries.append(line("the path that was given", **_GIVEN))
    if result.path is not None:
        ways += [(result.path, {"color": "white", "linewidth": 4.0}), (result.path, _BEST)]
        entries.append(line("returned, verified", **_BEST))
    hands = [(hand_path(checker.robot, resample(path, 120)), style) for path, style in ways]
    low, high = _box(world, [hand for hand, _ in hands[len(begun) :]])
    sizes = high - low
    side = int(np.argmax(sizes[:2]))
    tall = 0.45 * 12.6 * max(sizes[1] / sizes[0], sizes[2] / sizes[side])
    tall = float(np.clip(tall, 2.6, 6.0))
    figure = new_figure(12.6, tall + 4.4, title)
    axes = figure.subplots(2, 2, gridspec_kw={"height_ratios": [tall, 3.0]})
    first, last = hands[len(begun)][0][[0, -1]]
    views = ((0, 1, "from above"), (side, 2, "from the side"))
    for axis, (a, b, name) in zip(axes[0], views, strict=True):
        _draw_world(axis, world, a, b)
        for hand, style in hands:
            axis.plot(hand[:, a], hand[:, b], **style)
        for end, color in ((first, START_COLOR), (last, GOAL_COLOR)):
            axis.plot(end[a], end[b], "o", color=color, markersize=8, zorder=5)
        axis.set(xlim=(low[a], high[a]), ylim=(low[b], high[b]), aspect="equal")
        name_axes(axis, f"path of the hand, {name}", f"{'xyz'[a]} (m)", f"{'xyz'[b]} (m)")
    _draw_costs(axes[1, 0], axes[1, 1], result, history)
    entries += [
        line("start", marker="o", linestyle="", color=START_COLOR),
        line("goal", marker="o", linestyle="", color=GOAL_COLOR),
        Patch(color=tuple(_UNSEEN), label="unseen, an obstacle by policy"),
        Patch(color=tuple(_OTHER), label="other obstacles"),
        *(Patch(color=tuple(_shade(i)), label=f"object {i}") for i in world.map.object_ids),
    ]
    legend(figure, entries, 5)
    return figure


def _box(world: Any, hands: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what is worth showing: what became of the seeds, and the objects."""
    field = world.field
    solid = (field.distance <= 0.0) & (field.source < len(world.map.object_ids))
    points = np.concatenate([*hands, field.origin + field.spacing * np.argwhere(solid)])
    return points.min(axis=0) - _PAD, points.max(axis=0) + _PAD


def _draw_world(axis: Axes, world: Any, a: int, b: int) -> None:
    """Shadows of the obstacles on a plane of two axes: objects over everything else."""
    field = world.field
    objects = len(world.map.object_ids)
    names = np.where(field.distance <= 0.0, field.source, -1)
    image = np.ones((field.distance.shape[a], field.distance.shape[b], 3))
    unseen = {k for k, name in enumerate(world.sources) if source_of(name).policy}
    others = [k for k in range(objects, len(world.sources)) if k not in unseen]
    colors = dict.fromkeys(sorted(unseen), _UNSEEN) | dict.fromkeys(others, _OTHER)
    colors |= {k: _shade(object_id) for k, object_id in enumerate(world.map.object_ids)}
    for k, color in colors.items():
        image[(names == k).any(axis=3 - a - b)] = color
    low, high = field.origin - 0.5 * field.spacing, field.upper + 0.5 * field.spacing
    extent = (low[a], high[a], low[b], high[b])
    axis.imshow(np.swapaxes(image, 0, 1), origin="lower", extent=extent, aspect="auto")
    plane = world.map.plane
    if b == 2 and plane is not None and abs(plane.normal[2]) > 0.99:
        axis.axhspan(-10.0, plane.offset / plane.normal[2], color="0.35", linewidth=0)


def _shade(object_id: int) -> np.ndarray:
    """An object's colour, light enough for lines on top."""
    return 0.35 + 0.65 * object_color(object_id)


def _draw_costs(left: Axes, right: Axes, result: "OptimizeResult", history: Any) -> None:
    """The terms of the winner, or of the seed of least cost; the cost of each seed."""
    seeds, winner = result.report.seeds, result.report.winner
    shown = int(np.argmin([seed.cost for seed in seeds])) if winner is None else winner
    rows = np.arange(1, len(history.cost) + 1)
    left.plot(rows, history.cost[:, shown], color="0.75", linewidth=4.0, label="sum")
    terms = np.stack([values[:, shown] for values in history.terms.values()])
    for name, values, color in zip(history.terms, terms, cycle(_TERMS), strict=False):
        left.plot(rows, np.where(values > 0.0, values, np.nan), color=color, label=name)
    _finish(left, history, terms, f"terms of seed {shown} ({seeds[shown].name})")
    for number, seed in enumerate(seeds):
        style = {"color": PALETTE[number % len(PALETTE)], "linewidth": 1.2, "zorder": 2}
        if number == winner:
            style = {"color": HAND_COLOR, "linewidth": 2.6, "zorder": 3}
        note = " (returned)" if number == winner else " (refused)" if seed.refused else ""
        style |= {"linestyle": "--" if seed.refused else "-", "label": f"{seed.name}{note}"}
        right.plot(rows, history.cost[:, number], **style)
    _finish(right, history, history.cost, "cost of each seed", columns=1 + (len(seeds) > 6))


def _finish(axis: Axes, history: Any, shown: np.ndarray, name: str, columns: int = 1) -> None:
    """Logarithmic axes around the positive values that are shown."""
    top = float(np.max(history.cost[np.isfinite(history.cost)], initial=_LOWEST))
    least = float(np.min(shown[shown > 0.0], initial=top))
    axis.set_yscale("log")
    axis.set_ylim(max(0.6 * least, _LOWEST * top), 2.0 * top)
    for row in np.flatnonzero(np.diff(history.round)):
        axis.axvline(row + 1.5, color="0.6", linewidth=0.8, linestyle="--")
    name_axes(axis, name, "batch of evaluations", "cost")
    axis.grid(alpha=0.25)
    axis.legend(loc="upper right", fontsize=8, ncols=columns)
