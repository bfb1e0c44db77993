# SPDX-License-Identifier: BSD-3-Clause
"""How much room a path leaves: to every obstacle along it, and between every pair."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vprism_plan.viz._figures import new_figure, object_color
from vprism_plan.world.sources import object_id, source_of

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.collision.margins import SafetyMargins

_SHOWN = 0.4  # metres: farther is as good as far
_PALE = 250.0  # millimetres from which a cell of the table is white


def margin_figure(
    checker: "CollisionChecker",
    path: Float[np.ndarray, "t dof"],
    *,
    tolerance: float = 0.001,
    title: str | None = None,
) -> Figure:
    """Draw the clearance to every obstacle along a path, and the smallest of every pair.

    Args:
        checker: a checker over a `World`.
        path: (T, dof) waypoints.
        tolerance: no sphere moves more than this, metres, to the nearest sample; the
            table's numbers are bounds with that much subtracted.
        title: above both panels.
    """
    from vprism_plan.collision.margins import margin_profile

    margins = checker.safety_margin(path, tolerance)
    places, profile = margin_profile(checker, path, tolerance)
    links = [
        name for name in checker.robot.link_names if any(m.link == name for m in margins.margins)
    ]
    bodies = list(margins.of_bodies())
    figure = new_figure(max(8.0, 1.15 * len(bodies) + 3.4), 4.0 + 0.36 * len(links) + 1.2)
    axes = figure.subplots(2, 1, gridspec_kw={"height_ratios": [4.0, 0.36 * len(links) + 0.6]})
    if title:
        figure.suptitle(title)
    _draw_profile(axes[0], places, profile, margins)
    _draw_pairs(axes[1], margins, links, bodies)
    return figure


def body_style(name: str) -> tuple[Any, str]:
    """Return colour and line style that stand for an obstacle in every picture of margins."""
    source, number = source_of(name), object_id(name)
    return source.color if number is None else tuple(object_color(number)), source.line


def _draw_profile(
    axis: Axes, places: np.ndarray, profile: dict[str, np.ndarray], margins: "SafetyMargins"
) -> None:
    for name in sorted(profile, key=lambda body: float(profile[body].min())):
        color, style = body_style(name)
        label = f"{name}: {1000 * profile[name].min():.0f} mm"
        axis.plot(places, 1000 * profile[name], color=color, linestyle=style, label=label)
    axis.axhspan(-1e4, 1000 * margins.margin, color=(0.80, 0.10, 0.10, 0.14), linewidth=0)
    lowest = min(0.0, 1000 * min(float(values.min()) for values in profile.values()))
    axis.set_ylim(1.1 * lowest - 8.0, 1000 * _SHOWN)
    axis.set_xlim(0.0, max(float(places[-1]), 1e-9))
    axis.set_xlabel("place on the path (waypoint)")
    axis.set_ylabel("clearance (mm)")
    axis.set_title(
        f"clearance of the whole robot; refused below {1000 * margins.margin:.0f} mm (red)",
        fontsize=10,
    )
    axis.grid(color="0.9")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, title="smallest")


def _draw_pairs(axis: Axes, margins: "SafetyMargins", links: list[str], bodies: list[str]) -> None:
    """A table of the smallest clearances, coloured by how small they are."""
    values = np.full((len(links), len(bodies)), np.nan)
    allowed = np.zeros(values.shape, dtype=bool)
    for margin in margins.margins:
        cell = links.index(margin.link), bodies.index(margin.body)
        values[cell], allowed[cell] = 1000 * margin.clearance, margin.allowed
    axis.imshow(values, cmap="OrRd_r", vmin=-60.0, vmax=_PALE, aspect="auto")
    for row, column in np.ndindex(values.shape):
        note = "*" if allowed[row, column] else ""
        text = f"{values[row, column]:.0f}{note}"
        color = "white" if values[row, column] < 0.25 * _PALE else "black"
        axis.text(column, row, text, ha="center", va="center", fontsize=8, color=color)
    axis.set_xticks(range(len(bodies)), [body.replace(" ", "\n") for body in bodies], fontsize=8)
    axis.set_yticks(range(len(links)), links, fontsize=8)
    axis.set_title(
        "smallest clearance of every link over the whole path (mm; bounds, "
        f"{1000 * margins.tolerance:g} mm taken off for what lies between samples)"
        + ("; * may be touched" if allowed.any() else ""),
        fontsize=10,
    )
    axis.tick_params(length=0)
    for side in axis.spines.values():
        side.set_visible(False)
