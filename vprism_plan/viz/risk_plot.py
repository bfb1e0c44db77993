# SPDX-License-Identifier: BSD-3-Clause
"""What a path risks: where it sweeps through the map, and what the map knows there."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan.viz._figures import new_figure
from vprism_plan.viz.map_plot import Slice, occluded, overlay
from vprism_plan.viz.plan_plot import GOAL_COLOR, HAND_COLOR, START_COLOR, hand_path

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker

_PAD = 0.16  # metres shown around the objects
_POSES = 240  # configurations whose spheres are drawn
_SAMPLES = 80  # along the path, for the curves
_MEAN, _LARGEST = "#7b3294", "#e66101"


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
    sweep = _Sweep.of(checker.robot, path, plane)
    ratio = len(plane.b) / len(plane.a)
    figure = new_figure(12.6, 5.0 * ratio + 4.6)
    axes = figure.subplots(2, 2, gridspec_kw={"height_ratios": [5.0 * ratio, 2.9]})
    if title:
        figure.suptitle(title)
    points = plane.points()
    hidden = plane.image(occluded(m.views, points)).astype(float)
    support, occupancy = plane.image(m.support(points)), plane.image(m.occupancy(points))
    panels = (
        ("P(occupied)", occupancy, "viridis", 1.0, "probability"),
        ("entropy", plane.image(m.entropy(points)), "magma", np.log(m.n_classes), "nats"),
    )
    for axis, (name, values, cmap, top, label) in zip(axes[0], panels, strict=True):
        image = axis.imshow(
            values, origin="lower", extent=plane.extent, cmap=cmap, vmin=0, vmax=top
        )
        figure.colorbar(image, cax=axis.inset_axes((1.02, 0.0, 0.035, 1.0)), label=label)
        axis.set_title(f"{name}, {plane.title}", fontsize=10)
        axis.set_xlabel(plane.a_label)
        axis.set_ylabel(plane.b_label)
        overlay(axis, plane, m, hidden, support, occupancy, None)
        sweep.draw(axis, plane)
    dense, places = densified(path, _SAMPLES)
    _draw_entropy(axes[1, 0], checker, dense, places)
    _draw_risk(axes[1, 1], checker, dense, places)
    _legend(figure)
    return figure


def densified(
    path: Float[np.ndarray, "t dof"], count: int
) -> tuple[Float[np.ndarray, "n dof"], Float[np.ndarray, " n"]]:
    """Divide the edges of a path into about `count` equal steps; every waypoint stays.

    Returns:
        Configurations, and their places: number of the edge plus the fraction of it.
    """
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    whole = float(steps.sum())
    places = [np.zeros(1)]
    for edge, step in enumerate(steps):
        n = max(1, round(count * float(step) / whole)) if whole > 0 else 1
        places.append(edge + np.arange(1, n + 1) / n)
    at = np.concatenate(places)
    number = np.arange(len(path))
    return np.stack([np.interp(at, number, column) for column in path.T], axis=1), at


def _height(checker: "CollisionChecker", path: np.ndarray) -> float:
    """Height, metres, at which the path comes nearest to an object, over the table."""
    margins = checker.safety_margin(path, tolerance=0.01).margins
    nearest = next((m.nearest for m in margins if m.kind == "object"), None)
    plane: Any = checker.world.map.plane
    table = float(plane.offset / plane.normal[2])
    return table + 0.02 if nearest is None else max(float(nearest[2]), table + 0.01)


def _horizontal(m: Any, height: float, resolution: float) -> Slice:
    seen = [view.points() for view in m.views]
    objects = np.concatenate([points[labels > 0] for points, labels in seen])
    low, high = np.percentile(objects[:, :2], [0.5, 99.5], axis=0)
    low, high = low - _PAD, high + _PAD
    table = float(m.plane.offset / m.plane.normal[2])
    return Slice(
        title=f"{100 * (height - table):.1f} cm above the table",
        origin=np.array([0.0, 0.0, height]),
        u=np.array([1.0, 0.0, 0.0]),
        v=np.array([0.0, 1.0, 0.0]),
        a=np.arange(low[0], high[0], resolution),
        b=np.arange(low[1], high[1], resolution),
        a_label="x (m)",
        b_label="y (m)",
    )


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
        hand = hand_path(robot, dense)[:, :2]
        return cls(
            _cut(centers.reshape(-1, 3), np.tile(radii, len(dense)), plane),
            _cut(centers[0], radii, plane),
            _cut(centers[-1], radii, plane),
            hand,
        )

    def draw(self, axis: Axes, plane: Slice) -> None:
        grid: dict[str, Any] = {"origin": "lower", "extent": plane.extent}
        if (self.whole > 0).any():
            shade = axis.contourf(
                self.whole, levels=[0.0, np.inf], colors="none", hatches=["..."], **grid
            )
            shade.set_edgecolor((1, 1, 1, 0.55))
            shade.set_linewidth(0.0)
        for depth, color, width in (
            (self.whole, (1.0, 1.0, 1.0), 1.8),
            (self.start, START_COLOR, 2.0),
            (self.goal, GOAL_COLOR, 2.0),
        ):
            if depth.min() < 0 < depth.max():
                axis.contour(depth, levels=[0.0], colors="black", linewidths=width + 1.6, **grid)
                axis.contour(depth, levels=[0.0], colors=[color], linewidths=width, **grid)
        axis.plot(*self.hand.T, color="white", linewidth=3.6)
        axis.plot(*self.hand.T, color=HAND_COLOR, linewidth=2.0)
        axis.set_xlim(plane.extent[:2])
        axis.set_ylim(plane.extent[2:])


def _cut(centers: np.ndarray, radii: np.ndarray, plane: Slice) -> np.ndarray:
    """Depth of every pixel in the nearest of the discs that spheres cut from a slice, metres."""
    inside = radii**2 - (centers[:, 2] - plane.origin[2]) ** 2
    cut = inside > 0
    depth = np.full((len(plane.b), len(plane.a)), -1.0)
    for (x, y, _), radius in zip(centers[cut], np.sqrt(inside[cut]), strict=True):
        away = np.hypot(plane.a[None, :] - x, plane.b[:, None] - y)
        np.maximum(depth, radius - away, out=depth)
    return depth


def _draw_entropy(
    axis: Axes, checker: "CollisionChecker", dense: np.ndarray, places: np.ndarray
) -> None:
    entropy = checker.path_entropy(dense)
    share = axis.twinx()
    supported = 100 * (1 - np.array(entropy.waypoint_unsupported))
    share.fill_between(places, 0.0, supported, color="0.87", linewidth=0)
    share.set_ylim(0.0, min(100.0, max(1.0, 1.6 * float(supported.max()))))
    share.set_ylabel("volume the map knows (%, grey)")
    axis.set_zorder(share.get_zorder() + 1)
    axis.patch.set_visible(False)
    axis.plot(places, entropy.waypoint_max, color=_LARGEST, label="largest of a sphere")
    axis.plot(places, entropy.waypoint_mean, color=_MEAN, label="mean over the supported volume")
    highest = np.nan_to_num(np.array(entropy.waypoint_max)).max()
    axis.set_ylim(0.0, max(0.1, 1.45 * float(highest)))
    axis.set_ylabel("entropy (nats)")
    axis.legend(loc="upper left", fontsize=8)
    where = f"{100 * (1 - entropy.unsupported_share):.0f}% of {1000 * entropy.swept_volume:.0f} l"
    mean = "nothing supported" if np.isnan(entropy.swept_mean) else f"{entropy.swept_mean:.2f} nats"
    _finish(axis, places, f"entropy along the path; swept: {mean} over {where}")


def _draw_risk(
    axis: Axes, checker: "CollisionChecker", dense: np.ndarray, places: np.ndarray
) -> None:
    risk = checker.collision_probability(dense)
    axis.axhspan(risk.lower, risk.upper, color="0.85", linewidth=0)
    axis.axhline(
        risk.probability, color="0.25", linestyle="--", label="whole path, with its interval"
    )
    axis.plot(places, risk.per_waypoint, color=HAND_COLOR, label="this configuration alone")
    top = max(0.05, risk.upper, float(np.max(risk.per_waypoint)))
    axis.set_ylim(-0.02 * top, 1.4 * top)
    if top > 0.5:
        axis.set_yticks(np.linspace(0.0, 1.0, 6))
    axis.set_ylabel("P(collision)")
    axis.legend(loc="upper left", fontsize=8)
    name = f"P(collision) of the path: {risk.probability:.3f}"
    if risk.first_contact:
        first = risk.first_contact[0]
        name += f", first {first.link} with {first.body}"
    _finish(axis, places, name)


def _finish(axis: Axes, places: np.ndarray, name: str) -> None:
    axis.set_title(name, fontsize=10)
    axis.set_xlabel("place on the path (waypoint)")
    axis.set_xlim(0.0, max(float(places[-1]), 1e-9))


def _legend(figure: Figure) -> None:
    entries: list[Line2D | Patch] = [
        Line2D([], [], color="white", linewidth=1.4, label="P(occupied) = 0.5"),
        Line2D([], [], color="white", linestyle=":", label="end of the map's support"),
        Patch(facecolor="#555555", edgecolor="white", hatch="///", label="occluded"),
        Line2D([], [], marker=".", linestyle="", color="#ffb000", label="observed points"),
        Patch(facecolor="#555555", edgecolor="white", hatch="...", label="swept at this height"),
        Line2D([], [], color=START_COLOR, linewidth=2, label="robot at the start"),
        Line2D([], [], color=GOAL_COLOR, linewidth=2, label="robot at the goal"),
        Line2D([], [], color=HAND_COLOR, linewidth=2, label="path of the hand, from above"),
    ]
    figure.legend(
        handles=entries,
        loc="outside lower center",
        ncols=4,
        facecolor="#555555",
        labelcolor="white",
        framealpha=1.0,
    )
