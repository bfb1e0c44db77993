# SPDX-License-Identifier: BSD-3-Clause
"""Do reconstructions of neighbours intersect? Maps of their own against one map of all.

The paper's figure of intersecting reconstructions, with a count. Reprint it with
`python -m experiments.tables.intersections [FOLDER]`.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.baselines import method
from experiments.baselines.sigmoid import overlap
from experiments.protocols import Reconstruction, TrueScene
from experiments.tables.scoring import commit
from vprism_plan._files import write_text
from vprism_plan.viz._figures import PALETTE, new_figure, save_figure

METHODS = ("sigmoid", "vprism")
SEEDS = range(1000, 1004)
KIND = "analytic"
LEVEL = 0.5
_CELL = 0.01  # metres between the points that are counted
_ROOM = 0.05  # metres around the true objects in which they are
_FINE = 0.001  # metres per pixel of the picture
_MARGIN = 0.03  # metres around the intersection that the picture shows at least


def claimed_points(scene: TrueScene) -> Float[np.ndarray, "n 3"]:
    """Return the points (m), above the table, where claims are counted."""
    bounds = np.array([mesh.bounds for mesh in scene.truth_meshes().values()])
    low, high = bounds[:, 0].min(axis=0) - _ROOM, bounds[:, 1].max(axis=0) + _ROOM
    low[2] = 0.0
    axes = [
        np.arange(np.ceil(a / _CELL), np.floor(b / _CELL) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return _CELL * (index + 0.5)


def run(output: Path, seeds: Sequence[int] = SEEDS, kind: str = KIND) -> list[Path]:
    """Count doubly claimed space in some scenes and draw the worst; return the files."""
    from experiments.generation import generate

    rows, worst = [], None
    for seed in seeds:
        scene = generate(kind, seed)
        points = claimed_points(scene)
        row: dict[str, Any] = {"scene": scene.name}
        fits = {key: method(key).fit(scene.observation, scene.seed) for key in METHODS}
        for key, found in fits.items():
            proba = found.predict_proba(points)
            twice, any_ = overlap(proba, LEVEL)
            row[key] = {"twice": twice, "claimed": any_}
            claims = (proba[:, 1:] >= LEVEL).sum(axis=1)
            if key == "sigmoid" and (worst is None or twice > worst[0]):
                worst = (twice, scene, fits, row, points[claims > 1])
        rows.append(row)
    assert worst is not None
    counts = {"commit": commit(), "level": LEVEL, "cell": _CELL, "rows": rows}
    files = [output / f"intersections.{kind_}" for kind_ in ("png", "json", "md")]
    save_figure(picture(*worst[1:]), files[0])
    write_text(files[1], json.dumps(counts, indent=1) + "\n")
    write_text(files[2], markdown(counts))
    return files


def picture(
    scene: TrueScene,
    fits: dict[str, Reconstruction],
    row: dict[str, Any],
    twice: Float[np.ndarray, "n 3"],
) -> Figure:
    """Draw both methods on the horizontal slice with most doubly claimed points.

    `row` holds the counts of `run`; `twice` (m) the points that sigmoid maps claim twice.
    """
    heights, counts = np.unique(twice[:, 2], return_counts=True)
    height = float(heights[counts.argmax()]) if len(heights) else 0.03
    here = twice[twice[:, 2] == height][:, :2] if len(twice) else np.zeros((1, 2))
    low, high = here.min(axis=0) - _MARGIN, here.max(axis=0) + _MARGIN
    half = max(0.5 * float((high - low).max()), 0.08)
    middle = 0.5 * (low + high)
    x, y = (np.arange(c - half, c + half, _FINE) for c in middle)
    a, b = np.meshgrid(x, y)
    grid = np.stack([a.ravel(), b.ravel(), np.full(a.size, height)], axis=1)
    truth = scene.object_of(grid).reshape(a.shape)
    figure = new_figure(10.4, 5.9)
    figure.suptitle(f"{scene.name}: level sets P(object) >= {LEVEL:g}, {100 * height:.1f} cm high")
    for axes, key in zip(figure.subplots(1, 2, sharey=True), METHODS, strict=True):
        found = fits[key]
        proba = found.predict_proba(grid)[:, 1:].reshape(*a.shape, -1)
        _claims(axes, x, y, proba, found.object_ids, truth)
        volume = 1e6 * row[key]["twice"] * _CELL**3
        axes.set_title(
            f"{method(key).label}\n{volume:.0f} cm$^3$ of the scene claimed twice", fontsize=10
        )
        axes.set_xlabel("x (m)")
    figure.axes[0].set_ylabel("y (m)")
    figure.legend(
        handles=[
            Patch(facecolor="#888888", alpha=0.6, label="one object"),
            Patch(facecolor="black", label="two objects or more"),
            Line2D([], [], color="0.15", linestyle="--", label="true outline (not given)"),
        ],
        loc="outside lower center", ncols=3, frameon=False,
    )  # fmt: skip
    return figure


def _claims(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    proba: Float[np.ndarray, "r c k"],
    object_ids: tuple[int, ...],
    truth: np.ndarray,
) -> None:
    """One colour per object, black where several claim a pixel."""
    claims = proba >= LEVEL
    image = np.ones((*claims.shape[:2], 3))
    for k, object_id in enumerate(object_ids):
        color = PALETTE[(object_id - 1) % len(PALETTE)]
        image[claims[..., k]] = 0.4 + 0.6 * color
    image[claims.sum(axis=-1) > 1] = 0.0
    extent = (float(x[0]), float(x[-1]), float(y[0]), float(y[-1]))
    axes.imshow(image, origin="lower", extent=extent)
    for object_id in object_ids:
        inside = truth == object_id
        if inside.any() and not inside.all():
            axes.contour(
                inside, levels=[0.5], colors="0.15", linestyles="--", linewidths=1.2,
                origin="lower", extent=extent,
            )  # fmt: skip


def markdown(found: dict[str, Any]) -> str:
    """Return the counts as a report."""
    lines = [
        "# Intersecting reconstructions", "",
        "The same points and features, learned by one binary map per object and by one map of all "
        f"classes: how much space two or more objects claim at level {LEVEL:g}, in points "
        f"{1000 * _CELL:g} mm apart, of those that any claims. Probabilities of one softmax sum to "
        "1, so two of them cannot both exceed one half. Reprint with", "",
        "    python -m experiments.tables.intersections", "",
        f"Computed at commit {found['commit']} (\"+\": with changes since).", "",
        "![Two objects in one place](intersections.png)", "",
        "| scene | " + " | ".join(f"{method(k).label}: twice, of claimed" for k in METHODS) + " |",
        "|---" * (1 + len(METHODS)) + "|",
    ]  # fmt: skip
    for row in found["rows"]:
        cells = [
            f"{row[k]['twice']}, of {row[k]['claimed']} "
            f"({100.0 * row[k]['twice'] / max(row[k]['claimed'], 1):.1f} %)"
            for k in METHODS
        ]
        lines.append(f"| {row['scene']} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def main(folder: str | Path = Path("docs") / "results") -> list[Path]:
    """Write the report into `folder`."""
    return run(Path(folder))


if __name__ == "__main__":
    sys.stdout.write("".join(f"wrote {path}\n" for path in main(*sys.argv[1:2])))
