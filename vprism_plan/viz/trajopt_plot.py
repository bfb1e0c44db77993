# SPDX-License-Identifier: BSD-3-Clause
"""What the optimiser did: where the hand went before and after, and how the costs fell."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan.viz._figures import PALETTE, new_figure, object_color
from vprism_plan.viz.plan_plot import GOAL_COLOR, HAND_COLOR, START_COLOR, hand_path, resample
from vprism_plan.world.sources import source_of

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.trajopt import OptimizeResult

_BEGUN, _ENDED, _GIVEN = "0.62", "#2f6d8f", "#1b1b1b"
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
    if result.history is None or result.begun is None or result.ended is None:
        raise ValueError(f"there is nothing to draw: {result.message}")
    paths = _Paths(checker, result, given)
    low, high = paths.box()
    sizes = high - low
    side = int(np.argmax(sizes[:2]))
    width = 12.6
    height = 0.45 * width * max(sizes[1] / sizes[0], sizes[2] / sizes[side])
    tall = float(np.clip(height, 2.6, 6.0))
    figure = new_figure(width, tall + 4.4)
    axes = figure.subplots(2, 2, gridspec_kw={"height_ratios": [tall, 3.0]})
    if title:
        figure.suptitle(title)
    for axis, (a, b), name in (
        (axes[0, 0], (0, 1), "from above"),
        (axes[0, 1], (side, 2), "from the side"),
    ):
        _draw_world(axis, checker.world, a, b)
        paths.draw(axis, a, b)
        axis.set_xlim(low[a], high[a])
        axis.set_ylim(low[b], high[b])
        axis.set_aspect("equal")
        axis.set_xlabel(f"{'xyz'[a]} (m)")
        axis.set_ylabel(f"{'xyz'[b]} (m)")
        axis.set_title(f"path of the hand, {name}", fontsize=10)
    _draw_terms(axes[1, 0], result)
    _draw_seeds(axes[1, 1], result)
    _legend(figure, paths, checker.world)
    return figure


class _Paths:
    """Ways of the hand, (n, 3) each, metres."""

    def __init__(self, checker: Any, result: "OptimizeResult", given: Any) -> None:
        robot = checker.robot
        assert result.begun is not None
        assert result.ended is not None

        def hand(path: np.ndarray) -> np.ndarray:
            return hand_path(robot, resample(path, 120))

        self.begun = [hand(path) for path in result.begun]
        self.ended = [hand(path) for path in result.ended]
        self.path = None if result.path is None else hand(result.path)
        self.given = None if given is None else hand(np.asarray(given, dtype=np.float64))
        field = checker.world.field
        self.solid = field.origin + field.spacing * np.argwhere(
            (field.distance <= 0.0) & (field.source < len(checker.world.map.object_ids))
        )

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what is worth showing: what became of the seeds, and the objects."""
        shown = [*self.ended, *(w for w in (self.path, self.given) if w is not None), self.solid]
        points = np.concatenate(shown)
        return points.min(axis=0) - _PAD, points.max(axis=0) + _PAD

    def draw(self, axis: Axes, a: int, b: int) -> None:
        for way in self.begun:
            axis.plot(way[:, a], way[:, b], color=_BEGUN, linewidth=0.9, linestyle=":")
        for way in self.ended:
            axis.plot(way[:, a], way[:, b], color=_ENDED, linewidth=0.9, alpha=0.8)
        if self.given is not None:
            axis.plot(
                self.given[:, a], self.given[:, b], color=_GIVEN, linewidth=1.4, dashes=(4, 2)
            )
        if self.path is not None:
            axis.plot(self.path[:, a], self.path[:, b], color="white", linewidth=4.0)
            axis.plot(self.path[:, a], self.path[:, b], color=HAND_COLOR, linewidth=2.4)
        first, last = self.ended[0][0], self.ended[0][-1]
        axis.plot(first[a], first[b], "o", color=START_COLOR, markersize=8, zorder=5)
        axis.plot(last[a], last[b], "o", color=GOAL_COLOR, markersize=8, zorder=5)


