# SPDX-License-Identifier: BSD-3-Clause
"""Real tables, one slice each: P(occupied) with the flat prior and with the shape prior.

python -m experiments.prior.picture [--real DIR] [--output docs/images/shape_prior.png]
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from experiments.tables.uncertainty import real_observations
from vprism_plan.mapping import VPrismMap, fit_map
from vprism_plan.viz._figures import new_figure, save_figure, show_picture

_STEP = 0.004  # metres per pixel
_HEIGHT = 0.05  # metres above the table


def slice_of(fitted: VPrismMap) -> tuple[np.ndarray, tuple[float, ...], np.ndarray, np.ndarray]:
    """P(occupied) at one height, its extent, and the seen points of the objects near it."""
    points, labels = fitted.views[0].points()
    seen = points[labels > 0]
    up = fitted.plane.normal
    low, high = seen[:, :2].min(axis=0) - 0.12, seen[:, :2].max(axis=0) + 0.12
    x, y = (np.arange(a, b, _STEP) for a, b in zip(low, high, strict=True))
    grid = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
    grid[:, 2] = (fitted.plane.offset + _HEIGHT - grid[:, :2] @ up[:2]) / up[2]
    near = np.abs(fitted.plane.signed_distance(seen) - _HEIGHT) < 0.006
    camera = fitted.views[0].camera_center[:2]
    image = fitted.occupancy(grid).reshape(len(y), len(x))
    return image, (low[0], high[0], low[1], high[1]), seen[near], camera


def figure_of(frames: list[tuple[str, Any]]) -> Any:
    """Draw a column per frame: the picture, the flat prior, the shape prior."""
    figure = new_figure(3.0 * len(frames), 8.2)
    axes = figure.subplots(3, len(frames), squeeze=False)
    for column, (name, view) in enumerate(frames):
        show_picture(axes[0, column], view.color, name)
        for row, (prior, title) in enumerate(((None, "flat prior"), ("shape", "shape prior"))):
            image, extent, seen, camera = slice_of(fit_map(view, prior=prior))
            axis = axes[1 + row, column]
            drawn = axis.imshow(
                image, origin="lower", extent=extent, vmin=0.0, vmax=1.0, cmap="magma"
            )
            axis.plot(*seen[:, :2].T, ".", markersize=0.8, color="deepskyblue")
            middle = np.array([extent[0] + extent[1], extent[2] + extent[3]]) / 2.0
            way = (middle - camera) / np.linalg.norm(middle - camera)
            axis.annotate(
                "", middle - 0.1 * way, middle - 0.16 * way, arrowprops={"color": "white"}
            )
            axis.set_title(title, fontsize=9)
            axis.set_xlim(*extent[:2])
            axis.set_ylim(*extent[2:])
            axis.tick_params(labelsize=7)
    figure.colorbar(drawn, ax=axes[1:, :], shrink=0.6, label=f"P(occupied) {_HEIGHT:g} m up")
    return figure


def main() -> int:
    """Draw what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--output", type=Path, default=Path("docs/images/shape_prior.png"))
    chosen = parser.parse_args()
    frames = real_observations(chosen.real)
    if not frames:
        parser.error("there are no real depth images; give their folder by --real")
    save_figure(figure_of(frames), chosen.output)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
