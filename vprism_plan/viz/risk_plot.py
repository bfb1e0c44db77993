# SPDX-License-Identifier: BSD-3-Clause
"""What a path risks: where it sweeps the map and what that knows there, and the room it leaves."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vprism_plan.viz._figures import hatched, legend, line, name_axes, new_figure, object_color
from vprism_plan.viz.map_plot import Slice, draw_slice, hatch
from vprism_plan.viz.plan_plot import GOAL_COLOR, HAND_COLOR, START_COLOR, hand_path
from vprism_plan.world.sources import object_id, source_of

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.collision.entropy import PathEntropy
    from vprism_plan.collision.margins import SafetyMargins
    from vprism_plan.collision.reports import RiskEstimate

_PAD = 0.16  # metres shown around the objects
_POSES = 240  # configurations whose spheres are drawn
_SAMPLES = 80  # along the path, for the curves
_MEAN, _LARGEST = "#7b3294", "#e66101"
_PLACE = "place on the path (waypoint)"
_SHOWN = 0.4  # metres: farther is as good as far
_PALE = 250.0  # millimetres from which a cell of the table is white


def risk_figure(
    checker: "CollisionChecker",
    path: Float[np.ndarray, "t dof"],
    *,
    height: float | None = None,
    resolution: float = 0.005,
    title: str | None = None,
) -> Figure:
    """Draw P(occupied) and entropy at one height with what the path sweeps there, and
    entropy and probability of collision along the path.

    Args:
        checker: a checker over a `World` with z up.
        path: (T, dof) waypoints.
        height: z of the slice, metres; None takes that of the path's nearest approach to
            an object.
        resolution: pixel size of the slices, metres.
        title: above all panels.
    """
    path = np.asarray(path, dtype=np.float64)
    m: Any = checker.world.map
    plane = _horizontal(m, _height(checker, path) if height is None else height, resolution)
    ratio = len(plane.b) / len(plane.a)
    figure = new_figure(12.6, 5.0 * ratio + 4.6, title)
    axes = figure.subplots(2, 2, gridspec_kw={"height_ratios": [5.0 * ratio, 2.9]})
    draw_slice(figure, axes[0], plane, m, unit="nats")
    sweep = _Sweep.of(checker.robot, path, plane)
    for axis in axes[0]:
        sweep.draw(axis, plane)
    dense, places = densified(path, _SAMPLES)
    _draw_entropy(axes[1, 0], checker.path_entropy(dense), places)
    _draw_risk(axes[1, 1], checker.collision_probability(dense), places)
    for axis in axes[1]:
        axis.legend(loc="upper left", fontsize=8)
        axis.set_xlim(0.0, max(float(places[-1]), 1e-9))
    entries = [
        line("P(occupied) = 0.5", color="white", linewidth=1.4),
        line("end of the map's support", color="white", linestyle=":"),
        hatched("occluded", "///"),
        line("observed points", marker=".", linestyle="", color="#ffb000"),
        hatched("swept at this height", "..."),
        line("robot at the start", color=START_COLOR, linewidth=2),
        line("robot at the goal", color=GOAL_COLOR, linewidth=2),
        line("path of the hand, from above", color=HAND_COLOR, linewidth=2),
    ]
    legend(figure, entries, 4, dark=True)
    return figure


def densified(
    path: Float[np.ndarray, "t dof"], count: int
) -> tuple[Float[np.ndarray, "n dof"], Float[np.ndarray, " n"]]:
    """Divide the edges of a path into about `count` equal steps; every waypoint stays.

    Returns:
        Configurations, and their places: number of the edge plus the fraction of it.
    """
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    pieces = np.maximum(1.0, np.rint(count * steps / max(float(steps.sum()), 1e-9)))
    at = np.concatenate([[0.0], *(edge + np.arange(1, n + 1) / n for edge, n in enumerate(pieces))])
    number = np.arange(len(path))
    return np.stack([np.interp(at, number, column) for column in path.T], axis=1), at


def _height(checker: "CollisionChecker", path: np.ndarray) -> float:
    """Height, metres, at which the path comes nearest to an object, over the table."""
    plane: Any = checker.world.map.plane
    table = float(plane.offset / plane.normal[2])
    margins = checker.safety_margin(path, tolerance=0.01).margins
    nearest = next((m.nearest for m in margins if m.kind == "object"), None)
    return table + 0.02 if nearest is None else max(float(nearest[2]), table + 0.01)


def _horizontal(m: Any, height: float, resolution: float) -> Slice:
    low, high = np.percentile(m.shown()[:, :2], [0.5, 99.5], axis=0)
    x, y = (np.arange(a, b, resolution) for a, b in zip(low - _PAD, high + _PAD, strict=True))
    title = f"{100 * (height - float(m.plane.offset / m.plane.normal[2])):.1f} cm above the table"
    u, v, up = np.eye(3)
    return Slice(title, ("x (m)", "y (m)"), height * up, u, v, x, y)


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Where the spheres of moving links cut a slice: depth of every pixel in them, metres."""

    whole: np.ndarray
    start: np.ndarray
    goal: np.ndarray
    hand: np.ndarray  # (t, 2)

    @classmethod
    def of(cls, robot: Any, path: np.ndarray, plane: Slice) -> "_Sweep":
        dense, _ = densified(path, _POSES)
        moving = ~np.asarray(robot.fixed_links)[np.asarray(robot.sphere_links)]
        centers = robot.sphere_centers(dense)[:, moving]
        radii = np.asarray(robot.sphere_radii)[moving]
        return cls(
            _cut(centers.reshape(-1, 3), np.tile(radii, len(dense)), plane),
            _cut(centers[0], radii, plane),
            _cut(centers[-1], radii, plane),
            hand_path(robot, dense)[:, :2],
        )

    def draw(self, axis: Axes, plane: Slice) -> None:
        if (self.whole > 0).any():
            hatch(axis, self.whole, 0.0, "...", 0.55, plane.grid)
        outlines = ((self.whole, "white"), (self.start, START_COLOR), (self.goal, GOAL_COLOR))
        for (depth, color), width in zip(outlines, (1.8, 2.0, 2.0), strict=True):
            if depth.min() < 0 < depth.max():
                for shade, wide in (("black", width + 1.6), ([color], width)):
                    axis.contour(depth, levels=[0.0], colors=shade, linewidths=wide, **plane.grid)
        axis.plot(*self.hand.T, color="white", linewidth=3.6)
        axis.plot(*self.hand.T, color=HAND_COLOR, linewidth=2.0)


