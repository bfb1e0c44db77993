# SPDX-License-Identifier: BSD-3-Clause
"""What all pictures share: colours, figures without global state, legends, writing them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan._files import replacing

# One colour per object id, repeated; readable on grey and apart for colour-blind eyes.
PALETTE = np.array(
    [
        [0.84, 0.38, 0.30],
        [0.26, 0.58, 0.76],
        [0.35, 0.68, 0.38],
        [0.89, 0.67, 0.24],
        [0.60, 0.44, 0.67],
        [0.31, 0.75, 0.75],
        [0.78, 0.47, 0.63],
        [0.59, 0.55, 0.27],
        [0.43, 0.43, 0.78],
        [0.90, 0.55, 0.39],
    ]
)


def object_color(object_id: int) -> np.ndarray:
    """Return the RGB colour (3,) in 0..1 that stands for an object in every picture."""
    return np.asarray(PALETTE[(object_id - 1) % len(PALETTE)])


def new_figure(width: float, height: float, title: str | None = None) -> Figure:
    """Return a figure in inches that belongs to no window and no global list."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title)
    return figure


def show_picture(axis: Axes, picture: np.ndarray, name: str) -> None:
    """Draw an image (h, w, 3) without axes."""
    axis.imshow(picture, interpolation="antialiased")
    axis.set_title(name, fontsize=11)
    axis.set_axis_off()


def name_axes(axis: Axes, name: str, x: str, y: str) -> None:
    """Title a panel, and say what its axes measure."""
    axis.set_title(name, fontsize=10)
    axis.set_xlabel(x)
    axis.set_ylabel(y)


def line(label: str, **style: Any) -> Line2D:
    """Return a legend's entry for a line or a marker."""
    return Line2D([], [], label=label, **style)


def hatched(label: str, hatch: str) -> Patch:
    """Return a dark legend's entry for hatched space."""
    return Patch(facecolor="#555555", edgecolor="white", hatch=hatch, label=label)


def legend(figure: Figure, entries: Sequence[Any], columns: int, *, dark: bool = False) -> None:
    """Put a legend under all panels; a dark one shows lines that are white on the map."""
    style = {"facecolor": "#555555", "labelcolor": "white", "framealpha": 1.0} if dark else {}
    figure.legend(handles=entries, loc="outside lower center", ncols=columns, **style)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    # The constrained layout settles over draws: saved at once, it can cut labels off.
    for _ in range(2):
        figure.draw_without_rendering()
    with replacing(path) as temporary:
        # A fixed "Software" entry keeps equal pictures equal in bytes.
        figure.savefig(temporary, format="png", metadata={"Software": "vprism_plan"})
