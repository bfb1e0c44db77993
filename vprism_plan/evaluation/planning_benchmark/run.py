# SPDX-License-Identifier: BSD-3-Clause
"""Run the benchmark: every checker's worlds on every problem of every scene.

    answers = run("ycb", scenes=30, first_seed=1000)

First the problems of each scene are found (once, on the truth); then each contender is asked
all of them. Both are sweeps that keep every answer and go on where they were stopped.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import ConfigError
from vprism_plan.evaluation.experiments.sweep import Case, sweep
from vprism_plan.evaluation.planning_benchmark.checkers import Bench, Contender, contenders
from vprism_plan.evaluation.planning_benchmark.grid_world import benchmark_robot, views_of
from vprism_plan.evaluation.planning_benchmark.problems import (
    Criteria,
    Problem,
    find_problems,
    tip_sphere,
)
from vprism_plan.evaluation.planning_benchmark.truth import PathTruth, Truth
from vprism_plan.evaluation.protocols import TrueScene
from vprism_plan.planning import PlanResult, plan
from vprism_plan.world.visibility import OCCLUDED, SEEN, classify_points

__all__ = ["Answer", "Limits", "answer_case", "problem_case", "run", "scene_of"]

_VERSION = 3  # of what an answer means; counts as part of every question
SOLIDS = "solids"  # analytic solids without physics: needs no optional package


@dataclass(frozen=True)
class Limits:
    """What every contender is given. Seconds of processor time, so that a busy machine gives
    as much as an idle one.

    Attributes:
        planner: of `vprism_plan.plan`.
        time_limit: for the search.
        simplify_time: after which no further round of shortening starts.
    """

    planner: str = "RRTConnect"
    time_limit: float = 2.0
    simplify_time: float = 1.0


@dataclass(frozen=True)
class Answer:
    """What became of one problem with one checker.

    Attributes:
        number: of the problem.
        status: of the `PlanResult`: "exact", "invalid_start", "invalid_goal", "timeout", ...
        refused: what was in the way at a refused start or goal ("object:3", "occluded",
            "risk", another link, ...), empty otherwise.
        seconds: wall time of the query.
        processor: processor time of it.
        searched: of that, the planner's search.
        truth: what the true scene says of the path, None without one.
        known: what was known of the place that the path hits: "seen", "supported" (occluded,
            the map can judge), "unsupported", "unobserved", "table"; empty without a hit.
        length: of the path in joint space, radians; NaN is None.
        travel: way of the finger tip, metres.
    """

    number: int
    status: str
    refused: str
    seconds: float
    processor: float
    searched: float
    truth: PathTruth | None
    known: str
    length: float | None
    travel: float | None

    @property
    def solved(self) -> bool:
        """Whether the checker's planner returned a path."""
        return self.status == "exact"

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        truth = None if self.truth is None else self.truth.to_dict()
        return {**vars(self), "truth": truth}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Answer":
        """Rebuild from `to_dict`."""
        truth = None if data["truth"] is None else PathTruth.from_dict(data["truth"])
        return cls(**{**data, "truth": truth})


def scene_of(kind: str, seed: int, data: str | None = None) -> TrueScene:
    """Return a scene of the generator, or of the analytic solids ("solids")."""
    if kind == SOLIDS:
        from vprism_plan.evaluation.calibration import calibration_scene

        return calibration_scene(seed)
    from vprism_plan.evaluation.generation import generate

    scene: TrueScene = generate(kind, seed, data=None if data is None else Path(data))
    return scene


@lru_cache(maxsize=1)
def _truth(kind: str, seed: int, data: str | None) -> Truth:
    return Truth(scene_of(kind, seed, data), benchmark_robot())


@lru_cache(maxsize=1)
def _bench(kind: str, seed: int, data: str | None) -> Bench:
    truth = _truth(kind, seed, data)
    return Bench(truth.scene, truth.robot, seed, truth.world)


def problem_case(case: Case) -> dict[str, Any]:
    """Find the problems of one scene: a task for `sweep`."""
    asked = case.asked
    truth = _truth(asked["kind"], asked["seed"], asked["data"])
    given = asked["criteria"]
    criteria = Criteria(**{**given, "ends": tuple(given["ends"])})
    problems = find_problems(truth, asked["count"], asked["seed"], criteria)
    return {
        "scene": truth.scene.name,
        "objects": len(truth.scene.object_ids),
        "problems": [problem.to_dict() for problem in problems],
    }


def answer_case(case: Case) -> dict[str, Any]:
    """Ask one contender all problems of one scene: a task for `sweep`."""
    asked = case.asked
    scene = asked["kind"], asked["seed"], asked["data"]
    truth, bench = _truth(*scene), _bench(*scene)
    contender = Contender.from_dict(asked["contender"])
    checkers, build = bench.checkers(contender)
    limits = Limits(**asked["limits"])
    answers = [
        ask(checkers, Problem.from_dict(problem), truth, bench, limits)
        for problem in asked["problems"]
    ]
    return {
        "contender": contender.key,
        "kind": asked["kind"],
        "seed": asked["seed"],
        "scene": truth.scene.name,
        "build": build,
        "answers": [answer.to_dict() for answer in answers],
    }


