# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory optimisation on planning problems in generated clutter.

    python -m experiments.benchmarks.trajopt_problems [--scenes 10] [--problems 5] [--output docs]

Each scene is generated, seen once and fitted with the default settings (maps and answers are
kept in build/trajopt; `--fresh` asks again). A problem joins two free configurations with the
hand low among the objects, whose straight line runs 3 cm into something and which RRTConnect
solves within 5 s on the same checker.
Every problem is optimised from nothing and from RRTConnect's path, as it came from the
planner and shortened; lengths and clearances are compared with that path's. Writes
docs/results/trajopt.md, .json and .png.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import vprism_plan as vp
from experiments.generation import generate
from experiments.planning_benchmark.grid_world import benchmark_robot
from vprism_plan._files import write_text
from vprism_plan.collision.motion import edges_of, place_points
from vprism_plan.robots.kinematics import frame_poses
from vprism_plan.trajopt import optimize
from vprism_plan.viz import save_figure

KINDS = ("random", "ycb", "analytic")
FIRST_SEED = 3001
AROUND = 0.05  # metres around the observed objects in which the hand's middle is
LOW = 0.12  # metres over the table, of the hand's lowest sphere centre
ROOM = 0.003  # clearance of both ends, metres
DEEP = 0.03  # metres by which the straight line runs into something
DRAWS, ENDS = 400_000, 60
SLACK = 0.0005  # metres to which clearances are computed
FINE = 0.0005  # metres of motion to the nearest sample of the second look at a path
LIMIT = 5.0  # seconds for RRTConnect

# name in the table -> how `optimize` is asked; "raw" and "short" start from RRTConnect's path
RUNS: dict[str, dict[str, Any]] = {
    "straight line alone": {"seeds": 1},
    "8 seeds from nothing": {"seeds": 8},
    "RRTConnect's path": {"from": "raw", "seeds": 1, "keep_clearance": True},
    "RRTConnect's path, shortened": {"from": "short", "seeds": 1, "keep_clearance": True},
}


@dataclass(frozen=True)
class Problem:
    """A query that RRTConnect solves.

    Attributes:
        scene: name of the scene.
        number: within it.
        start, goal: radians.
        raw, short: RRTConnect's path, and what `plan` makes of it.
        seconds: that the two took.
    """

    scene: str
    number: int
    start: np.ndarray
    goal: np.ndarray
    raw: np.ndarray
    short: np.ndarray
    seconds: tuple[float, float]


@dataclass(frozen=True)
class Row:
    """One way of asking, on one problem.

    Attributes:
        scene, number: the problem.
        run: key of `RUNS`.
        status, winner, unchanged: of the answer; `unchanged` if it is the path given.
        sound: whether a second, finer look finds the path free; None without a path.
        length, clearance: of the path, radians and metres.
        raw_length, raw_clearance, short_length, short_clearance: of RRTConnect's.
        seconds, evaluations, rounds: spent.
        planning: seconds of RRTConnect, and of `plan` with shortening.
        message: of the answer.
    """

    scene: str
    number: int
    run: str
    status: str
    winner: str
    unchanged: bool
    sound: bool | None
    length: float | None
    clearance: float | None
    raw_length: float
    raw_clearance: float
    short_length: float
    short_clearance: float
    seconds: float
    evaluations: int
    rounds: int
    planning: tuple[float, float]
    message: str

    @property
    def solved(self) -> bool:
        return self.status == "exact"

    @property
    def kept(self) -> float:
        """Clearance, metres, of the path that was given; of RRTConnect's if none was."""
        given = RUNS[self.run].get("from", "raw")
        return self.short_clearance if given == "short" else self.raw_clearance

    @property
    def optimised(self) -> bool:
        """Solved by a path that is not just the one given."""
        return self.solved and not self.unchanged