def _draw_world(axis: Axes, world: Any, a: int, b: int) -> None:
    """Shadows of the obstacles on a plane of two axes: objects over everything else."""
    field = world.field
    along = 3 - a - b
    solid = field.distance <= 0.0
    objects = len(world.map.object_ids)
    names = np.where(solid, field.source, -1)
    image = np.ones((field.distance.shape[a], field.distance.shape[b], 3))
    unseen = {k for k, name in enumerate(world.sources) if source_of(name).policy}
    order = [*sorted(unseen), *(k for k in range(objects, len(world.sources)) if k not in unseen)]
    for k in [*order, *range(objects)]:
        shadow = (names == k).any(axis=along)
        color = _UNSEEN if k in unseen else _OTHER
        if k < objects:
            color = _shade(world.map.object_ids[k])
        image[shadow] = color
    low, high = field.origin - 0.5 * field.spacing, field.upper + 0.5 * field.spacing
    extent = (low[a], high[a], low[b], high[b])
    axis.imshow(np.swapaxes(image, 0, 1), origin="lower", extent=extent, aspect="auto")
    plane = world.map.plane
    if b == 2 and plane is not None and abs(plane.normal[2]) > 0.99:
        axis.axhspan(-10.0, plane.offset / plane.normal[2], color="0.35", linewidth=0)


def _shade(object_id: int) -> np.ndarray:
    """An object's colour, light enough for lines on top."""
    return 0.35 + 0.65 * object_color(object_id)


def _shown_seed(result: "OptimizeResult") -> int:
    """The winner, or the seed of least cost."""
    if result.report.winner is not None:
        return result.report.winner
    return int(np.argmin([seed.cost for seed in result.report.seeds]))


def _draw_terms(axis: Axes, result: "OptimizeResult") -> None:
    history = result.history
    assert history is not None
    seed = _shown_seed(result)
    rows = np.arange(1, len(history.cost) + 1)
    axis.plot(rows, history.cost[:, seed], color="0.75", linewidth=4.0, label="sum")
    for number, (name, values) in enumerate(history.terms.items()):
        color = _TERMS[number % len(_TERMS)]
        shown = np.where(values[:, seed] > 0.0, values[:, seed], np.nan)
        axis.plot(rows, shown, color=color, label=name)
    terms = np.stack([values[:, seed] for values in history.terms.values()])
    _finish(axis, result, terms, f"terms of seed {seed} ({result.report.seeds[seed].name})")
    axis.legend(loc="upper right", fontsize=8)


def _draw_seeds(axis: Axes, result: "OptimizeResult") -> None:
    history = result.history
    assert history is not None
    rows = np.arange(1, len(history.cost) + 1)
    winner = result.report.winner
    for number, seed in enumerate(result.report.seeds):
        own = number == winner
        axis.plot(
            rows,
            history.cost[:, number],
            color=HAND_COLOR if own else PALETTE[number % len(PALETTE)],
            linewidth=2.6 if own else 1.2,
            linestyle="--" if seed.refused else "-",
            label=f"{seed.name}{' (returned)' if own else ' (refused)' if seed.refused else ''}",
            zorder=3 if own else 2,
        )
    _finish(axis, result, history.cost, "cost of each seed")
    axis.legend(loc="upper right", fontsize=8, ncols=1 + (len(result.report.seeds) > 6))


def _finish(axis: Axes, result: "OptimizeResult", shown: np.ndarray, name: str) -> None:
    """Logarithmic axes around the positive values that are shown."""
    history = result.history
    assert history is not None
    top = float(np.max(history.cost[np.isfinite(history.cost)], initial=_LOWEST))
    least = float(np.min(shown[shown > 0.0], initial=top))
    axis.set_yscale("log")
    axis.set_ylim(max(0.6 * least, _LOWEST * top), 2.0 * top)
    for row in np.flatnonzero(np.diff(history.round)):
        axis.axvline(row + 1.5, color="0.6", linewidth=0.8, linestyle="--")
    axis.set_title(name, fontsize=10)
    axis.set_xlabel("batch of evaluations")
    axis.set_ylabel("cost")
    axis.grid(alpha=0.25)


def _legend(figure: Figure, paths: _Paths, world: Any) -> None:
    entries: list[Line2D | Patch] = [
        Line2D([], [], color=_BEGUN, linestyle=":", label="seeds as they began"),
        Line2D([], [], color=_ENDED, linewidth=0.9, label="seeds as they ended"),
    ]
    if paths.given is not None:
        entries.append(Line2D([], [], color=_GIVEN, dashes=(4, 2), label="the path that was given"))
    if paths.path is not None:
        entries.append(Line2D([], [], color=HAND_COLOR, linewidth=2.4, label="returned, verified"))
    entries += [
        Line2D([], [], marker="o", linestyle="", color=START_COLOR, label="start"),
        Line2D([], [], marker="o", linestyle="", color=GOAL_COLOR, label="goal"),
        Patch(color=tuple(_UNSEEN), label="unseen, an obstacle by policy"),
        Patch(color=tuple(_OTHER), label="other obstacles"),
    ]
    entries += [
        Patch(color=tuple(_shade(object_id)), label=f"object {object_id}")
        for object_id in world.map.object_ids
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=5)
