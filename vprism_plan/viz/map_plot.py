# SPDX-License-Identifier: BSD-3-Clause
"""What was seen, and the map of it: one view; occupancy and entropy on slices."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vprism_plan.perception import Observation
from vprism_plan.viz._figures import hatched, legend, line, name_axes, new_figure, object_color
from vprism_plan.world import visibility

if TYPE_CHECKING:
    from vprism_plan.mapping import VPrismMap

_PAD = 0.10  # metres shown around the labelled points
_NEAR_SLICE = 0.006  # metres from the slice within which observed points are drawn
_OCCLUDED = 0.01  # metres behind the measured depth


def scene_figure(obs: Observation, *, title: str | None = None) -> Figure:
    """Draw depth (metres) and the label overlay of one view, and its colour image if any."""
    panels = 3 if obs.color is not None else 2
    height, width = obs.shape
    figure = new_figure(4.6 * panels + 0.4, 4.6 * height / width + 0.6, title)
    axes = figure.subplots(1, panels, subplot_kw={"xticks": [], "yticks": []})
    depth = np.where(obs.depth > 0, obs.depth, np.nan).astype(np.float64)
    if obs.color is not None:
        axes[0].imshow(obs.color)
        axes[0].set_title("colour")
    # The far background would otherwise take all the contrast from the table.
    high = float(np.nanpercentile(depth, 98.0)) if np.isfinite(depth).any() else 1.0
    axes[-2].set_facecolor("black")
    image = axes[-2].imshow(depth, cmap="viridis_r", vmax=high, interpolation="nearest")
    figure.colorbar(image, ax=axes[-2], label="depth (m)", shrink=0.85)
    lost = 100.0 * float((obs.depth == 0).mean())
    axes[-2].set_title(f"depth ({lost:.1f} % without return, black)")
    _draw_labels(axes[-1], obs, depth)
    return figure


def _draw_labels(axis: Axes, obs: Observation, depth: np.ndarray) -> None:
    if obs.color is not None:
        grey = obs.color.mean(axis=2) / 255.0
    elif np.isfinite(depth).any():
        low, high = np.nanpercentile(depth, [1.0, 98.0])
        grey = np.nan_to_num(1.0 - np.clip((depth - low) / max(high - low, 1e-9), 0.0, 1.0))
    else:
        grey = np.zeros(obs.shape)
    picture = np.repeat((0.25 + 0.6 * grey)[..., None], 3, axis=2)
    if obs.labels is None:
        axis.set_title("labels: none given")
        axis.imshow(picture)
        return
    for object_id in obs.object_ids:
        mask = obs.labels == object_id
        picture[mask] = 0.35 * picture[mask] + 0.65 * object_color(object_id)
        row, column = (float(np.median(places)) for places in np.nonzero(mask))
        box = {"boxstyle": "round,pad=0.2", "fc": (0, 0, 0, 0.55), "ec": "none"}
        style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9, "color": "white"}
        axis.annotate(str(object_id), (column, row), bbox=box, **style)
    axis.imshow(np.clip(picture, 0.0, 1.0), interpolation="nearest")
    axis.set_title(f"labels ({len(obs.object_ids)} objects)")


@dataclass(frozen=True)
class Slice:
    """A plane through the world: origin + a * u + b * v for a, b in the given ranges."""

    title: str
    labels: tuple[str, str]  # of a and b
    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    a: np.ndarray
    b: np.ndarray

    @property
    def grid(self) -> dict[str, Any]:
        """Where values of `image` lie, as matplotlib wants it."""
        extent = tuple(float(x) for x in (self.a[0], self.a[-1], self.b[0], self.b[-1]))
        return {"origin": "lower", "extent": extent}

    def points(self) -> np.ndarray:
        """World points (len(b) * len(a), 3), metres."""
        a, b = np.meshgrid(self.a, self.b)
        return self.origin + a.reshape(-1, 1) * self.u + b.reshape(-1, 1) * self.v

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values at `points` as rows of b and columns of a."""
        return np.asarray(values).reshape(len(self.b), len(self.a))


def map_figure(
    m: "VPrismMap",
    *,
    truth: Callable[[np.ndarray], np.ndarray] | None = None,
    resolution: float = 0.004,
    title: str | None = None,
) -> Figure:
    """Draw P(occupied) and entropy on a horizontal and on a vertical slice.

    The horizontal slice lies at half the height of the objects; the vertical one
    runs along the first camera's line of sight through the middle of the objects.

    Args:
        m: a fitted map in a frame with z up.
        truth: signed distance (N, 3) -> (N,) whose zero level is drawn dashed.
        resolution: pixel size of the slices, metres.
        title: above all panels.
    """
    slices = _slices(m, resolution)
    heights = [len(plane.b) / len(plane.a) for plane in slices]
    figure = new_figure(12.6, 4.9 * sum(heights) + 1.7, title)
    axes = figure.subplots(2, 2, sharex=True, gridspec_kw={"height_ratios": heights})
    for row, plane in zip(axes, slices, strict=True):
        draw_slice(figure, row, plane, m, truth)
    entries = [
        line("observed points", marker=".", linestyle="", color="#ffb000"),
        line("P(occupied) = 0.5", color="white", linewidth=1.6),
        line("end of the map's support", color="white", linestyle=":"),
        hatched("occluded", "///"),
        line("table", color="#9ad0ff"),
    ]
    if truth is not None:
        entries.append(line("true outline (not given to the map)", color="#ff5fa2", linestyle="--"))
    legend(figure, entries, 3, dark=True)
    return figure


