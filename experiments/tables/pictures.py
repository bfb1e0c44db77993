# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of the tables: bars with intervals, reliability curves, scene against scene."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.baselines import method
from experiments.metrics import Reliability
from experiments.scene_truth import OCCLUDED, VISIBLE
from experiments.tables.results import SetResults, TableResults
from vprism_plan.viz._figures import PALETTE, new_figure

_FEWEST = 50  # predictions behind a point of a curve


def figures(results: TableResults, summary: dict[str, Any]) -> dict[str, Figure]:
    """Return all pictures of a table by file name without suffix."""
    key = results.table.key
    drawn = {key: bars(results, summary), f"{key}-reliability": reliability(results)}
    if {"vprism", "vprism-paper"} <= set(results.methods):
        drawn[f"{key}-scenes"] = scenes(results, "vprism-paper", "vprism")
    return drawn


def bars(results: TableResults, summary: dict[str, Any]) -> Figure:
    """Draw IoU and Chamfer of every method on every set, with intervals."""
    figure = new_figure(5.0 + 2.0 * len(results.sets), 6.8)
    panels = figure.subplots(2, 1)
    for axes, (metric, scale, title) in zip(
        panels,
        (("iou", 1.0, "IoU (higher is better)"), ("chamfer", 1e3, "Chamfer, mm (lower is better)")),
        strict=True,
    ):
        width = 0.85 / len(results.methods)
        for row, key in enumerate(results.methods):
            cells = [summary["sets"][s.kind]["methods"][key][metric] for s in results.sets]
            height = scale * np.array([_number(c["value"]) for c in cells])
            low, high = (scale * np.array([_number(c[k]) for c in cells]) for k in ("low", "high"))
            x = np.arange(len(cells)) + width * (row - 0.5 * (len(results.methods) - 1))
            axes.bar(x, height, 0.92 * width, color=_color(row), label=method(key).label)
            reach = np.nan_to_num(np.maximum(np.stack([height - low, high - height]), 0.0))
            axes.errorbar(x, height, reach, fmt="none", ecolor="0.2", elinewidth=1, capsize=2)
        axes.set_xticks(range(len(results.sets)), [s.kind for s in results.sets])
        axes.set_ylabel(title)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def reliability(results: TableResults) -> Figure:
    """Draw observed against predicted occupancy: a row per part of space, a column per set."""
    figure = new_figure(3.6 * len(results.sets) + 2.6, 7.2)
    panels = figure.subplots(2, len(results.sets), squeeze=False, sharex=True, sharey=True)
    for column, found in enumerate(results.sets):
        for row, (part, name) in enumerate(((OCCLUDED, "occluded"), (VISIBLE, "visible"))):
            axes = panels[row, column]
            axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
            for number, key in enumerate(results.methods):
                _curve(axes, found.scores[key].all.parts[part], number, method(key).label)
            axes.set(xlim=(0, 1), ylim=(0, 1), title=f"{found.kind}, {name}")
            axes.set_aspect("equal")
            axes.grid(color="0.92")
    for axes in panels[-1]:
        axes.set_xlabel("P(occupied)")
    for axes in panels[:, 0]:
        axes.set_ylabel("truly occupied")
    handles = {
        label: handle
        for axes in panels.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", frameon=False)
    return figure


def _curve(axes: Any, table: Reliability, number: int, label: str) -> None:
    rows = [row for row in table.rows() if row.count >= _FEWEST]
    axes.plot(
        [row.predicted for row in rows], [row.observed for row in rows],
        color=_color(number), marker="os^vDP*X"[number % 8], markersize=4, linewidth=1.3,
        label=label,
    )  # fmt: skip


def scenes(results: TableResults, across: str, up: str) -> Figure:
    """Draw two methods against each other, one dot per scene, IoU and Chamfer."""
    figure = new_figure(9.6, 4.6)
    for axes, (metric, scale, title) in zip(
        figure.subplots(1, 2),
        (("mean_iou", 1.0, "IoU"), ("mean_chamfer", 1e3, "Chamfer (mm)")),
        strict=True,
    ):
        largest = 0.0
        for number, found in enumerate(results.sets):
            x, y = (scale * _by_scene(found, key, metric) for key in (across, up))
            axes.plot(
                x, y, "os^vD"[number % 5], markersize=4, color=_color(number), alpha=0.8,
                label=found.kind,
            )  # fmt: skip
            largest = max(largest, float(np.nanmax([*x, *y, 0.0])))
        limit = 1.0 if metric == "mean_iou" else 1.05 * max(largest, 1.0)
        axes.plot([0, limit], [0, limit], color="0.6", linewidth=1, linestyle="--")
        axes.set(xlim=(0, limit), ylim=(0, limit), title=f"{title}, mean of each scene")
        axes.set(xlabel=method(across).label, ylabel=method(up).label)
        axes.set_aspect("equal")
        axes.legend(frameon=False)
    return figure


def _by_scene(found: SetResults, key: str, metric: str) -> np.ndarray:
    return np.array([getattr(s, metric) for s in found.scores[key].scenes])


def _color(number: int) -> np.ndarray:
    return np.asarray(PALETTE[number % len(PALETTE)])


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
