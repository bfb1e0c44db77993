# SPDX-License-Identifier: BSD-3-Clause
"""The input as a picture: colour, depth, and which pixel belongs to which object."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vprism_plan.perception import Observation
from vprism_plan.viz._figures import new_figure, object_color


def scene_figure(obs: Observation, *, title: str | None = None) -> Figure:
    """Draw depth (metres) and the label overlay of one view, and its colour image if any."""
    panels = 3 if obs.color is not None else 2
    height, width = obs.shape
    figure = new_figure(4.6 * panels + 0.4, 4.6 * height / width + 0.6)
    axes = list(figure.subplots(1, panels, squeeze=False)[0])
    if title:
        figure.suptitle(title)
    if obs.color is not None:
        axes[0].imshow(obs.color)
        axes[0].set_title("colour")
    _draw_depth(figure, axes[-2], obs)
    _draw_labels(axes[-1], obs)
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    return figure


def _draw_depth(figure: Figure, axis: Axes, obs: Observation) -> None:
    depth = np.where(obs.depth > 0, obs.depth, np.nan).astype(np.float64)
    # The far background would otherwise take all the contrast from the table.
    high = float(np.nanpercentile(depth, 98.0)) if np.isfinite(depth).any() else 1.0
    axis.set_facecolor("black")
    image = axis.imshow(depth, cmap="viridis_r", vmax=high, interpolation="nearest")
    figure.colorbar(image, ax=axis, label="depth (m)", shrink=0.85)
    lost = 100.0 * float((obs.depth == 0).mean())
    axis.set_title(f"depth ({lost:.1f} % without return, black)")


def _draw_labels(axis: Axes, obs: Observation) -> None:
    shade = np.where(obs.depth > 0, obs.depth, np.nan).astype(np.float64)
    if obs.color is not None:
        grey = obs.color.mean(axis=2) / 255.0
    elif np.isfinite(shade).any():
        low, high = np.nanpercentile(shade, [1.0, 98.0])
        grey = np.nan_to_num(1.0 - np.clip((shade - low) / max(high - low, 1e-9), 0.0, 1.0))
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
    axis.imshow(np.clip(picture, 0.0, 1.0), interpolation="nearest")
    for object_id in obs.object_ids:
        rows, columns = np.nonzero(obs.labels == object_id)
        axis.annotate(
            str(object_id),
            (float(np.median(columns)), float(np.median(rows))),
            ha="center",
            va="center",
            fontsize=9,
            color="white",
            bbox={"boxstyle": "round,pad=0.2", "fc": (0, 0, 0, 0.55), "ec": "none"},
        )
    axis.set_title(f"labels ({len(obs.object_ids)} objects)")