def _slices(m: "VPrismMap", resolution: float) -> tuple[Slice, Slice]:
    """Both slices share their first axis, the direction in which the camera looks."""
    objects = m.shown()
    low, high = np.percentile(objects, [0.5, 99.5], axis=0)
    middle = 0.5 * (low + high)
    normal, top = m.plane.normal, float(high[2])
    table = float((m.plane.offset - normal[:2] @ middle[:2]) / normal[2])
    sight = middle - m.views[0].camera_center
    sight[2] = 0.0
    if np.linalg.norm(sight) < 0.02:  # seen from straight above
        sight = np.array([1.0, 0.0, 0.0])
    sight /= np.linalg.norm(sight)
    left = np.array([-sight[1], sight[0], 0.0])
    middle[2] = 0.0
    reach, aside = (
        float(np.percentile(np.abs((objects - middle) @ axis), 99.5)) + _PAD
        for axis in (sight, left)
    )
    # What hides behind the objects is the point of the picture: room for it.
    along = np.arange(-reach, reach + 0.10, resolution)
    height, up = table + 0.5 * (top - table), np.array([0.0, 0.0, 1.0])
    title = f"{100 * (height - table):.0f} cm above the table, seen from above"
    labels = ("", "to the camera's left (m)")
    across = np.arange(-aside, aside, resolution)
    horizontal = Slice(title, labels, middle + height * up, sight, left, along, across)
    title = "upright, through the middle of the objects"
    labels = ("along the line of sight (m); the camera is on the left", "height z (m)")
    upward = np.arange(table - 0.03, top + _PAD, resolution)
    return horizontal, Slice(title, labels, middle, sight, up, along, upward)


def occluded(views: tuple[Observation, ...], points: np.ndarray) -> np.ndarray:
    """Return where no view saw the point and at least one saw something in front of it."""
    status = visibility.classify_points(visibility.make_views(views, _OCCLUDED), points)
    return np.asarray(status == visibility.OCCLUDED)


def draw_slice(
    figure: Figure,
    axes: np.ndarray,
    plane: Slice,
    m: "VPrismMap",
    truth: Callable[[np.ndarray], np.ndarray] | None = None,
    unit: str = "entropy (nats)",
) -> None:
    """Draw P(occupied) and entropy on a slice into two axes, and over both what is known of it:
    observed points, occluded space, the border of support, true outlines, the table."""
    points, grid = plane.points(), plane.grid
    hidden = plane.image(occluded(m.views, points)).astype(float)
    support = plane.image(m.support(points))
    occupancy = plane.image(m.occupancy(points))
    entropy = plane.image(m.entropy(points))
    for axis, name, values, cmap, top, label in (
        (axes[0], "P(occupied)", occupancy, "viridis", 1.0, "probability"),
        (axes[1], "entropy", entropy, "magma", float(np.log(m.n_classes)), unit),
    ):
        image = axis.imshow(values, cmap=cmap, vmin=0, vmax=top, **grid)
        figure.colorbar(image, cax=axis.inset_axes((1.02, 0.0, 0.035, 1.0)), label=label)
        name_axes(axis, f"{name}, {plane.title}", *plane.labels)
        if hidden.any() and not hidden.all():
            hatch(axis, hidden, 0.5, "///", 0.35, grid)
        if support.min() <= 0 < support.max():
            known = support > 0
            axis.contour(known, levels=[0.5], colors="white", linestyles=":", linewidths=1, **grid)
        if truth is not None:
            gap = plane.image(truth(points))
            if gap.min() < 0 < gap.max():
                style = {"colors": "#ff5fa2", "linestyles": "--", "linewidths": 1.6}
                axis.contour(gap, levels=[0.0], **style, **grid)
        if occupancy.min() < 0.5 < occupancy.max():
            axis.contour(occupancy, levels=[0.5], colors="white", linewidths=1.4, **grid)
        for view in m.views:
            seen, labels = view.points()
            offset = seen[labels > 0] - plane.origin
            offset = offset[np.abs(offset @ np.cross(plane.u, plane.v)) < _NEAR_SLICE]
            x, y = offset @ plane.u, offset @ plane.v
            axis.plot(x, y, ".", markersize=1.6, color="#ffb000", rasterized=True)
        if plane.v[2] > 0.5:
            axis.axhline(float(plane.b[0]) + 0.03, color="#9ad0ff", linewidth=1.0)
        axis.axis(grid["extent"])


def hatch(axis: Axes, values: np.ndarray, low: float, marks: str, alpha: float, grid: Any) -> None:
    """Hatch in white where values are above a level."""
    shade = axis.contourf(values, levels=[low, np.inf], colors="none", hatches=[marks], **grid)
    shade.set_edgecolor((1, 1, 1, alpha))
    shade.set_linewidth(0.0)
