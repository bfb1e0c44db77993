# SPDX-License-Identifier: BSD-3-Clause
"""Start and goal pairs that are solvable in truth and pass near or behind objects.

Every end has a finger tip within a few centimetres of an object; every second problem at
least has an end that the camera cannot see, behind or between objects. All of them were
solved on the true geometry with room to spare, so a checker that knew the truth would too.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from experiments.planning_benchmark.grid_world import views_of
from experiments.planning_benchmark.truth import Truth
from experiments.stored import Stored
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.motion import place_points, sphere_jacobians
from vprism_plan.planning import plan
from vprism_plan.robots import Robot
from vprism_plan.robots.kinematics import frame_poses
from vprism_plan.world.visibility import OCCLUDED, classify_points

_log = logging.getLogger(__name__)

_CANDIDATES = 30_000  # places that are looked at for a finger tip
_STARTS = 384  # configurations that are moved to places at once
_ROUNDS = 18
_PER_ROUND = 4  # ends of each kind that a round adds, so that the rounds mix
_ITERATIONS = 25
_DAMPING = 0.02
_REACHED = 0.003  # metres


@dataclass(frozen=True)
class Criteria(Stored):
    """What a problem must be. Lengths in metres.

    Attributes:
        clearance: that some path between the ends keeps from the true scene.
        ends: what ends keep at least; a third of them is drawn with each of these.
        tip: largest distance between a finger tip and the nearest object, at both ends.
        hand: largest distance between the hand or fingers and an object, at both ends.
        hidden: share of the problems with an end whose finger tip the camera cannot see.
        straight: the straight motion comes nearer than this to something, or collides.
        tilt: largest angle between the hand's axis and straight down, radians.
        time_limit: seconds of processor time for the proof that a pair is solvable.
    """

    clearance: float = 0.01
    ends: tuple[float, ...] = (0.01, 0.02, 0.03)
    tip: float = 0.08
    hand: float = 0.1
    hidden: float = 0.5
    straight: float = 0.03
    tilt: float = 1.3
    time_limit: float = 3.0


@dataclass(frozen=True)
class Problem(Stored):
    """A query; one of `find_problems` has an answer.

    Attributes:
        number: within its scene, from 0.
        start, goal: configurations, radians.
        hidden: whether the camera cannot see the finger tip at the start, at the goal.
        hand: distance of hand and fingers to the nearest object at both ends, metres.
        seed: for the planners that are to solve it.
        reachable: where that was not a condition, whether a path exists in truth with each of
            some clearances, in rising order (`Proposals.clearances`).
    """

    number: int
    start: tuple[float, ...]
    goal: tuple[float, ...]
    hidden: tuple[bool, bool]
    hand: tuple[float, float]
    seed: int
    reachable: tuple[bool, ...] = ()


@dataclass(frozen=True)
class _End:
    q: np.ndarray
    hidden: bool
    hand: float


def find_problems(
    truth: Truth, count: int = 20, seed: int = 0, criteria: Criteria | None = None
) -> list[Problem]:
    """Find problems in a scene; the same arguments give the same ones.

    (As long as no proof runs into its time limit, which the machine's speed decides.)

    Args:
        truth: the scene and the robot.
        count: how many; fewer, with a warning, if the scene does not offer them.
        seed: of every choice.
        criteria: what they must be.
    """
    criteria = Criteria() if criteria is None else criteria
    rng = np.random.default_rng([seed, 0x9A7B])
    checkers = truth.checker(criteria.clearance), truth.checker(criteria.straight)
    ends: list[_End] = []
    problems: list[Problem] = []
    source = _ends(truth, rng, criteria)
    # Ever more ends are drawn until their pairs give enough problems.
    for wanted in (count, 2 * count, 3 * count):
        ends += [end for end, _ in zip(source, range(wanted - len(ends)), strict=False)]
        if len(ends) < 2:
            break
        pairs = _pairs(ends, rng)
        problems = _solvable(ends, pairs, checkers, count, seed, criteria)
        if len(problems) == count:
            return problems
    _log.warning(
        "scene %s offers %d problems of %d wanted (%d ends)",
        truth.scene.name, len(problems), count, len(ends),
    )  # fmt: skip
    return problems


def _pairs(ends: list[_End], rng: np.random.Generator) -> list[tuple[int, int]]:
    """Every ordered pair of different ends, shuffled."""
    n = len(ends)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    return [pairs[k] for k in rng.permutation(len(pairs))]


def _solvable(
    ends: list[_End],
    pairs: list[tuple[int, int]],
    checkers: tuple[CollisionChecker, CollisionChecker],
    count: int,
    seed: int,
    criteria: Criteria,
) -> list[Problem]:
    """Take pairs that meet the criteria until there are enough."""
    spacious, wide = checkers
    open_left = count - int(np.ceil(criteria.hidden * count))
    used: set[frozenset[int]] = set()
    problems: list[Problem] = []
    for i, j in pairs:
        if len(problems) == count:
            break
        a, b = ends[i], ends[j]
        seen = not (a.hidden or b.hidden)
        if frozenset((i, j)) in used or (seen and open_left == 0):
            continue
        used.add(frozenset((i, j)))
        if wide.check_motion(a.q, b.q):
            continue
        number = len(problems)
        own = int(np.random.default_rng([seed, number]).integers(2**31))
        found = plan(
            spacious, a.q, b.q, time_limit=criteria.time_limit, seed=own, clock="process",
            margins=None,
        )  # fmt: skip
        if not found.solved:
            continue
        open_left -= seen
        problems.append(
            Problem(number, tuple(a.q.tolist()), tuple(b.q.tolist()), (a.hidden, b.hidden),
                    (a.hand, b.hand), own)
        )  # fmt: skip
    return problems


def _ends(truth: Truth, rng: np.random.Generator, criteria: Criteria) -> Iterator[_End]:
    """Yield configurations with the finger tip near an object, in turns hidden and seen."""
    places, hidden = _tip_places(truth, rng, criteria)
    checkers = [truth.checker(clearance) for clearance in criteria.ends]
    queues: list[list[_End]] = [[], []]
    for number in range(_ROUNDS):
        checker = checkers[number % len(checkers)]
        for which, own in enumerate((places[hidden], places[~hidden])):
            found = _reaching(truth, checker, own, rng, criteria)
            for q in found[:_PER_ROUND]:
                near = hand_distance(truth, q)
                if near <= criteria.hand:
                    queues[which].append(_End(q, which == 0, near))
        while all(queues):
            yield queues[0].pop(0)
            yield queues[1].pop(0)
    yield from queues[0] + queues[1]


def _tip_places(
    truth: Truth, rng: np.random.Generator, criteria: Criteria
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Places for a finger tip near objects, in random order, and which the camera cannot see."""
    nodes = np.argwhere(truth.field.distance <= 0.0)
    if len(nodes) == 0:
        return np.empty((0, 3)), np.zeros(0, dtype=bool)
    corner = truth.field.origin + truth.field.spacing * nodes
    reach = criteria.tip
    least = float(truth.robot.sphere_radii[tip_sphere(truth.robot)]) + min(criteria.ends)
    lower, upper = corner.min(axis=0) - reach, corner.max(axis=0) + reach
    lower[2] = max(lower[2], least)
    points = rng.uniform(lower, upper, (_CANDIDATES, 3))
    points = points[truth.field.lower_bound(points) <= reach]
    exact = np.asarray(truth.scene.signed_distance(points))
    points = points[(exact >= least) & (exact <= reach)]
    status = classify_points(views_of(truth.scene.observation), points)
    return points, status == OCCLUDED


def _reaching(
    truth: Truth,
    checker: CollisionChecker,
    places: Float[np.ndarray, "n 3"],
    rng: np.random.Generator,
    criteria: Criteria,
) -> Float[np.ndarray, "m dof"]:
    """Valid configurations with the finger tip at some of the places, at most one at each.

    Damped least squares on the position alone, from random starts with the hand down, all
    places at once; the redundancy keeps the starts' variety of postures.
    """
    if len(places) == 0:
        return np.empty((0, truth.robot.dof))
    robot, arrays = truth.robot, truth.robot.arrays
    chosen = rng.integers(len(places), size=_STARTS)
    q = np.array([robot.random_configuration(rng) for _ in range(8 * _STARTS)])
    q = q[np.argsort(_tilts(robot, q), kind="stable")[:_STARTS]]
    q = q[rng.permutation(_STARTS)]
    spheres = np.full(_STARTS, tip_sphere(robot))
    for _ in range(_ITERATIONS):
        centers, jacobian = sphere_jacobians(arrays, q, spheres)
        error = places[chosen] - centers
        damped = jacobian @ jacobian.transpose(0, 2, 1) + _DAMPING**2 * np.eye(3)
        step = np.einsum("nji,nj->ni", jacobian, np.linalg.solve(damped, error[..., None])[..., 0])
        largest = np.abs(step).max(axis=1, keepdims=True)
        q = np.clip(q + step * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-12)),
                    robot.lower, robot.upper)  # fmt: skip
    centers, _ = sphere_jacobians(arrays, q, spheres)
    good = np.linalg.norm(places[chosen] - centers, axis=1) <= _REACHED
    good &= _tilts(robot, q) <= criteria.tilt
    rows = np.flatnonzero(good)
    rows = rows[checker.is_valid_batch(q[rows])]
    _, first = np.unique(chosen[rows], return_index=True)
    return q[rows[np.sort(first)]]


