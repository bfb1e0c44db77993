# SPDX-License-Identifier: BSD-3-Clause
"""Which next view? Goals that one view leaves too risky, looked at again by four rules.

    python -m experiments.looking [--scenes 3] [--first-seed 1000] [--goals 4] [--within 60]

Goals are those of the asked benchmark (nobody looked at the truth first) that the default calls
"too_risky". A rule chooses a camera among 64 around the objects, or among as many within so many
degrees of azimuth of the first, where an arm may bring one. The scene is rendered from there with
the camera's noise, the map made again, the query asked again; at most two views a goal. Every
answer is judged by the truth. Started again, it computes only what is missing.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.planning_benchmark.asking import problem_case, scene_of
from experiments.planning_benchmark.grid_world import benchmark_robot
from experiments.planning_benchmark.problems import Problem
from experiments.planning_benchmark.proposals import Proposals
from experiments.planning_benchmark.run import VERSION
from experiments.planning_benchmark.truth import Truth
from experiments.tables import scoring
from experiments.tables.intervals import Estimate, estimate, ratio
from experiments.tables.sweep import Case, sweep
from vprism_plan import CollisionChecker, World, fit_map, next_view, plan
from vprism_plan._files import write_text
from vprism_plan.planning import NextView
from vprism_plan.simulation import Camera

KINDS = ("analytic", "ycb", "random")
COST = 10.0  # of a collision, in reached goals
VIEWS = 2  # further views, at most
_PER_RING, _ELEVATIONS = 16, (0.5, 0.7, 0.9, 1.2)  # cameras; radians over the table
_TIME = 2.0  # seconds of a plan

Rule = Callable[[NextView, list[int], np.random.Generator], int]
RULES: dict[str, tuple[str, Rule]] = {
    "ours": (
        "what it changes for the motion (`next_view`)",
        lambda look, left, rng: next(v for v in look.ranking if v in left),
    ),
    "entropy": (
        "entropy of the swept voxels that it shows",
        lambda look, left, rng: max(left, key=lambda v: look.values[v].entropy),
    ),
    "baseline": (
        "largest angle to the views there are",
        lambda look, left, rng: max(left, key=lambda v: look.values[v].baseline),
    ),
    "random": ("drawn at random", lambda look, left, rng: int(rng.choice(left))),
}


def cameras_around(scene: Any, within: float) -> list[Camera]:
    """Return 64 cameras, as far from the middle of what was seen as the scene's own, evenly over
    azimuths that differ from its by at most `within` degrees."""
    points, labels = scene.observation.points()
    middle = points[labels > 0].mean(axis=0)
    own = scene.observation.camera_center - middle
    away, span = float(np.linalg.norm(own)), np.deg2rad(within)
    azimuths = np.arctan2(own[1], own[0]) + np.linspace(-span, span, _PER_RING, endpoint=False)
    return [Camera.orbit(middle, away, a, e) for a in azimuths for e in _ELEVATIONS]


def looking_case(case: Case) -> dict[str, Any]:
    """Return, for some goals of one scene, what each rule had after 0, 1 and 2 views: a task for
    `sweep`."""
    asked = case.asked
    scene: Any = scene_of(asked["kind"], asked["seed"], case.given.get("data"))
    truth = Truth(scene, benchmark_robot())
    cameras = cameras_around(scene, asked["within"])
    poses = np.array([camera.T_world_camera for camera in cameras])
    known: dict[tuple[int, ...], Any] = {}

    def checker(seen: tuple[int, ...]) -> CollisionChecker:
        if seen not in known:
            views = [scene.observation] + [
                scene.render(cameras[v], noise=scene.noise, seed=1 + v) for v in seen
            ]
            map_ = fit_map(views, seed=asked["seed"])
            known[seen] = CollisionChecker(World(map_), truth.robot)
        return known[seen]

    goals = []
    for one in map(Problem.from_dict, asked["problems"]):
        how: dict[str, Any] = {"time_limit": _TIME, "seed": one.seed, "clock": "process"}
        first = plan(checker(()), one.start, one.goal, **how)
        if first.status != "too_risky":
            continue
        told: dict[str, Any] = {}
        for name, (_, choose) in RULES.items():
            rng = np.random.default_rng([asked["seed"], one.number])
            seen: tuple[int, ...] = ()
            result, steps = first, []
            for _ in range(VIEWS):
                look = next_view(checker(seen), one.start, one.goal, poses, result=result)
                left = [v for v in range(len(cameras)) if v not in seen]
                if not look.values:
                    break
                seen = (*seen, choose(look, left, rng))
                result = plan(checker(seen), one.start, one.goal, **how)
                hit = bool(result.path is not None and truth.judge(result.path).collides)
                steps.append({"view": seen[-1], "status": result.status, "collides": hit})
                if result.status != "too_risky":
                    break
            told[name] = steps
        goals.append({"number": one.number, "reachable": list(one.reachable), "rules": told})
        if len(goals) == asked["goals"]:
            break
    return {"scene": scene.name, "goals": goals}


def figures(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return, per rule, shares with intervals over scenes: clean and collides after at most 1 and
    2 views, utility, and views per goal until it was no longer too risky (at most 2)."""
    told: dict[str, Any] = {}
    n = np.array([len(scene["goals"]) for scene in found], dtype=float)
    for name in RULES:
        rows: dict[str, list[float]] = {}
        for scene in found:
            sums = dict.fromkeys(("clean1", "hit1", "clean2", "hit2", "open", "views"), 0.0)
            for goal in scene["goals"]:
                steps = goal["rules"][name]
                for limit in (1, 2):
                    taken = steps[:limit]
                    solved = [s for s in taken if s["status"] == "exact"]
                    sums[f"clean{limit}"] += sum(not s["collides"] for s in solved)
                    sums[f"hit{limit}"] += sum(s["collides"] for s in solved)
                sums["views"] += len(steps)
                sums["open"] += not steps or steps[-1]["status"] == "too_risky"
            for key, value in sums.items():
                rows.setdefault(key, []).append(value)
        own = {key: np.array(values) for key, values in rows.items()}
        for limit in (1, 2):
            own[f"utility{limit}"] = own[f"clean{limit}"] - COST * own[f"hit{limit}"]
        told[name] = {key: estimate(ratio(v, n), len(found)) for key, v in own.items()}
    return told


