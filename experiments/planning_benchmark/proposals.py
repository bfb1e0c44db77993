# SPDX-License-Identifier: BSD-3-Clause
"""Hand poses as a grasp planner proposes them from the image: nobody looks at the truth first.

The finger tip goes behind a seen point, and the robot keeps clear of all that was seen. Some
of these goals cannot be reached, and some lie inside what is hidden: the truth says so only
afterwards.
"""

import logging
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from experiments.planning_benchmark.checkers import Bench
from experiments.planning_benchmark.grid_world import checker_of, support_plane, views_of
from experiments.planning_benchmark.problems import Problem, hand_distance, tip_sphere
from experiments.planning_benchmark.truth import Truth
from experiments.stored import Stored
from vprism_plan.collision import CollisionChecker
from vprism_plan.perception import Observation
from vprism_plan.planning import plan
from vprism_plan.planning._inverse_kinematics import Targets, Tip, descend, find_tip
from vprism_plan.world.visibility import OCCLUDED, classify_points

_log = logging.getLogger(__name__)

# Where the arm waits, radians: the maker's home; the same turned to either side; folded.
HOMES = (
    (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    (1.2, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    (-1.2, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    (0.0, -1.5, 0.0, -2.8, 0.0, 1.9, 0.785),
)
_HAND = "panda_hand"
_PLACES = 65_536  # places for a finger tip that a round draws, with a hand pose for each ...
_STARTS, _TRIES = 128, 3  # ... of which, if clear, the arm is brought to some, from some starts
_ITERATIONS = 60
_REACHED, _TURNED = 0.001, 0.02  # metres, radians
_ROUNDS = 80
_PER_ROUND = 8  # goals that a round adds, so that rounds mix


@dataclass(frozen=True)
class Proposals(Stored):
    """How goals are proposed, and what the truth is asked of them. Lengths in metres.

    Attributes:
        behind: how far the finger tip lies behind a seen point, along its ray: least and most.
        clear: that the robot keeps from every seen point and from the support.
        tilt: largest angle between the hand's axis and straight down, radians.
        clearances: with which the truth is asked for a path, rising.
        time_limit: seconds of processor time for each of those searches.
    """

    behind: tuple[float, float] = (0.02, 0.15)
    clear: float = 0.004
    tilt: float = math.pi / 3.0
    clearances: tuple[float, float] = (0.0, 0.01)
    time_limit: float = 3.0


def tip_places(
    observation: Observation, rng: np.random.Generator, behind: tuple[float, float], n: int
) -> Float[np.ndarray, "n 3"]:
    """Return `n` places (m) behind seen points of labelled objects, each object as often.

    They lie `behind` (m, least and most) the points along their rays.
    """
    points, labels = observation.points()
    own = rng.choice(np.unique(labels[labels > 0]), n)
    seen = np.empty((n, 3))
    for k in np.unique(own):
        seen[own == k] = rng.choice(points[labels == k], int((own == k).sum()))
    ray = seen - observation.camera_center
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return seen + rng.uniform(*behind, (n, 1)) * ray


def hand_rotations(rng: np.random.Generator, tilt: float, n: int) -> Float[np.ndarray, "n 3 3"]:
    """Return `n` orientations of a hand whose axis z leans at most `tilt` from straight down."""
    lean, azimuth, roll = rng.uniform((0.0, 0.0, 0.0), (tilt, 2 * np.pi, 2 * np.pi), (n, 3)).T
    made = Rotation.from_euler("ZYZ", np.stack([azimuth, math.pi - lean, roll], axis=1))
    return np.asarray(made.as_matrix())


def propose(
    checker: CollisionChecker, observation: Observation, count: int, seed: int, how: Proposals
) -> list[Float[np.ndarray, " dof"]]:
    """Return configurations (dof,) with the finger tip behind what was seen, at most `count`.

    Args:
        checker: of the seen points, with the clearance to keep; also of limits and the robot.
        observation: what the camera saw.
        count: how many.
        seed: of every choice.
        how: where, and how far tilted.
    """
    rng, robot, field = np.random.default_rng([seed, 0xA5CED]), checker.robot, checker.world.field
    arrays, tip = robot.arrays, find_tip(robot, _HAND)
    # Hand and fingers are fixed to one frame: a pose of it says whether they are clear.
    own = np.flatnonzero(arrays.sphere_frame == tip.frame)
    offsets = arrays.sphere_center[own]
    first = int(np.flatnonzero(own == tip_sphere(robot))[0])
    wide = np.asarray(robot.sphere_radii)[own] + checker.config.margin
    mount = Tip(tip.frame, np.eye(4), tip.chain)
    plane, turn = support_plane(observation), tip.offset[:3, :3].T
    goals: list[Float[np.ndarray, " dof"]] = []
    for _ in range(_ROUNDS):
        places = tip_places(observation, rng, how.behind, _PLACES)
        high = plane.signed_distance(places) >= wide[first]
        places = places[high & (field.lower_bound(places) >= wide[first])]
        R = hand_rotations(rng, how.tilt, len(places)) @ turn
        t = places - R @ offsets[first]
        centers = np.einsum("nij,sj->nsi", R, offsets) + t[:, None]
        rows = np.flatnonzero((plane.signed_distance(centers) >= wide).all(axis=1))
        near = field.lower_bound(centers[rows].reshape(-1, 3)).reshape(-1, len(own))
        rows = np.repeat(rows[(near >= wide).all(axis=1)][:_STARTS], _TRIES)
        R, t = R[rows], t[rows]
        starts = rng.uniform(robot.lower, robot.upper, (len(t), robot.dof))
        q, away, turned = descend(robot, mount, Targets(t, R), starts, _ITERATIONS)
        rows = np.flatnonzero((away <= _REACHED) & (turned <= _TURNED))
        rows = rows[checker.is_valid_batch(q[rows])]
        _, single = np.unique(rows // _TRIES, return_index=True)
        goals += list(q[rows[single]][:_PER_ROUND])
        if len(goals) >= count:
            break
    return goals[:count]


def find_goals(truth: Truth, bench: Bench, count: int, seed: int, how: Proposals) -> list[Problem]:
    """Propose goals in a scene, then ask the truth which can be reached from home.

    Home is where the robot really stands: the first of `HOMES` that is clear of what was seen
    and keeps the largest clearance in truth. None, with a warning, if there is no such home.
    """
    robot, views = bench.robot, views_of(bench.observation)
    seen = checker_of(bench.point_world(), robot, how.clear)
    proofs = [truth.checker(clearance) for clearance in how.clearances]
    homes = [np.array(q) for q in HOMES]
    homes = [q for q in homes if seen.is_valid(q) and proofs[-1].is_valid(q)]
    goals = propose(seen, bench.observation, count, seed, how) if homes else []
    if len(goals) < count:
        _log.warning("scene %s offers %d goals of %d", truth.scene.name, len(goals), count)
    tip, problems = np.array([tip_sphere(robot)]), []
    for number, goal in enumerate(goals):
        own = int(np.random.default_rng([seed, number]).integers(2**31))
        reachable: list[bool] = []
        for proof in reversed(proofs):  # a path that keeps more keeps less, too
            reachable.insert(0, any(reachable) or plan(
                proof, homes[0], goal, time_limit=how.time_limit, seed=own, clock="process",
                margins=None,
            ).solved)  # fmt: skip
        ends = np.stack([homes[0], goal])
        places = truth.sphere_centers(ends, tip)[:, 0]
        a, b = (bool(status == OCCLUDED) for status in classify_points(views, places))
        near = hand_distance(truth, ends[0]), hand_distance(truth, goal)
        start, end = (tuple(q.tolist()) for q in ends)
        problems.append(Problem(number, start, end, (a, b), near, own, tuple(reachable)))
    return problems