def _cut(centers: np.ndarray, radii: np.ndarray, plane: Slice) -> np.ndarray:
    """Depth of every pixel in the nearest of the discs that spheres cut from a slice, metres."""
    inside = radii**2 - (centers[:, 2] - plane.origin[2]) ** 2
    cut = inside > 0
    depth = np.full((len(plane.b), len(plane.a)), -1.0)
    for (x, y, _), radius in zip(centers[cut], np.sqrt(inside[cut]), strict=True):
        away = np.hypot(plane.a[None, :] - x, plane.b[:, None] - y)
        np.maximum(depth, radius - away, out=depth)
    return depth


def _draw_entropy(axis: Axes, entropy: "PathEntropy", places: np.ndarray) -> None:
    share = axis.twinx()
    supported = 100 * (1 - np.array(entropy.waypoint_unsupported))
    share.fill_between(places, 0.0, supported, color="0.87", linewidth=0)
    share.set_ylim(0.0, min(100.0, max(1.0, 1.6 * float(supported.max()))))
    share.set_ylabel("volume the map knows (%, grey)")
    axis.set_zorder(share.get_zorder() + 1)
    axis.patch.set_visible(False)
    axis.plot(places, entropy.waypoint_max, color=_LARGEST, label="largest of a sphere")
    axis.plot(places, entropy.waypoint_mean, color=_MEAN, label="mean over the supported volume")
    axis.set_ylim(0.0, max(0.1, 1.45 * float(np.nan_to_num(entropy.waypoint_max).max())))
    where = f"{100 * (1 - entropy.unsupported_share):.0f}% of {1000 * entropy.swept_volume:.0f} l"
    mean = "nothing supported" if np.isnan(entropy.swept_mean) else f"{entropy.swept_mean:.2f} nats"
    name_axes(axis, f"entropy along the path; swept: {mean} over {where}", _PLACE, "entropy (nats)")


def _draw_risk(axis: Axes, risk: "RiskEstimate", places: np.ndarray) -> None:
    axis.axhspan(risk.lower, risk.upper, color="0.85", linewidth=0)
    whole = "whole path, with its interval"
    axis.axhline(risk.probability, color="0.25", linestyle="--", label=whole)
    axis.plot(places, risk.per_waypoint, color=HAND_COLOR, label="this configuration alone")
    top = max(0.05, risk.upper, float(np.max(risk.per_waypoint)))
    axis.set_ylim(-0.02 * top, 1.4 * top)
    if top > 0.5:
        axis.set_yticks(np.linspace(0.0, 1.0, 6))
    name = f"P(collision) of the path: {risk.probability:.3f}"
    if risk.first_contact:
        first = risk.first_contact[0]
        name += f", first {first.link} with {first.body}"
    name_axes(axis, name, _PLACE, "P(collision)")


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
    met = {margin.link for margin in margins.margins}
    links = [name for name in checker.robot.link_names if name in met]
    bodies = list(margins.of_bodies())
    rows = 0.36 * len(links)
    figure = new_figure(max(8.0, 1.15 * len(bodies) + 3.4), 4.0 + rows + 1.2, title)
    above, below = figure.subplots(2, 1, gridspec_kw={"height_ratios": [4.0, rows + 0.6]})
    _draw_profile(above, places, profile, 1000 * margins.margin)
    _draw_pairs(below, margins, links, bodies)
    return figure


def body_style(name: str) -> tuple[Any, str]:
    """Return colour and line style that stand for an obstacle in every picture of margins."""
    source, number = source_of(name), object_id(name)
    return source.color if number is None else tuple(object_color(number)), source.line


def _draw_profile(
    axis: Axes, places: np.ndarray, profile: dict[str, np.ndarray], required: float
) -> None:
    smallest = {name: float(values.min()) for name, values in profile.items()}
    for name in sorted(profile, key=smallest.__getitem__):
        color, style = body_style(name)
        label = f"{name}: {1000 * smallest[name]:.0f} mm"
        axis.plot(places, 1000 * profile[name], color=color, linestyle=style, label=label)
    axis.axhspan(-1e4, required, color=(0.80, 0.10, 0.10, 0.14), linewidth=0)
    axis.set_ylim(1.1 * min(0.0, 1000 * min(smallest.values())) - 8.0, 1000 * _SHOWN)
    axis.set_xlim(0.0, max(float(places[-1]), 1e-9))
    name = f"clearance of the whole robot; refused below {required:.0f} mm (red)"
    name_axes(axis, name, _PLACE, "clearance (mm)")
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
        text = f"{values[row, column]:.0f}{'*' if allowed[row, column] else ''}"
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
    axis.spines[:].set_visible(False)