def _tilts(robot: Robot, Q: Float[np.ndarray, "n dof"]) -> Float[np.ndarray, " n"]:
    """Angle between the hand's axis (from the hand to the finger tips) and straight down."""
    hand = np.flatnonzero(np.asarray(robot.sphere_links) == robot.link_names.index("panda_hand"))
    ends = np.array([*hand, tip_sphere(robot)])
    arrays = robot.arrays
    R, t = frame_poses(arrays, Q)
    centers = place_points(R, t, arrays.sphere_frame[ends], arrays.sphere_center[ends])
    axis = centers[:, -1] - centers[:, :-1].mean(axis=1)
    return np.arccos(np.clip(-axis[:, 2] / np.linalg.norm(axis, axis=1), -1.0, 1.0))


def tip_sphere(robot: Robot) -> int:
    """Return the sphere of the left finger that is farthest from the hand."""
    finger = robot.link_names.index("panda_leftfinger")
    own = np.flatnonzero(np.asarray(robot.sphere_links) == finger)
    return int(own[np.argmax(robot.arrays.sphere_center[own, 2])])


def hand_distance(truth: Truth, q: Float[np.ndarray, " dof"]) -> float:
    """Return the distance between hand and fingers and the nearest true object, metres."""
    robot = truth.robot
    hand = {robot.link_names.index(link) for link in robot.links_of("hand")}
    chosen = np.flatnonzero(np.isin(robot.sphere_links, list(hand)))
    centers = truth.sphere_centers(q[None], chosen)[0]
    gaps = np.asarray(truth.scene.signed_distance(centers)) - robot.sphere_radii[chosen]
    return float(gaps.min())