def scene_checker(kind: str, seed: int, cache: Path) -> vp.CollisionChecker:
    """Return a checker over the default map of a generated scene."""
    file = cache / f"{kind}-{seed}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        vp.fit_map(generate(kind, seed).observation, vp.MapConfig(), seed=0).save(file)
    world = vp.World(vp.load_map(file), vp.WorldConfig(occluded="occupied"))
    return vp.CollisionChecker(world, benchmark_robot(), vp.CheckerConfig(max_risk=None))


def low_ends(checker: vp.CollisionChecker, rng: np.random.Generator) -> np.ndarray:
    """Return free configurations (n, dof) with the hand among the objects."""
    robot = checker.robot
    seen = [view.points() for view in checker.world.map.views]
    objects = np.concatenate([points[labels > 0] for points, labels in seen])
    low, high = np.percentile(objects[:, :2], [1, 99], axis=0)
    links = [robot.link_names.index(name) for name in robot.links_of("hand")]
    spheres = np.flatnonzero(np.isin(robot.sphere_links, links))
    arrays, found = robot.arrays, []
    for _ in range(0, DRAWS, 4000):
        Q = rng.uniform(robot.lower, robot.upper, (4000, robot.dof))
        R, t = frame_poses(arrays, Q)
        hand = place_points(R, t, arrays.sphere_frame[spheres], arrays.sphere_center[spheres])
        middle = hand.mean(axis=1)[:, :2]
        near = ((middle > low - AROUND) & (middle < high + AROUND)).all(axis=1)
        Q = Q[near & (hand[..., 2].min(axis=1) < LOW)]
        Q = Q[checker.is_valid_batch(Q)]
        found += list(Q[checker.clearance_batch(Q) > ROOM]) if len(Q) else []
        if len(found) >= ENDS:
            break
    return np.array(found[:ENDS]).reshape(-1, robot.dof)


def problems(checker: vp.CollisionChecker, scene: str, seed: int, count: int) -> Iterator[Problem]:
    """Yield problems whose straight line is blocked and which RRTConnect solves."""
    rng = np.random.default_rng([seed, 0x7A0])
    ends = low_ends(checker, rng)
    pairs = [(i, j) for i in range(len(ends)) for j in range(len(ends)) if i != j]
    used: set[int] = set()
    number = 0
    for k in rng.permutation(len(pairs)):
        i, j = pairs[k]
        if number == count:
            return
        straight = np.stack([ends[i], ends[j]])
        if {i, j} & used or checker.min_clearance(straight).clearance > -DEEP:
            continue
        began = time.perf_counter()
        raw = vp.plan(checker, ends[i], ends[j], time_limit=LIMIT, seed=number, simplify=False)
        spent = time.perf_counter() - began
        if raw.path is None:
            continue
        began = time.perf_counter()
        short = vp.plan(checker, ends[i], ends[j], time_limit=LIMIT, seed=number)
        if short.path is None:
            continue
        used |= {i, j}
        seconds = spent, time.perf_counter() - began
        yield Problem(scene, number, ends[i], ends[j], raw.path, short.path, seconds)
        number += 1


def free_at_a_second_look(checker: vp.CollisionChecker, path: np.ndarray) -> bool:
    """Return whether all configurations of a path, sampled finely, are free."""
    Q, _ = edges_of(checker, path).samples(FINE)
    return bool(checker.is_valid_batch(Q).all())


def length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def ask(checker: vp.CollisionChecker, problem: Problem, run: str) -> Row:
    """Optimise one problem in one way."""
    settings = dict(RUNS[run])
    start_from = settings.pop("from", None)
    if start_from is not None:
        settings["initial"] = problem.raw if start_from == "raw" else problem.short
    began = time.perf_counter()
    result = optimize(checker, problem.start, problem.goal, **settings)
    seconds = time.perf_counter() - began
    path = result.path

    def clearance(of: np.ndarray) -> float:
        return float(checker.min_clearance(of).clearance)

    return Row(
        scene=problem.scene,
        number=problem.number,
        run=run,
        status=result.status,
        winner=result.report.winner_name,
        unchanged=path is not None and result.report.winner is None,
        sound=None if path is None else free_at_a_second_look(checker, path),
        length=None if path is None else length(path),
        clearance=None if path is None else clearance(path),
        raw_length=length(problem.raw),
        raw_clearance=clearance(problem.raw),
        short_length=length(problem.short),
        short_clearance=clearance(problem.short),
        seconds=seconds,
        evaluations=result.report.evaluations,
        rounds=result.report.rounds,
        planning=problem.seconds,
        message=result.message,
    )


