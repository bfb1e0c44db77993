# SPDX-License-Identifier: BSD-3-Clause
"""Run the benchmark: every checker's worlds on every problem of every scene.

    found = run("ycb", scenes=30, first_seed=1000)

First the problems of each scene are found (once, on the truth); then each contender is asked
all of them. Both are sweeps that keep every answer and go on where they were stopped.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experiments.planning_benchmark.asking import Answer, Limits, answer_case, problem_case
from experiments.planning_benchmark.contenders import contenders, settings
from experiments.planning_benchmark.problems import Criteria
from experiments.planning_benchmark.proposals import Proposals
from experiments.tables import scoring
from experiments.tables.sweep import Case, SweepError, sweep, sweep_complete
from vprism_plan.errors import ConfigError

# Of what an answer means, part of every question: raised by hand whenever the robot, the
# planner, a world, a checker or the scenes change what they answer to the same settings.
VERSION = 5
_SPARE = 2  # times the scenes that are asked for: where seeds end if too many offer too little


@dataclass(frozen=True, eq=False)
class Found:
    """What a run found.

    Attributes:
        answers: of every contender on every scene, as `answer_case` gives them.
        replaced: seeds whose scene offers fewer problems than wanted, and how many; the
            seeds after the last one took their place.
        failed: the error, if some scenes failed; they are in no answer.
    """

    answers: list[dict[str, Any]]
    replaced: dict[int, int]
    failed: SweepError | None = None


def run(
    kind: str,
    scenes: int = 30,
    first_seed: int = 1000,
    *,
    checkers: Iterable[str] | None = None,
    count: int = 20,
    criteria: Criteria | Proposals | None = None,
    limits: Limits | None = None,
    store: Path = Path("build/evaluation/planning"),
    data: Path | None = None,
    **how: Any,
) -> Found:
    """Return the answers of every contender on every scene.

    A scene on which a contender raises is left out for all of them. Arguments as those of
    `tables.reconstruction.run`, and:

    Args:
        kind: a set of scenes, also "solids" (analytic, without physics).
        scenes: how many; seeds from first_seed on, but those that offer too few problems.
        checkers: keys of `CONTENDERS`; all if None.
        count: problems per scene.
        criteria: which problems: with vetted ends, or proposed from the image.

    Raises:
        ConfigError: an unknown contender, no scene or problem asked for, or too few scenes
            that offer enough problems.
        SweepError: no scene is left on which nobody raised.
    """
    if scenes < 1 or count < 1:
        raise ConfigError(f"scenes is {scenes}, count {count}; both must be at least 1")
    chosen = contenders(checkers)
    about = {"version": VERSION, "kind": kind, "data": scoring.data_digest(kind, data)}
    given = scoring.whereabouts(kind, data)
    criteria = Criteria() if criteria is None else criteria
    name = "proposals" if isinstance(criteria, Proposals) else "criteria"
    asked = {"count": count, name: criteria.to_dict()}
    problems, replaced = _problems(
        {**about, **asked}, given, scenes, first_seed, Path(store) / "problems", how
    )
    limits = Limits() if limits is None else limits
    cases = [
        Case(
            f"{contender.key} {kind} {seed}",
            {**about, "seed": seed, "contender": contender.question(),
             "settings": settings(contender), "limits": asdict(limits), "problems": own},
            given,
        )
        for seed, own in problems.items()
        for contender in chosen
    ]  # fmt: skip
    # All contenders of a scene in one process: they share the scene, the map and its worlds.
    _, answers, failed = sweep_complete(
        answer_case, cases, Path(store) / "answers", group=lambda case: case.asked["seed"], **how
    )
    if failed is not None and not answers:
        raise failed
    return Found(answers, replaced, failed)


def _problems(
    asked: dict[str, Any],
    given: dict[str, Any],
    scenes: int,
    first_seed: int,
    store: Path,
    options: dict[str, Any],
) -> tuple[dict[int, list[dict[str, Any]]], dict[int, int]]:
    """Return as many scenes' problems as wanted, by seed, and the seeds that offer too few."""
    kind, count = asked["kind"], asked["count"]
    full: dict[int, list[dict[str, Any]]] = {}
    short: dict[int, int] = {}
    seed, end = first_seed, first_seed + _SPARE * scenes
    while len(full) < scenes and seed < end:
        seeds = range(seed, min(seed + scenes - len(full), end))
        cases = [Case(f"problems {kind} {s}", {**asked, "seed": s}, given) for s in seeds]
        for s, found in zip(seeds, sweep(problem_case, cases, store, **options), strict=True):
            if len(found["problems"]) < count:
                short[s] = len(found["problems"])
            else:
                full[s] = found["problems"]
        seed = seeds[-1] + 1
    if len(full) < scenes:
        raise ConfigError(
            f"of the {kind} scenes {first_seed} to {end - 1} only {len(full)} offer {count} "
            f"problems, {scenes} are wanted; ask for fewer problems, or loosen the criteria"
        )
    return full, short


def answers_of(found: Sequence[dict[str, Any]], key: str) -> list[tuple[str, Answer]]:
    """Return scene name and answer of every problem that a contender was asked."""
    return [
        (entry["scene"], Answer.from_dict(answer))
        for entry in found
        if entry["contender"] == key
        for answer in entry["answers"]
    ]
