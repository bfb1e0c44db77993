# SPDX-License-Identifier: BSD-3-Clause
"""A table as Markdown, JSON and pictures, written so that it explains itself."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.baselines import method
from experiments.scene_truth import CLOUD, REACH, SPACING
from experiments.tables.claims import REPORTED, Claim, Verdict, claims_of
from experiments.tables.intervals import CONFIDENCE, RESAMPLES
from experiments.tables.results import SetResults, TableResults, summary
from experiments.tables.tuning import LAST_SEED, SETS
from vprism_plan._files import write_text

SET_NAMES = {
    "analytic": "Analytic solids",
    "ycb": "YCB objects",
    "random": "Random objects",
    "random-train": "Random objects (training)",
    "folder": "Meshes of a folder",
}


def write_report(results: TableResults, output: Path) -> list[Path]:
    """Write KEY.md, KEY.json and the pictures into a folder; return them."""
    from experiments.tables import pictures
    from vprism_plan.viz._figures import save_figure

    key, figures = results.table.key, summary(results)
    written = []
    for name, figure in pictures.figures(results, figures).items():
        written.append(output / f"{name}.png")
        save_figure(figure, written[-1])
    written += [output / f"{key}.json", output / f"{key}.md"]
    write_text(written[-2], json.dumps(figures, indent=1, allow_nan=False) + "\n")
    write_text(written[-1], markdown(results, figures))
    return written


def markdown(results: TableResults, figures: dict[str, Any]) -> str:
    """Return the report in Markdown; `figures` is `summary(results)`."""
    table, seeds = results.table, results.seeds
    lines = [
        f"# {table.title}", "", table.about, "", *_not_computed(results),
        f"{len(seeds)} generated scenes of each set, seeds {seeds[0]} to {seeds[-1]}; 3 to 10 "
        "meshes dropped close together until they rest, one view of 640 x 480 pixels with sensor "
        "noise. Reprint with", "",
        f"    {results.command}", "",
        f"Computed at commit {', '.join(figures['commits'])} (\"+\": with changes since).", "",
        *_held_out(results),
    ]  # fmt: skip
    if results.left_out:
        lines += ["Left out for every method, since these failed:", ""]
        lines += [*(f"- {line}" for line in results.left_out), ""]
    lines += _claims(results)
    lines += [f"![IoU and Chamfer of every method]({table.key}.png)", ""]
    for found in results.sets:
        lines += _set_section(found, results, figures["sets"][found.kind])
    lines += [
        f"![Reliability of P(occupied)]({table.key}-reliability.png)", "",
        "Reliability: of the grid points that a method gives a probability (horizontal), how "
        "many are truly occupied (vertical). On the diagonal the probability is true.", "",
    ]  # fmt: skip
    if {"vprism", "vprism-paper"} <= set(results.methods):
        lines += [
            f"![Scene by scene]({table.key}-scenes.png)", "",
            "Scene by scene: the default preset (vertical) against the paper's (horizontal), "
            "mean over the scene's objects.", "",
        ]  # fmt: skip
    return "\n".join([*lines, *_explanation()])


def _held_out(results: TableResults) -> list[str]:
    """What of these sets our presets were not tuned on: scenes, or objects as well."""
    by_scene = [f.kind for f in results.sets if f.kind in SETS]
    by_object = [f.kind for f in results.sets if f.kind == "random"]
    words = [f"`{kind}` is held out by scene, not by object" for kind in by_scene]
    words += [f"the objects of `{kind}` were in no tuning scene" for kind in by_object]
    if not words:
        return []
    return [f"Our presets were chosen on seeds 0 to {LAST_SEED}: {'; '.join(words)}.", ""]


def _not_computed(results: TableResults) -> list[str]:
    """Which rows of the table are left out, and what "every" in a claim then stands for."""
    missing = [key for key in results.table.methods if key not in results.methods]
    if not missing:
        return []
    text = f"Rows of this table that were not computed: {_names(missing)}."
    claims = claims_of(results.table.key, results.methods)
    for phrase in ("every continuous baseline", "every baseline"):
        pairs = [pair for claim in claims if phrase in claim.text for pair in claim.pairs]
        if pairs:
            covered = list(dict.fromkeys(other for _, other in pairs))
            text += f' "{phrase.capitalize()}" below stands for {_names(covered)}.'
    return [text, ""]


def _names(keys: Sequence[str]) -> str:
    return "; ".join(method(key).label for key in keys)


def _claims(results: TableResults) -> list[str]:
    """Which statements hold on which set."""
    if not results.verdicts:
        return []
    kinds = [found.kind for found in results.sets]
    lines = ["## What holds", "", "| statement | " + " | ".join(kinds) + " |"]
    lines.append("|---" * (1 + len(kinds)) + "|")
    for claim in claims_of(results.table.key, results.methods):
        cells = [_verdict(claim, results.verdicts[claim.text][kind]) for kind in kinds]
        lines.append(f"| {claim.text} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "In brackets: the gain and its 95 % interval over scenes, above 0 is better; for Chamfer "
        "the share that is saved, on the objects that both methods reconstruct. "
        '"yes": the whole interval says so, in every comparison where there are several. "no": '
        'that of one comparison says the opposite. "in the mean": only the means do. Of several '
        "comparisons that give the answer it is the one whose interval reaches lowest, and its "
        "methods are named.",
        "",
    ]
    return lines


def _verdict(claim: Claim, verdict: Verdict) -> str:
    scale, unit, digits = (100.0, " %", 0) if claim.metric == "chamfer" else (1.0, "", 3)
    g = verdict.gain
    numbers = f"{scale * g.value:+.{digits}f}{unit}"
    if g.low == g.low:
        numbers += f" [{scale * g.low:.{digits}f}, {scale * g.high:.{digits}f}]"
    named = f"; {verdict.pair[0]} vs {verdict.pair[1]}" if len(claim.pairs) > 1 else ""
    return f"**{verdict.answer}** ({numbers}{named})"


def _set_section(found: SetResults, results: TableResults, figures: dict[str, Any]) -> list[str]:
    """Return the tables of one set."""
    name = SET_NAMES.get(found.kind, found.kind)
    points = ", ".join(f"{count} {part}" for part, count in figures["points"].items())
    lines = [
        f"## {name} (`{found.kind}`)", "",
        f"{figures['scenes']} scenes with {figures['objects']} objects; {figures['judged']} show "
        f"labelled pixels and count, {figures['hidden']} are wholly hidden. Grid points above the "
        f"table: {points}.", "",
        "| method | IoU | Chamfer (mm) | lost | fit (s) | predict (µs per point) |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for key in results.methods:
        row = figures["methods"][key]
        lines.append(
            f"| {_name(key)} | {_cell(row['iou'])} | {_cell(row['chamfer'], 1000.0, 1)} "
            f"| {row['lost']} | {row['fit_seconds']:.2f} | {row['predict_microseconds']:.1f} |"
        )
    parts = list(REPORTED)
    titles = [f"Brier, {p}" for p in parts] + [f"ECE, {p}" for p in parts]
    titles += ["entropy, visible", "entropy, occluded"]
    lines += ["", "| method | " + " | ".join(titles) + " |", "|---" * (1 + len(titles)) + "|"]
    for key in results.methods:
        row = figures["methods"][key]
        cells = [_cell(row["brier"][p]) for p in parts] + [_cell(row["ece"][p]) for p in parts]
        cells += [_cell(row["entropy"][p], digits=2) for p in ("visible", "occluded")]
        lines.append(f"| {_name(key)} | " + " | ".join(cells) + " |")
    return [*lines, "", *_differences(results, figures)]


def _differences(results: TableResults, figures: dict[str, Any]) -> list[str]:
    """Rows against the table's reference, scene by scene."""
    rows = {key: figures["methods"][key].get("against_reference") for key in results.methods}
    if not any(rows.values()):
        return []
    lines = [
        f"Against {_name(results.table.reference)}, over the same scenes (above 0 is better):", "",
        "| method | IoU | Chamfer saved (%) | Brier, occluded | ECE, occluded |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for key, row in rows.items():
        if row is not None:
            lines.append(
                f"| {_name(key)} | {_cell(row['iou'], sign=True)} "
                f"| {_cell(row['chamfer_saved'], 100.0, 0, sign=True)} "
                f"| {_cell(row['brier_occluded'], sign=True)} "
                f"| {_cell(row['ece_occluded'], sign=True)} |"
            )
    return [*lines, ""]


def _name(key: str) -> str:
    """Label of a method with what a reader must know of it."""
    chosen = method(key)
    notes = [] if chosen.level == 0.5 else [f"level {chosen.level:g}"]
    if not chosen.continuous:
        notes.append("per voxel")
    return chosen.label + (f" ({', '.join(notes)})" if notes else "")


def _cell(
    found: dict[str, float | None], scale: float = 1.0, digits: int = 3, *, sign: bool = False
) -> str:
    if found["value"] is None:
        return "-"
    text = f"{scale * found['value']:{'+' if sign else ''}.{digits}f}"
    if found["low"] is None or found["high"] is None:
        return text
    return f"{text} [{scale * found['low']:.{digits}f}, {scale * found['high']:.{digits}f}]"


def _explanation() -> list[str]:
    """What the columns mean."""
    return [
        "## What the columns mean", "",
        f"In brackets is a {100 * CONFIDENCE:.0f} % bootstrap interval: scenes are drawn again "
        f"({RESAMPLES} times, percentiles), since objects of one scene hide one another.", "",
        "- **IoU**: intersection over union of an object with {x : P(object | x) >= level}, "
        f"level 0.5 unless stated, over grid points {100 * SPACING:g} cm apart within "
        f"{REACH:g} m of the object's true centre along each axis, the space under the table "
        "included. Mean over all objects with labelled pixels; an object that a method loses "
        "counts 0.",
        "- **Chamfer**: distance of that set's surface (marching cubes at 1 cm; at 5 mm for "
        "methods that answer per voxel of 1 cm, so that no side of a voxel is shifted) to the "
        f"true surface: {CLOUD:,} points on each, mean distance to the nearest of the other, both "
        "directions added. Two samples of one and the same surface of 300 cm2 are 1.7 mm apart by "
        "this measure. Mean over objects that are not lost.",
        "- **lost**: objects without any reconstructed surface.",
        "- **fit, predict**: processor time on one core; the median fit, the mean prediction.",
        "- **Brier, ECE**: mean squared error of P(occupied) = 1 - P(empty), and expected "
        "calibration error in ten bins, over the grid points above the table of all objects "
        "together. *Visible*: in front of what the camera saw. *Occluded*: behind it. *Outside "
        "support*: visible or occluded, but farther from the seen objects than a lattice of hinge "
        "points reaches (kernel mass below 0.5; 8 to 12 cm). The split depends on the view "
        "alone, and is the same for every method.",
        "- **entropy**: mean entropy of the class probabilities in nats. A method that knows "
        "what it cannot see has more of it in occluded space.", "",
    ]  # fmt: skip