def summary(rows: list[Row]) -> list[list[str]]:
    """Return a line of the table per run."""
    lines = []
    for run in RUNS:
        own = [row for row in rows if row.run == run]
        solved = [row for row in own if row.optimised]
        to_raw = np.array([row.length / row.raw_length for row in solved if row.length])
        to_short = np.array([row.length / row.short_length for row in solved if row.length])
        lower = sum(
            row.clearance is not None and row.clearance < row.kept - SLACK for row in solved
        )
        seconds = np.array([row.seconds for row in own])
        lines.append([
            run,
            f"{len(solved)} of {len(own)}",
            str(sum(row.unchanged for row in own)),
            str(sum(row.sound is False for row in own)),
            f"{100 * (1 - to_raw.mean()):.0f} % ({100 * (1 - np.median(to_raw)):.0f} %)",
            f"{100 * (1 - to_short.mean()):.1f} % ({100 * (1 - np.median(to_short)):.1f} %)",
            f"{lower}",
            f"{1000 * np.mean([row.clearance for row in solved]):.1f} mm",
            f"{np.median(seconds):.1f} ({seconds.max():.0f})",
            f"{np.median([row.evaluations for row in own]):.0f}",
            f"{np.mean([row.rounds for row in own]):.1f}",
        ])  # fmt: skip
    return lines


HEAD = [
    "from", "solved", "returned unchanged", "collides at a second look",
    "shorter than RRTConnect's, mean (median)", "than the shortened one", "lower clearance",
    "clearance, mean", "seconds, median (largest)", "evaluations, median", "rounds, mean",
]  # fmt: skip


def text(rows: list[Row], command: str) -> str:
    """Return the results as Markdown."""
    scenes = sorted({row.scene for row in rows})
    count = len({(row.scene, row.number) for row in rows})
    ones = [row for row in rows if row.run == next(iter(RUNS))]
    raw, short = (np.array([getattr(row, f"{k}_length") for row in ones]) for k in ("raw", "short"))
    gaps = [
        1000 * np.mean([getattr(row, f"{k}_clearance") for row in ones]) for k in ("raw", "short")
    ]
    spent = np.median([row.planning for row in ones], axis=0)
    table = [HEAD, ["---"] * len(HEAD), *summary(rows)]
    refused = [row for row in rows if not row.optimised]
    parts = [
        "# Trajectory optimisation in generated clutter\n",
        f"Written by `{command}`. {count} problems in {len(scenes)} scenes ({', '.join(scenes)}), "
        "default map, world and checker, Panda. Both ends are free, have the hand's lowest sphere "
        f"within {100 * LOW:.0f} cm of the table among the objects, and the straight line between "
        f"them runs at least {100 * DEEP:.0f} cm into something; RRTConnect solves all of them "
        "within 5 s on the same checker (by choice). 32 waypoints, default cost.\n",
        f"RRTConnect's paths are {raw.mean():.2f} rad long on average and keep {gaps[0]:.1f} mm; "
        f"shortened by `plan` {short.mean():.2f} rad and {gaps[1]:.1f} mm (grazing: a clearance "
        f"below 0 is within the checker's tolerance). They took {spent[0]:.2f} s and, with the "
        f"shortening, {spent[1]:.2f} s (median).\n",
        "\n".join("| " + " | ".join(line) + " |" for line in table) + "\n",
        'Clearance is a lower bound over whole paths (`checker.min_clearance`), "lower" by more '
        "than the 0.5 mm it is computed to. From RRTConnect's paths `keep_clearance=True` asks "
        "for that of the path given. The second look samples every path at half a millimetre of "
        "motion. Seconds on two shared cores, one thread; the machine was busy.\n",
    ]
    if refused:
        parts.append("Not solved by a path of its own:\n")
        parts += [f"- {r.scene}, {r.number}, {r.run}: {r.status}: {r.message}\n" for r in refused]
    return "\n".join(parts)