def _page(whole: dict[str, Any], command: str) -> str:
    def cell(value: Estimate, scale: float = 100.0) -> str:
        return f"{scale * value.value:.3g} [{scale * value.low:.3g}, {scale * value.high:.3g}]"

    lines = [
        "# Looking again: which next view?", "",
        "Goals of the asked benchmark that one view leaves too risky (every default). A rule "
        "chooses one of 64 cameras; map, world and plan are made again; at most "
        f"{VIEWS} views. 95 % intervals over scenes. Nothing was tuned on them. Reprint with",
        "", f"    {command}", "",
    ]  # fmt: skip
    for within, part in whole.items():
        goals = sum(len(scene["goals"]) for scene in part["scenes"])
        lines += [
            f"## Cameras within {within} degrees of the first", "",
            f"{goals} goals of {len(part['scenes'])} scenes.", "",
            "| next view by | clean after 1 (%) | collide (%) | clean after 2 (%) | collide (%) | "
            f"utility at c = {COST:g}, 2 views | still too risky (%) | views a goal |",
            "|---|---|---|---|---|---|---|---|",
        ]  # fmt: skip
        for name, (label, _) in RULES.items():
            own = part["figures"][name]
            shares = [cell(own[key]) for key in ("clean1", "hit1", "clean2", "hit2")]
            rest = [cell(own["utility2"], 1.0), cell(own["open"]), cell(own["views"], 1.0)]
            lines.append("| " + " | ".join([label, *shares, *rest]) + " |")
        lines.append("")
    return "\n".join([*lines, "![Goals reached by the number of views](looking.png)", ""])


def _picture(whole: dict[str, Any]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8 * len(whole), 3.6), layout="constrained")
    for axes, (within, part) in zip(
        figure.subplots(1, len(whole), squeeze=False, sharey=True)[0], whole.items(), strict=True
    ):
        for k, (name, (label, _)) in enumerate(RULES.items()):
            told = part["figures"][name]
            own = [Estimate(0.0, 0.0, 0.0), told["clean1"], told["clean2"]]
            mid = np.array([e.value for e in own])
            bars = np.abs(np.array([[e.low, e.high] for e in own]).T - mid)
            at = np.arange(3) + 0.04 * (k - 1.5)
            axes.errorbar(at, 100.0 * mid, 100.0 * bars, fmt="o-", capsize=3, label=label)
        axes.set(xticks=range(3), xlabel="further views", title=f"within {within} degrees")
    figure.axes[0].set(ylabel="reached, clean (% of the goals)")
    figure.axes[0].legend(fontsize=8)
    return figure


def main() -> int:
    """Compute what is missing, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--scenes", type=int, default=3, help="of each kind")
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--goals", type=int, default=4, help="too risky ones, of each scene")
    parser.add_argument("--within", type=float, nargs="+", default=[180.0, 60.0], help="degrees")
    parser.add_argument("--asked", type=int, default=30, help="goals proposed in each scene")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--store", type=Path, default=Path("build/evaluation"))
    parser.add_argument("--output", type=Path, default=Path("docs/results"))
    chosen = parser.parse_args()
    seeds = range(chosen.first_seed, chosen.first_seed + chosen.scenes)
    cases: list[Case] = []
    for kind in chosen.kinds:
        given = scoring.whereabouts(kind, None)
        about = {"version": VERSION, "kind": kind, "data": scoring.data_digest(kind, None)}
        asked = {**about, "count": chosen.asked, "proposals": Proposals().to_dict()}
        problems = sweep(
            problem_case,
            [Case(f"problems {kind} {s}", {**asked, "seed": s}, given) for s in seeds],
            chosen.store / "asked" / "problems", jobs=chosen.jobs,
        )  # fmt: skip
        cases += [
            Case(
                f"looking {kind} {s}",
                {**about, "seed": s, "goals": chosen.goals, "problems": own["problems"]},
                given,
            )
            for s, own in zip(seeds, problems, strict=True)
        ]
    whole: dict[str, Any] = {}
    for within in chosen.within:
        own = [replace(case, asked={**case.asked, "within": within}) for case in cases]
        found = sweep(looking_case, own, chosen.store / "looking", jobs=chosen.jobs)
        found = [scene for scene in found if scene["goals"]]
        whole[f"{within:g}"] = {"scenes": found, "figures": figures(found)}
    command = (
        f"python -m experiments.looking --scenes {chosen.scenes} --first-seed {chosen.first_seed} "
        f"--goals {chosen.goals} --within {' '.join(whole)}"
    )
    write_text(chosen.output / "looking.md", _page(whole, command))
    _picture(whole).savefig(chosen.output / "looking.png", dpi=120)
    for part in whole.values():
        part["figures"] = {
            name: {k: e.to_dict() for k, e in own.items()} for name, own in part["figures"].items()
        }
    write_text(chosen.output / "looking.json", json.dumps(whole, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
