# SPDX-License-Identifier: BSD-3-Clause
"""What answers add up to: successes, true collisions, and what they cost."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.planning_benchmark.asking import Answer
from experiments.planning_benchmark.contenders import CONTENDERS, Contender, full_label
from experiments.stored import Stored
from experiments.tables.intervals import Estimate, Statistic, ratio
from vprism_plan.errors import ConfigError

DEEP = 0.005  # metres of penetration that are more than a graze
OURS = "ours"  # what our contenders' keys begin with
REFERENCE = "truth"
_RESAMPLES = 1999


def estimate(statistic: Statistic, scenes: int) -> Estimate:
    """Return a statistic of all scenes with its 95 percent bootstrap interval over them.

    Draws that leave it undefined, such as a rate of paths where nobody found one, are left
    out: few scenes hold many problems here, and such draws are no failure.
    """
    value = float(statistic(np.arange(scenes)))
    drawn = np.random.default_rng(0xB007).integers(scenes, size=(_RESAMPLES, scenes))
    values = np.asarray(statistic(drawn), dtype=np.float64)
    values = values[np.isfinite(values)]
    if scenes < 2 or len(values) == 0 or not np.isfinite(value):
        return Estimate(value, float("nan"), float("nan"))
    low, high = np.percentile(values, (2.5, 97.5))
    return Estimate(value, float(low), float(high))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of all problems with one contender.

    Attributes:
        contender: who.
        answers: per scene, in the order that all contenders share.
        builds: seconds from observation to checker, per scene.
    """

    contender: Contender
    answers: tuple[tuple[Answer, ...], ...]
    builds: tuple[float, ...]

    @property
    def all(self) -> list[Answer]:
        """Every answer."""
        return [answer for scene in self.answers for answer in scene]

    @property
    def paths(self) -> list[Answer]:
        """Answers that hold a path."""
        return [answer for answer in self.all if answer.truth is not None]

    def counts(self) -> dict[str, Float[np.ndarray, " scenes"]]:
        """Per scene: problems, paths, paths that collide, and that collide by more than a graze."""
        rows = {"problems": [], "paths": [], "collided": [], "deep": []}  # type: dict[str, list]
        for scene in self.answers:
            found = [answer.truth for answer in scene if answer.truth is not None]
            rows["problems"].append(len(scene))
            rows["paths"].append(len(found))
            rows["collided"].append(sum(truth.collides for truth in found))
            rows["deep"].append(sum(truth.depth > DEEP for truth in found))
        return {name: np.array(values, dtype=float) for name, values in rows.items()}

    def estimates(self) -> dict[str, Estimate]:
        """Shares with their bootstrap intervals over scenes."""
        n = self.counts()
        shares: dict[str, Statistic] = {
            "success": ratio(n["paths"], n["problems"]),
            "collision": ratio(n["collided"], n["paths"]),
            "deep": ratio(n["deep"], n["paths"]),
            "safe": ratio(n["paths"] - n["collided"], n["problems"]),
        }
        return {name: estimate(share, len(self.answers)) for name, share in shares.items()}

    def to_dict(self, reference: "Outcome | None" = None) -> dict[str, Any]:
        """Return all figures, ready for JSON; lengths against those of `reference`."""
        paths, answers = self.paths, self.all
        depths = np.array(
            [a.truth.depth for a in paths if a.truth is not None and a.truth.collides]
        )
        seconds = np.array([answer.processor for answer in answers])
        refused = Counter(_group(answer.refused) for answer in answers if answer.refused)
        unsolved = Counter(
            "refused" if answer.refused else answer.status
            for answer in answers
            if not answer.solved
        )
        return {
            "contender": self.contender.to_dict(),
            **{name: value.to_dict() for name, value in self.estimates().items()},
            "problems": len(answers),
            "paths": len(paths),
            "collided": len(depths),
            "deep_collisions": int((depths > DEEP).sum()),
            "worst_depth": float(depths.max(initial=0.0)),
            "mean_depth": float(depths.mean()) if len(depths) else 0.0,
            "hit": dict(Counter(a.known for a in paths if a.known)),
            "refused": dict(refused),
            "unsolved": dict(unsolved),
            "length": _relative(self, reference, "length"),
            "travel": _relative(self, reference, "travel"),
            "seconds_median": float(np.median(seconds)),
            "seconds_95": float(np.percentile(seconds, 95.0)),
            "seconds_mean": float(seconds.mean()),
            "build": float(np.median(self.builds)),
        }


def _group(refused: str) -> str:
    """Objects and links count together."""
    return "object" if refused.startswith("object:") else refused


def _relative(own: "Outcome", reference: "Outcome | None", name: str) -> float | None:
    """Median of a length over the reference's, where both have a path; None without any."""
    if reference is None:
        return None
    values = [
        getattr(a, name) / getattr(b, name)
        for a, b in zip(own.all, reference.all, strict=True)
        if a.solved and b.solved and getattr(b, name)
    ]
    return float(np.median(values)) if values else None


