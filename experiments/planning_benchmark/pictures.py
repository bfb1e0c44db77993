# SPDX-License-Identifier: BSD-3-Clause
"""The curve of success against true collisions, and where failures and hits come from."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from experiments.planning_benchmark.contenders import full_label
from experiments.planning_benchmark.summary import OURS, Outcome, front
from vprism_plan.viz._figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORS = ("#1b6ca8", "#2a9d5c", "#7b4ea3", "#c27c0e", "#0f8b8d", "#5b6b2f", "#8c564b", "#e377c2")
_OTHERS = {
    "fcl": ("#b3261e", "s"), "fcl-fine": ("#e5736b", "s"), "points": ("#6b4c3b", "v"),
    "octomap-free": ("#d9822b", "^"), "fcl-m10": ("#e5736b", "s"), "default": ("#3d00b8", "p"),
    "pointsdf": ("#e8a33d", "X"), "network": ("#9aa5b1", "d"),
    "octomap-occupied": ("#444444", "P"), "sgd": ("#c2185b", "D"), "truth": ("#000000", "*"),
}  # fmt: skip
# What became of a problem: colour and word, from good to bad.
_FATES = (
    ("safe path", "#2a9d5c"), ("path grazes (up to 5 mm)", "#f0b429"),
    ("path collides", "#b3261e"), ("start or goal refused", "#9aa5b1"),
    ("no path found", "#d9dee4"),
)  # fmt: skip


def curve_figure(found: Sequence[Outcome]) -> "Figure":
    """Draw success against the share of returned paths that truly collide."""
    figure = new_figure(11.0, 7.0)
    axes = figure.add_subplot()
    lines: dict[str, list[Outcome]] = {}
    words = {outcome.contender.line: _words(outcome) for outcome in found}
    for outcome in found:
        lines.setdefault(outcome.contender.line, []).append(outcome)
    ours = [line for line, own in lines.items() if own[0].contender.key.startswith(OURS)]
    for line, own in lines.items():
        color, marker = style(own[0].contender.key, ours.index(line) if line in ours else 0)
        _line(axes, words[line], own, color, marker)
    _hull(axes, [own for line in ours for own in lines[line]])
    axes.set_xlabel("returned paths that truly collide (%)")
    axes.set_ylabel("problems with a path (%)")
    axes.grid(alpha=0.3)
    axes.set_ylim(-3.0, 104.0)
    axes.set_xlim(left=-0.6)
    axes.legend(loc="lower right", fontsize=8, framealpha=0.95)
    axes.set_title("Success against true collisions (bars: 95 % over scenes)", fontsize=10)
    return figure


def _line(axes: "Axes", line: str, own: list[Outcome], color: str, marker: str) -> None:
    """One family of contenders, joined in the order of its parameter."""
    rows = [outcome.estimates() for outcome in own]
    x = np.array([100.0 * row["collision"].value for row in rows])
    y = np.array([100.0 * row["success"].value for row in rows])
    x = np.where(np.isnan(x), 0.0, x)
    for axis, name in (("x", "collision"), ("y", "success")):
        low = np.array([100.0 * row[name].low for row in rows])
        high = np.array([100.0 * row[name].high for row in rows])
        middle = x if axis == "x" else y
        reach = np.nan_to_num(np.abs(np.stack([middle - low, high - middle])))
        kind = {"xerr": reach} if axis == "x" else {"yerr": reach}
        axes.errorbar(x, y, **kind, fmt="none", ecolor=color, alpha=0.25, linewidth=1.0)
    axes.plot(x, y, color=color, marker=marker, linewidth=1.4, markersize=6.0, label=line)
    if len(own) > 1:
        for outcome, a, b in zip(own, x, y, strict=True):
            axes.annotate(
                outcome.contender.label, (a, b), xytext=(5, -9), textcoords="offset points",
                fontsize=7, color=color,
            )  # fmt: skip


def style(key: str, number: int) -> tuple[str, str]:
    """Return colour and marker of a contender's line; of ours by its number among them."""
    if key.startswith(OURS):
        return _COLORS[number % len(_COLORS)], "o"
    return _OTHERS.get(key, ("#555555", "x"))


def _words(outcome: Outcome) -> str:
    """Return what the legend calls a contender's line."""
    contender = outcome.contender
    return contender.label if contender.line == contender.key else contender.line


def _hull(axes: "Axes", ours: list[Outcome]) -> None:
    """What ours reach together."""
    if not ours:
        return
    counts = [outcome.counts() for outcome in ours]
    n = counts[0]["problems"].sum()
    xs, ys = front(
        np.array([c["paths"].sum() / n for c in counts]),
        np.array([c["collided"].sum() / n for c in counts]),
    )
    steps = np.linspace(0.0, float(xs[-1]), 200)[1:]
    rate = 100.0 * np.interp(steps, xs, ys) / steps
    axes.plot(rate, 100.0 * steps, color="#1b6ca8", linewidth=6.0, alpha=0.15, zorder=0)


def fates_figure(found: Sequence[Outcome]) -> "Figure":
    """Draw what became of all problems, one bar per contender."""
    figure = new_figure(9.5, 0.9 + 0.32 * len(found))
    axes = figure.add_subplot()
    names = []
    for row, outcome in enumerate(reversed(found)):
        n = outcome.counts()
        total = n["problems"].sum()
        refused = sum(bool(answer.refused) for answer in outcome.all)
        hit, deep, paths = (n[name].sum() for name in ("collided", "deep", "paths"))
        parts = np.array([paths - hit, hit - deep, deep, refused, total - paths - refused])
        left = 0.0
        for part, (_, color) in zip(100.0 * parts / total, _FATES, strict=True):
            axes.barh(row, part, left=left, color=color, height=0.75)
            left += part
        names.append(full_label(outcome.contender))
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of all problems (%)")
    from matplotlib.patches import Patch

    figure.legend(
        handles=[Patch(color=color, label=word) for word, color in _FATES],
        loc="outside lower center", ncols=len(_FATES), fontsize=8,
    )  # fmt: skip
    return figure
