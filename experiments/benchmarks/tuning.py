# SPDX-License-Identifier: BSD-3-Clause
"""Candidates for the default preset against the paper's, on tuning scenes.

    python -m experiments.benchmarks.tuning [--scenes 8] [--first-seed 20] [--set ycb random-train]
        [NAME ...]

Gains over the paper's preset, above 0 is better, with 95 % bootstrap intervals over scenes.
Resumable: answers are kept in build/tuning/.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from experiments.tables.tuning import SETS, compare
from vprism_plan.mapping import MapConfig

ROOT = Path(__file__).resolve().parents[2]
BEFORE = replace(
    MapConfig(),
    gamma=1000.0,
    hinge_spacing=0.034,
    hinge_reach=None,
    object_resolution=0.01,
    front_resolution=0.01,
    prior_logit_variance=10.0,
)
WIDER = replace(MapConfig(), prior_occupancy=0.3)
CANDIDATES = {
    "default": MapConfig(),
    "fine": MapConfig.fine(),
    "before": BEFORE,
    "points-7mm": replace(BEFORE, object_resolution=0.007, front_resolution=0.007),
    "all-nodes": replace(MapConfig(), hinge_reach=None),
    "variance-10": replace(MapConfig(), prior_logit_variance=10.0),
    "variance-40": replace(MapConfig(), prior_logit_variance=40.0),
    "occupancy-0.3": WIDER,
    "occupancy-0.3-variance-40": replace(WIDER, prior_logit_variance=40.0),
    "occupancy-0.3-variance-100": replace(WIDER, prior_logit_variance=100.0),
    "finest": replace(MapConfig(), gamma=2000.0, hinge_spacing=0.024, hinge_reach=0.035),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=["before", "default"])
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=20)
    parser.add_argument("--set", nargs="+", default=["ycb", "random-train"], choices=SETS)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    unknown = [name for name in args.names if name not in CANDIDATES]
    if unknown:
        parser.error(f"no candidate {unknown}; valid: {', '.join(CANDIDATES)}")
    settings = {"paper": MapConfig.paper()} | {name: CANDIDATES[name] for name in args.names}
    seeds = range(args.first_seed, args.first_seed + args.scenes)
    for kind in args.set:
        rows = compare(settings, kind, seeds, ROOT / "build" / "tuning", jobs=args.jobs)
        print(f"{kind}, seeds {seeds.start} to {seeds.stop - 1}")
        print(f"{'':28s} IoU   Chamfer    fit   gain in IoU           Chamfer saved     Brier  ECE")
        for row in rows:
            iou, chamfer, brier, ece = row.gains
            print(
                f"{row.name:26s} {row.iou:5.3f} {1000 * row.chamfer:6.1f} mm {row.seconds:5.1f} s "
                f"{iou.value:+.3f} [{iou.low:+.3f} {iou.high:+.3f}] {100 * chamfer.value:+4.0f} % "
                f"[{100 * chamfer.low:+.0f} {100 * chamfer.high:+.0f}] {brier.value:+.3f} "
                f"{ece.value:+.3f}"
            )


if __name__ == "__main__":
    main()
