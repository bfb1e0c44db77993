# SPDX-License-Identifier: BSD-3-Clause
"""What one process does: find the problems of a scene, or ask a contender all of them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.planning_benchmark.checkers import Bench
from experiments.planning_benchmark.contenders import Contender
from experiments.planning_benchmark.grid_world import benchmark_robot, views_of
from experiments.planning_benchmark.problems import Criteria, Problem, find_problems, tip_sphere
from experiments.planning_benchmark.proposals import Proposals, find_goals
from experiments.planning_benchmark.truth import PathTruth, Truth
from experiments.protocols import TrueScene
from experiments.stored import Stored
from experiments.tables.scoring import commit
from experiments.tables.store import Case
from vprism_plan.planning import PlanResult, plan
from vprism_plan.world import WorldConfig
from vprism_plan.world.visibility import OCCLUDED, SEEN, classify_points

SOLIDS = "solids"  # analytic solids without physics: needs no optional package


@dataclass(frozen=True)
class Limits(Stored):
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
class Answer(Stored):
    """What became of one problem with one checker.

    Attributes:
        number: of the problem.
        status: of the `PlanResult`: "exact", "invalid_start", "invalid_goal", "timeout", ...
        refused: what was in the way at a refused start or goal ("object:3", "occluded",
            "risk", another link, ...), empty otherwise.
        seconds: wall time of the query.
        processor: processor time of it.
        searched: of that, the planner's searches.
        truth: what the true scene says of the path, None without one.
        known: what was known of the place that the path hits: "seen", "supported" (occluded,
            the map can judge), "unsupported", "unobserved", "table"; empty without a hit.
        length: of the path in joint space, radians; NaN is None.
        travel: way of the finger tip, metres.
        stated: probability that the path collides, by the contender's own posterior; None
            without a path or a posterior.
        clearance: of the path as its checker states it, metres; None without a path.
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
    stated: float | None = None
    clearance: float | None = None

    @property
    def solved(self) -> bool:
        """Whether the checker's planner returned a path."""
        return self.status == "exact"


def scene_of(kind: str, seed: int, data: str | None = None) -> TrueScene:
    """Return a scene of the generator, or of the analytic solids ("solids")."""
    if kind == SOLIDS:
        from experiments.calibration import calibration_scene

        return calibration_scene(seed)
    from experiments.generation import generate

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
    scene = asked["kind"], asked["seed"], case.given.get("data")
    truth, count, seed = _truth(*scene), asked["count"], asked["seed"]
    if "proposals" in asked:
        how = Proposals.from_dict(asked["proposals"])
        problems = find_goals(truth, _bench(*scene), count, seed, how)
    else:
        problems = find_problems(truth, count, seed, Criteria.from_dict(asked["criteria"]))
    return {
        "scene": truth.scene.name,
        "objects": len(truth.scene.object_ids),
        "commit": commit(),
        "problems": [problem.to_dict() for problem in problems],
    }


def answer_case(case: Case) -> dict[str, Any]:
    """Ask one contender all problems of one scene: a task for `sweep`."""
    asked = case.asked
    scene = asked["kind"], asked["seed"], case.given.get("data")
    truth, bench = _truth(*scene), _bench(*scene)
    contender = Contender.from_dict(asked["contender"])
    checkers, build = bench.checkers(contender)
    limits = Limits(**asked["limits"])
    problems = [Problem.from_dict(problem) for problem in asked["problems"]]
    answers = [ask(contender, checkers, one, truth, bench, limits) for one in problems]
    return {
        "contender": contender.key,
        "kind": asked["kind"],
        "seed": asked["seed"],
        "scene": truth.scene.name,
        "build": build,
        "commit": commit(),
        "answers": [answer.to_dict() for answer in answers],
        "reachable": [list(problem.reachable) for problem in problems],
    }


def ask(
    contender: Contender, checkers: Sequence[Any], problem: Problem, truth: Truth, bench: Bench,
    limits: Limits,
) -> Answer:  # fmt: skip
    """Ask a planner one problem with a checker, or with several in turn until one succeeds,
    and judge what it returns."""
    # Only who takes the package as it comes takes its margins.
    own: dict[str, Any] = {} if contender.defaults else {"margins": None}
    began, worked = time.perf_counter(), time.process_time()
    searched = 0.0
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
            **own,
        )
        searched += result.report.planning_time
        if result.solved:
            break
    seconds, processor = time.perf_counter() - began, time.process_time() - worked
    judged, known, travel, stated, clearance = None, "", None, None, None
    if result.path is not None:
        clearance = result.report.min_clearance
        if contender.posterior:
            risk = result.report.risk
            risk = checkers[-1].collision_probability(result.path) if risk is None else risk
            stated = float(risk.probability)
        judged = truth.judge(result.path)
        known = _known(judged, bench) if judged.collides else ""
        travel = tip_travel(truth, result.path)
    return Answer(
        problem.number,
        result.status,
        _refusal(result),
        seconds,
        processor,
        searched,
        judged,
        known,
        None if result.path is None else result.report.path_length,
        travel,
        stated,
        clearance,
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
    supported = float(np.asarray(bench.vprism.support(point))[0]) >= WorldConfig().min_support
    return "supported" if supported else "unsupported"


def tip_travel(truth: Truth, path: Float[np.ndarray, "t dof"]) -> float:
    """Return the way of the finger tip along a path, metres, from samples every centimetre."""
    Q, _ = truth.edges(path).samples(0.005)
    tips = truth.sphere_centers(Q, np.array([tip_sphere(truth.robot)]))[:, 0]
    return float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())
