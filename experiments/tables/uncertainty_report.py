# SPDX-License-Identifier: BSD-3-Clause
"""The comparison of uncertainty as Markdown, JSON and heat maps."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.baselines import method
from experiments.protocols import Reconstruction, TrueScene
from experiments.reconstruction import class_entropy
from experiments.tables.uncertainty import FIGURES, METHODS
from vprism_plan._files import write_text
from vprism_plan.perception.observation import Observation
from vprism_plan.viz._figures import PALETTE, new_figure, save_figure
from vprism_plan.viz.map_plot import occluded

SHOWN = ("sgd", "vprism")
_RESOLUTION = 0.003  # metres per pixel of a heat map
_ROOM = 0.08  # metres around the seen objects
_NEAR = 0.004  # metres from the slice within which observed points are marked
_SCENES_SHOWN = 5
_REAL_COLUMNS = ("entropy_observed", "entropy_occluded", "auc_occluded", "auc_everywhere")


@dataclass(frozen=True, eq=False)
class Heat:
    """A horizontal slice of one scene: what was seen, and each method's entropy on it.

    Images have rows from near to far of the camera and columns from its left to right.

    Attributes:
        name: of the scene.
        seen: the observation.
        height: of the slice above the table, m.
        extent: left, right, near, far, m.
        entropy: (rows, columns) nats, of each method of `SHOWN`.
        hidden: (rows, columns) whether the camera could not see it.
        spots: (n, 2) observed points of objects on the slice, in the extent's coordinates.
        outline: (rows, columns) true signed distance, m; None where it is not known.
    """

    name: str
    seen: Observation
    height: float
    extent: tuple[float, float, float, float]
    entropy: dict[str, Float[np.ndarray, "r c"]]
    hidden: Bool[np.ndarray, "r c"]
    spots: Float[np.ndarray, "n 2"]
    outline: "np.ndarray | None"


def heat_of(
    name: str, seen: Observation, fits: dict[str, Reconstruction], scene: TrueScene | None = None
) -> Heat:
    """Return the slice at half the height of the seen objects, on a table at z = 0."""
    points, labels = seen.points()
    own = points[labels > 0]
    low, high = np.percentile(own, [0.5, 99.5], axis=0)
    middle, height = 0.5 * (low + high), 0.5 * float(high[2])
    away = middle - seen.camera_center
    away[2] = 0.0
    away /= np.linalg.norm(away)
    right = np.array([away[1], -away[0], 0.0])
    middle[2] = height
    local = np.stack([(own - middle) @ right, (own - middle) @ away], axis=1)
    first, last = np.percentile(local, [0.5, 99.5], axis=0)
    across = np.arange(first[0] - _ROOM, last[0] + _ROOM, _RESOLUTION)
    # What hides behind the objects is the point of the picture: room for it.
    along = np.arange(first[1] - _ROOM, last[1] + 2.0 * _ROOM, _RESOLUTION)
    a, b = np.meshgrid(across, along)
    grid = middle + a.reshape(-1, 1) * right + b.reshape(-1, 1) * away
    return Heat(
        name,
        seen,
        height,
        (float(across[0]), float(across[-1]), float(along[0]), float(along[-1])),
        {
            key: class_entropy(np.asarray(made.predict_proba(grid))).reshape(a.shape)
            for key, made in fits.items()
            if key in SHOWN
        },
        occluded((seen,), grid).reshape(a.shape),
        local[np.abs(own[:, 2] - height) < _NEAR],
        None if scene is None else scene.signed_distance(grid).reshape(a.shape),
    )


def heat_maps(heats: Sequence[Heat], title: str) -> Figure:
    """Draw one column per scene: the image, then each method's entropy on one scale."""
    figure = new_figure(2.9 * len(heats) + 1.2, 8.6)
    figure.suptitle(title)
    panels = figure.subplots(
        1 + len(SHOWN), len(heats), squeeze=False, gridspec_kw={"height_ratios": [0.75, 1, 1]}
    )
    top = max(float(values.max()) for heat in heats for values in heat.entropy.values())
    for column, heat in enumerate(heats):
        _photograph(panels[0, column], heat)
        for row, key in enumerate(SHOWN, start=1):
            axes = panels[row, column]
            image = axes.imshow(
                heat.entropy[key], origin="lower", extent=heat.extent, cmap="magma", vmin=0.0,
                vmax=top,
            )  # fmt: skip
            _marks(axes, heat)
            if column == 0:
                axes.set_ylabel(f"{method(key).label}\n\nfrom near to far (m)")
    figure.colorbar(image, ax=list(panels[1:, -1]), label="entropy (nats)", shrink=0.8)
    entries = [
        Line2D([], [], color="#7fe0ff", linewidth=1.2, label="border of what the camera saw"),
        Line2D([], [], color="#7CFC00", marker=".", linestyle="", label="observed on the slice"),
    ]
    if any(heat.outline is not None for heat in heats):
        entries.append(
            Line2D([], [], color="white", linestyle="--", label="true outline (not given)")
        )
    figure.legend(handles=entries, loc="outside lower center", ncols=3, facecolor="#555555",
                  labelcolor="white", framealpha=1.0)  # fmt: skip
    return figure