def draw(rows: list[Row], path: Path) -> None:
    """Draw lengths and clearances before and after."""
    figure = Figure(figsize=(11.4, 4.4), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    colors = dict(zip(RUNS, ("#c9a227", "#5a9e4b", "#2f7ebc", "#d1603d"), strict=True))
    for run, color in colors.items():
        own = [row for row in rows if row.run == run and row.optimised]
        lengths = np.array([row.length for row in own])
        raw = np.array([row.raw_length for row in own])
        left.plot(np.sort(lengths / raw), np.arange(1, len(own) + 1), color=color, label=run)
        short = np.array([row.short_length for row in own])
        middle.plot(np.sort(lengths / short), np.arange(1, len(own) + 1), color=color)
        if "from" in RUNS[run]:
            kept = [1000 * row.kept for row in own]
            right.plot(kept, [1000 * (row.clearance or 0.0) for row in own], "o", color=color,
                       markersize=4.5, alpha=0.8)  # fmt: skip
    left.axvline(0.75, color="0.5", linestyle="--", linewidth=1.0)
    for axis, name in ((left, "RRTConnect's path"), (middle, "the shortened path")):
        axis.set_xlabel(f"length as a share of {name}")
        axis.set_ylabel("problems")
    low, high = right.get_xlim()
    right.plot([low, high], [low, high], color="0.5", linestyle="--", linewidth=1.0)
    right.set_xlabel("clearance of the path given (mm)")
    right.set_ylabel("clearance of the path returned (mm)")
    for axis in (left, middle, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    save_figure(figure, path)


def scene_rows(kind: str, seed: int, count: int, cache: Path, fresh: bool) -> list[Row]:
    """Return the answers on one scene: kept ones if they were asked the same."""
    file = cache / f"{kind}-{seed}-answers.json"
    asked = {"count": count, "runs": RUNS, "criteria": [AROUND, LOW, ROOM, DEEP, LIMIT]}
    if file.exists() and not fresh:
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["asked"] == asked:
            return [Row(**{**row, "planning": tuple(row["planning"])}) for row in kept["rows"]]
    checker = scene_checker(kind, seed, cache)
    rows: list[Row] = []
    for problem in problems(checker, f"{kind}-{seed}", seed, count):
        rows += [ask(checker, problem, run) for run in RUNS]
        for row in rows[-len(RUNS) :]:
            print(f"{row.scene} {row.number} {row.run}: {row.message}", flush=True)
    answers = {"asked": asked, "rows": [asdict(row) for row in rows]}
    write_text(file, json.dumps(answers))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--problems", type=int, default=5, help="per scene")
    parser.add_argument("--output", type=Path, default=Path("docs"), help="folder to write to")
    parser.add_argument("--cache", type=Path, default=Path("build/trajopt"), help="kept maps")
    parser.add_argument("--fresh", action="store_true", help="do not use kept answers")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    results = arguments.output / "results"
    command = "python -m experiments.benchmarks.trajopt_problems"
    for index in range(arguments.scenes):
        kind, seed = KINDS[index % len(KINDS)], FIRST_SEED + index
        rows += scene_rows(kind, seed, arguments.problems, arguments.cache, arguments.fresh)
        # After every scene: who stops a long run keeps what there is.
        listed = json.dumps([asdict(row) for row in rows], indent=1)
        write_text(results / "trajopt.json", listed + "\n")
        write_text(results / "trajopt.md", text(rows, command))
    draw(rows, results / "trajopt.png")
    print(text(rows, command))


if __name__ == "__main__":
    main()
