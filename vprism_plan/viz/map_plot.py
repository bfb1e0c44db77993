# SPDX-License-Identifier: BSD-3-Clause
"""The map as a picture: occupancy and entropy on two slices (as in the paper's figures)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan.perception import Observation
from vprism_plan.perception.camera import invert_transform, project, transform_points
from vprism_plan.viz._figures import new_figure

if TYPE_CHECKING:
    from vprism_plan.mapping import VPrismMap

_PAD = 0.10  # metres shown around the labelled points
_NEAR_SLICE = 0.006  # metres from the slice within which observed points are drawn
_OCCLUDED = 0.01  # metres behind the measured depth


@dataclass(frozen=True)
class Slice:
    """A plane through the world: origin + a * u + b * v for a, b in the given ranges."""

    title: str
    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    a: np.ndarray
    b: np.ndarray
    a_label: str
    b_label: str

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """First and last a, first and last b, as matplotlib wants them."""
        return float(self.a[0]), float(self.a[-1]), float(self.b[0]), float(self.b[-1])

    def points(self) -> np.ndarray:
        """World points (len(b) * len(a), 3), metres."""
        a, b = np.meshgrid(self.a, self.b)
        return self.origin + a.reshape(-1, 1) * self.u + b.reshape(-1, 1) * self.v

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values at `points` as rows of b and columns of a."""
        return np.asarray(values).reshape(len(self.b), len(self.a))

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Return the (a, b) of world points that lie close to the slice."""
        offset = points - self.origin
        near = np.abs(offset @ np.cross(self.u, self.v)) < _NEAR_SLICE
        return np.stack([offset[near] @ self.u, offset[near] @ self.v], axis=1)


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
    figure = new_figure(12.6, 4.9 * sum(heights) + 1.7)
    axes = figure.subplots(2, 2, sharex=True, gridspec_kw={"height_ratios": heights})
    if title:
        figure.suptitle(title)
    for row, plane in enumerate(slices):
        points = plane.points()
        hidden = plane.image(occluded(m.views, points)).astype(float)
        support = plane.image(m.support(points))
        occupancy = plane.image(m.occupancy(points))
        panels = (
            ("P(occupied)", occupancy, "viridis", 1.0, "probability"),
            ("entropy", m.entropy(points), "magma", float(np.log(m.n_classes)), "entropy (nats)"),
        )
        for column, (name, values, cmap, top, label) in enumerate(panels):
            axis = axes[row, column]
            image = axis.imshow(
                plane.image(values),
                origin="lower",
                extent=plane.extent,
                cmap=cmap,
                vmin=0,
                vmax=top,
            )
            figure.colorbar(image, cax=axis.inset_axes((1.02, 0.0, 0.035, 1.0)), label=label)
            axis.set_title(f"{name}, {plane.title}", fontsize=10)
            axis.set_xlabel(plane.a_label)
            axis.set_ylabel(plane.b_label)
            overlay(axis, plane, m, hidden, support, occupancy, truth)
    _legend(figure, truth is not None)
    return figure


def _slices(m: "VPrismMap", resolution: float) -> tuple[Slice, Slice]:
    """Both slices share their first axis, the direction in which the camera looks."""
    seen = [view.points() for view in m.views]
    objects = np.concatenate([points[labels > 0] for points, labels in seen])
    low, high = np.percentile(objects, [0.5, 99.5], axis=0)
    middle = 0.5 * (low + high)
    normal = m.plane.normal
    table = float((m.plane.offset - normal[:2] @ middle[:2]) / normal[2])
    top = float(high[2])
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
    height = table + 0.5 * (top - table)
    horizontal = Slice(
        title=f"{100 * (height - table):.0f} cm above the table, seen from above",
        origin=middle + np.array([0.0, 0.0, height]),
        u=sight,
        v=left,
        a=along,
        b=np.arange(-aside, aside, resolution),
        a_label="",
        b_label="to the camera's left (m)",
    )
    vertical = Slice(
        title="upright, through the middle of the objects",
        origin=middle,
        u=sight,
        v=np.array([0.0, 0.0, 1.0]),
        a=along,
        b=np.arange(table - 0.03, top + _PAD, resolution),
        a_label="along the line of sight (m); the camera is on the left",
        b_label="height z (m)",
    )
    return horizontal, vertical


def occluded(views: tuple[Observation, ...], points: np.ndarray) -> np.ndarray:
    """Return where no view saw the point and at least one saw something in front of it."""
    behind = np.zeros(len(points), dtype=bool)
    seen = np.zeros(len(points), dtype=bool)
    for view in views:
        local = transform_points(invert_transform(view.pose), points)
        pixels, depth = project(local, view.intrinsics)
        column, row = np.round(np.clip(np.nan_to_num(pixels, nan=-1.0), -1, 1e6)).astype(int).T
        height, width = view.shape
        inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        measured = np.zeros(len(points))
        measured[inside] = view.depth[row[inside], column[inside]]
        behind |= inside & (measured > 0) & (depth > measured + _OCCLUDED)
        seen |= inside & (measured > 0) & (depth <= measured + _OCCLUDED)
    return behind & ~seen


def overlay(
    axis: Axes,
    plane: Slice,
    m: "VPrismMap",
    hidden: np.ndarray,
    support: np.ndarray,
    occupancy: np.ndarray,
    truth: Callable[[np.ndarray], np.ndarray] | None,
) -> None:
    """Observed points, occluded space, the border of support, true outlines, the table."""
    grid: dict[str, Any] = {"origin": "lower", "extent": plane.extent}
    if hidden.any() and not hidden.all():
        shade = axis.contourf(hidden, levels=[0.5, 1.5], colors="none", hatches=["///"], **grid)
        shade.set_edgecolor((1, 1, 1, 0.35))
        shade.set_linewidth(0.0)
    if support.min() <= 0 < support.max():
        axis.contour(
            support > 0, levels=[0.5], colors="white", linestyles=":", linewidths=1, **grid
        )
    if truth is not None:
        distance = plane.image(truth(plane.points()))
        if distance.min() < 0 < distance.max():
            axis.contour(
                distance, levels=[0.0], colors="#ff5fa2", linestyles="--", linewidths=1.6, **grid
            )
    if occupancy.min() < 0.5 < occupancy.max():
        axis.contour(occupancy, levels=[0.5], colors="white", linewidths=1.4, **grid)
    for view in m.views:
        points, labels = view.points()
        spots = plane.locate(points[labels > 0])
        axis.plot(*spots.T, ".", markersize=1.6, color="#ffb000", rasterized=True)
    if plane.v[2] > 0.5:
        axis.axhline(float(plane.b[0]) + 0.03, color="#9ad0ff", linewidth=1.0)
    axis.set_xlim(plane.extent[:2])
    axis.set_ylim(plane.extent[2:])


def _legend(figure: Figure, with_truth: bool) -> None:
    entries: list[Line2D | Patch] = [
        Line2D([], [], marker=".", linestyle="", color="#ffb000", label="observed points"),
        Line2D([], [], color="white", linewidth=1.6, label="P(occupied) = 0.5"),
        Line2D([], [], color="white", linestyle=":", label="end of the map's support"),
        Patch(facecolor="#555555", edgecolor="white", hatch="///", label="occluded"),
        Line2D([], [], color="#9ad0ff", label="table"),
    ]
    if with_truth:
        entries.append(
            Line2D(
                [], [], color="#ff5fa2", linestyle="--", label="true outline (not given to the map)"
            )
        )
    figure.legend(
        handles=entries,
        loc="outside lower center",
        ncols=3,
        facecolor="#555555",
        labelcolor="white",
        framealpha=1.0,
    )