def _photograph(axes: Axes, heat: Heat) -> None:
    """The image, cut to the objects, with the pixels that the slice goes through in green."""
    seen = heat.seen
    image = seen.color if seen.color is not None else np.zeros((*seen.shape, 3), np.uint8)
    image = np.array(image, dtype=np.uint8)
    if seen.labels is not None:
        for k in seen.object_ids:
            tint = 255.0 * PALETTE[(k - 1) % len(PALETTE)]
            own = seen.labels == k
            image[own] = 0.55 * image[own] + 0.45 * tint
        with np.errstate(invalid="ignore"):
            cut = np.abs(seen.point_image()[..., 2] - heat.height) < _NEAR
        image[cut & (seen.labels > 0)] = (124, 252, 0)
        rows, columns = np.nonzero(seen.labels > 0)
        top, bottom = max(rows.min() - 40, 0), rows.max() + 40
        left, right = max(columns.min() - 40, 0), columns.max() + 40
        image = image[top:bottom, left:right]
    axes.imshow(image)
    axes.set_title(f"{heat.name}, slice at {100 * heat.height:.0f} cm", fontsize=9)
    axes.set_axis_off()


def _marks(axes: Axes, heat: Heat) -> None:
    grid: dict[str, Any] = {"origin": "lower", "extent": heat.extent}
    if heat.hidden.any() and not heat.hidden.all():
        axes.contour(heat.hidden, levels=[0.5], colors="#7fe0ff", linewidths=0.9, **grid)
    if heat.outline is not None and heat.outline.min() < 0.0 < heat.outline.max():
        axes.contour(
            heat.outline, levels=[0.0], colors="white", linestyles="--", linewidths=1.1, **grid
        )
    axes.plot(*heat.spots.T, ".", markersize=1.2, color="#7CFC00", rasterized=True)
    axes.set_xlim(heat.extent[:2])
    axes.set_ylim(heat.extent[2:])
    axes.tick_params(labelsize=7)


def write(
    figures: dict[str, Any],
    kinds: Sequence[str],
    first_seed: int,
    data: Path | None,
    frames: Sequence[tuple[str, Observation]],
    fits: Sequence[dict[str, Reconstruction]],
    output: Path,
) -> list[Path]:
    """Write uncertainty.md, .json and the heat maps into a folder; return them."""
    from experiments.generation import generate

    heats = []
    for number in range(_SCENES_SHOWN):
        kind, seed = kinds[number % len(kinds)], first_seed + number // len(kinds)
        scene = generate(kind, seed, data=data)
        made = {key: method(key).fit(scene.observation, scene.seed) for key in SHOWN}
        heats.append(heat_of(f"{kind} {seed}", scene.observation, made, scene))
    pictures = {"uncertainty": heat_maps(heats, "Generated scenes: entropy on a horizontal slice")}
    if frames:
        heats = [heat_of(*frame, made) for frame, made in zip(frames, fits, strict=True)]
        pictures["uncertainty-real"] = heat_maps(
            heats, "Real depth images: entropy on a horizontal slice"
        )
    written = []
    for name, figure in pictures.items():
        written.append(output / f"{name}.png")
        save_figure(figure, written[-1])
    written += [output / "uncertainty.json", output / "uncertainty.md"]
    write_text(written[-2], json.dumps(figures, indent=1, allow_nan=False) + "\n")
    write_text(written[-1], markdown(figures))
    return written


