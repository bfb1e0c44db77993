# SPDX-License-Identifier: BSD-3-Clause
"""Are the probabilities true? Held-out scenes with known solids, voxels and paths.

    python -m experiments.benchmarks.calibration [--scenes 60] [--first-seed 2000]
        [--preset default]

Scene by scene, each kept in build/calibration/ as soon as it is done: started again, it
goes on where it stopped, unless the preset or the number below has changed since. Writes
docs/results/calibration[-PRESET].md, .json and .png. The presets were chosen on scenes of the
generator (`experiments.tuning`, seeds 0 to 99), earlier ones on seeds 1000 to 1011 of these;
any from 2000 on are held out.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.calibration import PARTS, VoxelCalibration, calibration_scene, evaluate_voxels
from experiments.metrics import Reliability, ReliabilityBin
from experiments.path_calibration import PathCalibration, evaluate_paths
from experiments.tables.intervals import over_scenes
from vprism_plan._files import write_text
from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.viz._figures import new_figure, save_figure

ROOT = Path(__file__).resolve().parents[2]
VERSION = 1  # of what is kept of a scene; raised by hand when the code's meaning changes
Rows = tuple[ReliabilityBin, ...]
PRESETS = {"default": MapConfig, "fine": MapConfig.fine, "paper": MapConfig.paper}


def one_scene(seed: int, config: MapConfig, paths: int, keep: Path) -> dict[str, Any]:
    """Evaluate a scene, or read what an earlier run made of it."""
    asked = {"version": VERSION, "config": asdict(config), "paths": paths, "seed": seed}
    asked = json.loads(json.dumps(asked))
    if keep.is_file():
        done: dict[str, Any] = json.loads(keep.read_text(encoding="utf-8"))
        if {"version": 1, **done["asked"]} == asked:  # the first had no number
            return done
    scene = calibration_scene(seed)
    fitted = fit_map(scene.observation, config, seed=seed)
    done = {
        "asked": asked,
        "objects": len(scene.solids),
        "voxels": evaluate_voxels(scene, fitted).to_dict(),
        "paths": evaluate_paths(scene, fitted, paths, seed).to_dict() if paths else {"cases": []},
    }
    write_text(keep, json.dumps(done) + "\n")
    return done


def curve(axes: Any, table: Reliability, title: str, rows: Rows, intervals: bool) -> None:
    """Draw observed against predicted, and how many predictions stand behind each point."""
    x, y = [r.predicted for r in rows], [r.observed for r in rows]
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
    if intervals:
        spread = [[r.observed - r.low for r in rows], [r.high - r.observed for r in rows]]
        axes.errorbar(x, y, spread, color="#205080", marker="o", capsize=3)
    else:
        axes.plot(x, y, color="#205080", marker="o")
    shares = axes.twinx()
    left = [r.lower for r in rows]
    shares.bar(
        left, [r.count / table.n for r in rows], 0.1, align="edge", color="#205080", alpha=0.15
    )
    shares.set_ylim(0, 1)
    shares.set_ylabel("share of the predictions (bars)")
    axes.set(
        xlim=(0, 1), ylim=(0, 1), xlabel="predicted probability", ylabel="observed frequency",
        title=f"{title}\nECE {table.ece:.3f}, Brier {table.brier:.3f}, n = {table.n}",
    )  # fmt: skip


def picture(
    voxels: VoxelCalibration, paths: PathCalibration, rows: dict[str, Rows], file: Path
) -> None:
    """Write the reliability curves."""
    figure = new_figure(11.0, 5.0)
    left, right = figure.subplots(1, 2)
    curve(left, voxels.parts[1], "Occupancy of a voxel: occluded, supported", rows["voxels"], False)
    if paths.judged:
        title = "Joint collision probability of a path"
        curve(right, paths.reliability(), title, rows["reported"], True)
        centres = paths.reliability(inside=True)
        right.plot(
            [r.predicted for r in rows["defined"]],
            [r.observed for r in rows["defined"]],
            color="#c05030", marker="s", label=f"voxel centres alone, ECE {centres.ece:.3f}",
        )  # fmt: skip
        right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)
    save_figure(figure, file)


def table(rows: Rows) -> str:
    """Return a reliability table in Markdown."""
    lines = [
        "| predicted | count | mean predicted | observed | 95 % interval |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.lower:.1f} to {r.upper:.1f} | {r.count} | {r.predicted:.3f} | {r.observed:.3f} "
        f"| {r.low:.3f} to {r.high:.3f} |"
        for r in rows
    ]
    return "\n".join(lines)


def rows_of(done: list[dict[str, Any]]) -> dict[str, Rows]:
    """Return the reliability tables with intervals over scenes."""
    paths = [PathCalibration.from_dict(d["paths"]) for d in done]
    return {
        "voxels": over_scenes([VoxelCalibration.from_dict(d["voxels"]).parts[1] for d in done]),
        "reported": over_scenes([one.reliability() for one in paths]),
        "defined": over_scenes([one.reliability(inside=True) for one in paths]),
    }


def report(
    name: str,
    scenes: int,
    first: int,
    voxels: VoxelCalibration,
    paths: PathCalibration,
    rows: dict[str, Rows],
) -> str:
    """Return the results in Markdown."""
    out = [
        f"# Calibration of the {name} preset", "",
        f"{scenes} generated scenes with sensor noise (seeds {first} to {first + scenes - 1}, none "
        "used for tuning): 1 to 8 objects close together, every sixth with an object no pixel "
        "shows. ECE over ten bins of equal width. Reproduce with", "",
        f"    python -m experiments.benchmarks.calibration --scenes {scenes} --first-seed {first} "
        f"--preset {name}", "",
        f"![Reliability curves](calibration{'' if name == 'default' else '-' + name}.png)", "",
        "## Voxels (1 cm)", "",
        "| space | voxels | truly occupied | predicted | Brier | ECE |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    out += [
        f"| {part} | {t.n} | {t.mean_observed:.3f} | {t.mean_predicted:.3f} | {t.brier:.3f} "
        f"| {t.ece:.3f} |"
        for part, t in zip(PARTS, voxels.parts, strict=True)
    ]
    out += [
        "",
        f"Objects: mean IoU with the level set {voxels.mean_iou:.3f} ({len(voxels.ious)} objects). "
        f"Of the occluded occupied space the level set holds {voxels.recall:.3f} "
        f"(where there is support: {voxels.recall_supported:.3f}). "
        f"Hinge points: {np.mean(voxels.hinge_points):.0f} on average.",
        "",
        "Occluded, supported (intervals here and below: scenes are drawn again, since voxels of "
        "one scene, and paths through it, are alike; never narrower than Clopper and Pearson's "
        "for independent cases):", "", table(rows["voxels"]), "",
    ]  # fmt: skip
    if not paths.judged:
        return "\n".join(out)
    reported, defined = paths.reliability(), paths.reliability(inside=True)
    safe, collided = paths.called_safe()
    share = f", {100 * collided / safe:.2f} %" if safe else ""
    refused = len(paths.cases) - len(paths.judged)
    out += [
        "## Paths", "",
        f"{len(paths.cases)} random straight sweeps of a 3 cm ball, 10 to 40 cm long, near and "
        f"behind the objects; {paths.cases[0].n_worlds} worlds. {refused} of them pass occluded "
        "space that the map cannot judge: a checker refuses those, and they are left out here. "
        f"Of the other {reported.n}, {100 * reported.mean_observed:.1f} % really collide.", "",
        "| joint probability | mean predicted | Brier | ECE |", "|---|---|---|---|",
        "| as reported (surfaces between voxels) "
        f"| {reported.mean_predicted:.3f} | {reported.brier:.3f} | {reported.ece:.3f} |",
        "| voxel centres alone (an occupied voxel's centre inside the sweep) "
        f"| {defined.mean_predicted:.3f} | {defined.brier:.3f} | {defined.ece:.3f} |", "",
        f"Upper 95 % bound below 1 percent: {safe} paths, of which {collided} really "
        f"collide{share}.", "", "As reported:", "", table(rows["reported"]), "",
        "Voxel centres alone:", "", table(rows["defined"]), "",
        f"Most sweeps are clear cases, and they make these errors small: only "
        f"{sum(defined.counts[1:-1])} of {defined.n} lie between 0.1 and 0.9 by centres, "
        f"{sum(reported.counts[1:-1])} as reported. Voxel centres alone miss grazes shallower "
        "than half a voxel; the figure as reported allows for them.", "",
    ]  # fmt: skip
    return "\n".join(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="default")
    parser.add_argument("--paths", type=int, default=40, help="per scene; 0 leaves them out")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "results")
    args = parser.parse_args()
    config = PRESETS[args.preset]()
    keep = ROOT / "build" / "calibration" / args.preset
    done = []
    for seed in range(args.first_seed, args.first_seed + args.scenes):
        done.append(one_scene(seed, config, args.paths, keep / f"{seed}.json"))
        so_far = VoxelCalibration.merged([VoxelCalibration.from_dict(d["voxels"]) for d in done])
        print(
            f"scene {seed}: {done[-1]['objects']} objects; so far IoU {so_far.mean_iou:.3f}, "
            f"Brier {so_far.parts[1].brier:.3f}, ECE {so_far.parts[1].ece:.3f}",
            flush=True,
        )
    paths = PathCalibration(
        tuple(case for d in done for case in PathCalibration.from_dict(d["paths"]).cases)
    )
    stem = "calibration" if args.preset == "default" else f"calibration-{args.preset}"
    rows = rows_of(done)
    picture(so_far, paths, rows, args.output / f"{stem}.png")
    result = {
        "preset": args.preset,
        "config": asdict(config),
        "seeds": [args.first_seed, args.first_seed + args.scenes - 1],
        "voxels": so_far.to_dict(),
        "paths": {
            "reported": paths.reliability().to_dict(),
            "defined": paths.reliability(inside=True).to_dict(),
            "called_safe": paths.called_safe(),
        }
        if paths.judged
        else None,
    }
    write_text(args.output / f"{stem}.json", json.dumps(result, indent=1) + "\n")
    write_text(
        args.output / f"{stem}.md",
        report(args.preset, args.scenes, args.first_seed, so_far, paths, rows),
    )


if __name__ == "__main__":
    main()