def outcomes(found: Sequence[dict[str, Any]]) -> list[Outcome]:
    """Sort the answers of `run` by contender, scenes in one order.

    Raises:
        ConfigError: some contender was not asked about every scene.
    """
    scenes: list[tuple[str, int]] = []
    table: dict[str, dict[tuple[str, int], dict[str, Any]]] = {}
    for entry in found:
        scene = (entry["kind"], entry["seed"])
        if scene not in scenes:
            scenes.append(scene)
        table.setdefault(entry["contender"], {})[scene] = entry
    made = []
    for key, own in table.items():
        missing = [scene for scene in scenes if scene not in own]
        if missing:
            raise ConfigError(f"{key} was not asked about {missing[0]}; run it on every scene")
        made.append(
            Outcome(
                CONTENDERS[key],
                tuple(
                    tuple(Answer.from_dict(answer) for answer in own[scene]["answers"])
                    for scene in scenes
                ),
                tuple(float(own[scene]["build"]) for scene in scenes),
            )
        )
    return made


# --- statements -----------------------------------------------------------------------


@dataclass(frozen=True)
class Statement(Stored):
    """A comparison of our curve with one contender.

    Attributes:
        who: "ours", or "ours with one rule" where none that tries several margins counts.
        against: label of the contender.
        asked: "collisions at its success rate" or "successes at its collision rate".
        theirs: the contender's figure, a share.
        ours: that of our curve at the same place, a share.
        quotient: ours / theirs with its bootstrap interval over scenes.
        reached: whether our curve reaches that place; otherwise its end is compared.
    """

    who: str
    against: str
    asked: str
    theirs: float
    ours: float
    quotient: Estimate
    reached: bool


def front(
    success: Float[np.ndarray, " n"], collided: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return what can be reached by tossing a coin between contenders: the lower hull.

    Of shares of the problems with a path, and whose path collides: success in rising order
    from 0, and the least share of collisions there.
    """
    points = sorted({(0.0, 0.0), *zip(success.tolist(), collided.tolist(), strict=True)})
    hull: list[tuple[float, float]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            continue  # the same success with more collisions
        while len(hull) >= 2 and _not_below(hull[-2], hull[-1], (x, y)):
            hull.pop()
        hull.append((x, y))
    xs, ys = np.array(hull).T
    return xs, ys


def _not_below(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])


def collisions_at(
    success: Float[np.ndarray, " n"], collided: Float[np.ndarray, " n"], wanted: float
) -> float:
    """Least share of problems that collide when a share `wanted` of them gets a path."""
    xs, ys = front(success, collided)
    return float(np.interp(wanted, xs, ys))


def successes_at(
    success: Float[np.ndarray, " n"], collided: Float[np.ndarray, " n"], rate: float
) -> float:
    """Largest share of problems with a path at a collision rate of the paths of at most `rate`."""
    xs, ys = front(success, collided)
    xs, ys = np.insert(xs, 0, 0.0), np.insert(ys, 0, 0.0)
    best = 0.0
    for k in range(1, len(xs)):
        # On a piece of the hull: y <= rate * x, both linear in the share t of the way.
        a = ys[k - 1] - rate * xs[k - 1]
        b = ys[k] - rate * xs[k]
        if b <= 1e-12:
            best = max(best, float(xs[k]))
        elif a <= 1e-12:
            t = -min(a, 0.0) / (b - min(a, 0.0))
            best = max(best, float(xs[k - 1] + t * (xs[k] - xs[k - 1])))
    return best


def statements(found: Sequence[Outcome]) -> list[Statement]:
    """Compare our curve with meshes at their success (with wide steps and with fine ones), and
    with unknown occupied at its collisions."""
    ours = [outcome for outcome in found if outcome.contender.key.startswith(OURS)]
    groups = {"ours": ours, "ours with one rule": [o for o in ours if len(o.contender.bounds) == 1]}
    by_key = {outcome.contender.key: outcome for outcome in found}
    made = []
    for key, asked in (
        ("fcl", "collisions at its success rate"),
        ("fcl-fine", "collisions at its success rate"),
        ("octomap-occupied", "successes at its collision rate"),
    ):
        for who, own in groups.items():
            if own and key in by_key and (who == "ours" or len(own) < len(ours)):
                made.append(_compare(who, own, by_key[key], asked))
    return made


def _compare(who: str, ours: Sequence[Outcome], other: Outcome, asked: str) -> Statement:
    mine = [outcome.counts() for outcome in ours]
    theirs = other.counts()
    at_success = asked.startswith("collisions")

    def figures(scenes: np.ndarray) -> tuple[float, float, bool]:
        n = theirs["problems"][scenes].sum()
        success = np.array([m["paths"][scenes].sum() for m in mine]) / n
        collided = np.array([m["collided"][scenes].sum() for m in mine]) / n
        paths, hits = theirs["paths"][scenes].sum() / n, theirs["collided"][scenes].sum() / n
        if at_success:
            return hits, collisions_at(success, collided, paths), bool(success.max() >= paths)
        rate = hits / paths if paths else 0.0
        return paths, successes_at(success, collided, rate), True

    def quotient(scenes: np.ndarray) -> Any:
        drawn = np.atleast_2d(scenes)
        pairs = [figures(row)[:2] for row in drawn]
        values = np.array([b / a if a > 0 else np.nan for a, b in pairs])
        return values.reshape(np.shape(scenes)[:-1])

    everything = np.arange(len(other.answers))
    a, b, reached = figures(everything)
    return Statement(
        who,
        other.contender.line if other.contender.key == "fcl" else full_label(other.contender),
        asked,
        a,
        b,
        estimate(quotient, len(everything)),
        reached,
    )