def markdown(figures: dict[str, Any]) -> str:
    """Return the report."""
    first, last = figures["seeds"]
    lines = [
        "# Uncertainty: does the map know what it cannot see?", "",
        "The paper's last figure, with numbers. A map with a posterior is compared with a point "
        "estimate of the same weights (Adam, no prior) from exactly the same points and features. "
        "Uncertainty is the entropy of the class probabilities.", "",
        f"Generated scenes, seeds {first} to {last} of each set. Reprint with", "",
        f"    {figures['command']}", "",
        f"Computed at commit {', '.join(figures['commits'])} (\"+\": with changes since).", "",
        "![Entropy on generated scenes](uncertainty.png)", "",
        "Each column is a scene: the image (green where the slice cuts what was seen), then the "
        "point estimate and V-PRISM on one colour scale; the camera is below. Behind the blue "
        "line the camera saw nothing. The even surface outside is where V-PRISM's hinge points "
        "end: a map has its prior there, whether the camera saw it or not, while a point estimate "
        "calls it empty.", "",
    ]  # fmt: skip
    for kind, found in figures["sets"].items():
        lines += [f"## {kind}: {found['scenes']} scenes", "", *_table(found["methods"]), ""]
        lines += ["Against the point estimate, scene by scene:", "",
                  *_table(found["against_sgd"], sign=True), ""]  # fmt: skip
    if figures["real"]:
        lines += [
            "## Real depth images", "",
            "![Entropy on real depth images](uncertainty-real.png)", "",
            "Segmented and aligned by this package; what needs the truth is left out.", "",
            "| frame | method | " + " | ".join(FIGURES[c] for c in _REAL_COLUMNS) + " |",
            "|---|---" + "|---" * len(_REAL_COLUMNS) + "|",
        ]  # fmt: skip
        for name, rows in figures["real"].items():
            for key in METHODS:
                cells = [_number(rows[key][column]) for column in _REAL_COLUMNS]
                lines.append(f"| {name} | {method(key).label} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join([*lines, *_explanation()])


def _table(rows: dict[str, Any], *, sign: bool = False) -> list[str]:
    lines = ["| method | " + " | ".join(FIGURES.values()) + " |", "|---" * (1 + len(FIGURES)) + "|"]
    for key, row in rows.items():
        cells = []
        for name in FIGURES:
            cell = _number(row[name]["value"], sign)
            if row[name]["low"] is not None:
                cell += f" [{row[name]['low']:.3f}, {row[name]['high']:.3f}]"
            cells.append(cell)
        lines.append(f"| {method(key).label} | " + " | ".join(cells) + " |")
    return lines


def _number(value: float | None, sign: bool = False) -> str:
    return "-" if value is None else f"{value:{'+' if sign else ''}.3f}"


def _explanation() -> list[str]:
    return [
        "## What the columns mean", "",
        "Means over scenes with a 95 % bootstrap interval (scenes are drawn again), on grid points "
        "1.5 cm apart within 0.2 m of every object, above the table. *Observed* is in front of "
        "what the camera saw, *occluded* behind it, both within reach of hinge points.", "",
        "- **AUC, occluded against observed**: the chance that a random occluded point has more "
        "entropy than a random observed one; 0.5 says nothing, 1 tells them apart. *Outside "
        "support too* adds the points that no hinge point reaches, where a map has its prior.",
        "- **AUC, wrong against right**: the same for points whose most probable class is wrong: "
        "whether doubt is where mistakes are.",
        "- **log loss**: mean negative logarithm of the probability of what is truly there (cut "
        "off at 1e-6). Doubt is worth having only where it makes this lower.", "",
    ]  # fmt: skip
