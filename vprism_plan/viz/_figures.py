# SPDX-License-Identifier: BSD-3-Clause
"""What all pictures share: colours, figures without global state, writing them."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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


def new_figure(width: float, height: float) -> Figure:
    """Return a figure in inches that belongs to no window and no global list."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    # The constrained layout settles over draws: saved at once, it can cut labels off.
    for _ in range(2):
        figure.draw_without_rendering()
    with replacing(path) as temporary:
        # A fixed "Software" entry keeps equal pictures equal in bytes.
        figure.savefig(temporary, format="png", metadata={"Software": "vprism_plan"})