def ask(
    checkers: Sequence[Any], problem: Problem, truth: Truth, bench: Bench, limits: Limits
) -> Answer:
    """Ask a planner one problem with a checker, or with several in turn until one succeeds,
    and judge what it returns."""
    began, worked = time.perf_counter(), time.process_time()
    for checker in checkers:
        result = plan(
            checker,
            problem.start,
            problem.goal,
            planner=limits.planner,
            time_limit=limits.time_limit / len(checkers),
            seed=problem.seed,
            simplify_time=limits.simplify_time,
            clock="process",
        )
        if result.solved:
            break
    seconds, processor = time.perf_counter() - began, time.process_time() - worked
    judged, known, travel = None, "", None
    if result.path is not None:
        judged = truth.judge(result.path)
        known = _known(judged, bench) if judged.collides else ""
        travel = tip_travel(truth, result.path)
    return Answer(
        problem.number,
        result.status,
        _refusal(result),
        seconds,
        processor,
        result.report.planning_time,
        judged,
        known,
        None if result.path is None else result.report.path_length,
        travel,
    )


def _refusal(result: PlanResult) -> str:
    """Return what the deepest contact at a refused end is with."""
    if result.status not in ("invalid_start", "invalid_goal"):
        return ""
    contacts = getattr(result.explanation, "contacts", ())
    if not contacts:
        return "unexplained"
    first = contacts[0]
    return first.kind if first.kind in ("self", "risk", "joint_limit") else str(first.body)


def _known(judged: PathTruth, bench: Bench) -> str:
    """Return what camera and map know of the place where a path hits something."""
    if judged.body == "table":
        return "table"
    point = np.array([judged.point])
    status = int(classify_points(views_of(bench.observation), point)[0])
    if status == SEEN:
        return "seen"
    if status != OCCLUDED:
        return "unobserved"
    from vprism_plan.world import WorldConfig

    supported = float(np.asarray(bench.vprism.support(point))[0]) >= WorldConfig().min_support
    return "supported" if supported else "unsupported"


def tip_travel(truth: Truth, path: Float[np.ndarray, "t dof"]) -> float:
    """Return the way of the finger tip along a path, metres, from samples every centimetre."""
    Q, _ = truth.edges(path).samples(0.005)
    tips = truth.sphere_centers(Q, np.array([tip_sphere(truth.robot)]))[:, 0]
    return float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())


def run(
    kind: str,
    scenes: int = 30,
    first_seed: int = 1000,
    *,
    checkers: Iterable[str] | None = None,
    count: int = 20,
    criteria: Criteria | None = None,
    limits: Limits | None = None,
    store: Path = Path("build/evaluation/planning"),
    data: Path | None = None,
    jobs: int = 2,
    backend: str = "loky",
    progress: bool = True,
    cluster: Any = None,
) -> list[dict[str, Any]]:
    """Return the answers of every contender on every scene, as `answer_case` gives them.

    Args:
        kind: "analytic", "ycb", "random", "folder" or "solids".
        scenes: how many; seeds first_seed, first_seed + 1, ...
        first_seed: of the scenes, their problems and the maps.
        checkers: keys of `CONTENDERS`; all if None.
        count: problems per scene.
        criteria: what the problems must be.
        limits: planner and time limits.
        store: folder that keeps every answer.
        data: folder of meshes, where the kind needs one.
        jobs: processes.
        backend: "loky", "dask" or "ray".
        progress: whether to show it.
        cluster: see `experiments.sweep`.

    Raises:
        ConfigError: an unknown contender, or no scene or problem asked for.
        SweepError: a scene or a contender raised; the others are kept.
    """
    if scenes < 1 or count < 1:
        raise ConfigError(f"scenes is {scenes}, count {count}; both must be at least 1")
    chosen = contenders(checkers)
    folder = None if data is None else str(data)
    criteria = Criteria() if criteria is None else criteria
    limits = Limits() if limits is None else limits
    seeds = range(first_seed, first_seed + scenes)
    options: dict[str, Any] = {
        "jobs": jobs, "backend": backend, "progress": progress, "cluster": cluster
    }  # fmt: skip
    found = sweep(
        problem_case,
        [
            Case(
                f"problems {kind} {seed}",
                {"version": _VERSION, "kind": kind, "seed": seed, "data": folder, "count": count,
                 "criteria": criteria.to_dict()},
            )
            for seed in seeds
        ],
        Path(store) / "problems",
        **options,
    )  # fmt: skip
    cases = [
        Case(
            f"{contender.key} {kind} {seed}",
            {"version": _VERSION, "kind": kind, "seed": seed, "data": folder,
             "contender": contender.question(), "limits": asdict(limits),
             "problems": problems["problems"]},
        )
        for seed, problems in zip(seeds, found, strict=True)
        for contender in chosen
    ]  # fmt: skip
    # All contenders of a scene in one process: they share the scene, the map and its worlds.
    return sweep(answer_case, cases, Path(store) / "answers", group=_scene_of_case, **options)


def _scene_of_case(case: Case) -> tuple[str, int]:
    return str(case.asked["kind"]), int(case.asked["seed"])


def answers_of(found: Sequence[dict[str, Any]], key: str) -> list[tuple[str, Answer]]:
    """Return scene name and answer of every problem that a contender was asked."""
    return [
        (entry["scene"], Answer.from_dict(answer))
        for entry in found
        if entry["contender"] == key
        for answer in entry["answers"]
    ]
