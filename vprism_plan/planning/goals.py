# SPDX-License-Identifier: BSD-3-Clause
"""Starts and goals: configurations, and poses and regions that become some; what is refused."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from vprism_plan._arguments import number, rigid_pose, whole
from vprism_plan.collision.explain import limit_contacts
from vprism_plan.errors import PlanningError, RobotError
from vprism_plan.planning._inverse_kinematics import Targets, Tip, descend, find_tip
from vprism_plan.planning.ompl_adapter import nearest_turns
from vprism_plan.planning.path import one_line
from vprism_plan.planning.protocols import CheckerLike, Configuration
from vprism_plan.planning.result import PlanReport, PlanResult, RefusedGoal
from vprism_plan.robots.kinematics import (
    frame_poses,
    joint_values,
    outside_limits,
    within_limits,
)

_APART = 0.05  # solutions nearer to each other in every joint are one
_BESIDE = 192  # configurations beside a refused start that are looked at


@dataclass(frozen=True)
class PoseGoalConfig:
    """How a pose, or a region, becomes configurations.

    Attributes:
        link: that is to reach the pose; one named like an end effector ("tcp", "tool0",
            "hand", ...) if None. A `ReachRegion` names its own.
        attempts: number of random configurations the solver starts from.
        iterations: steps per attempt.
        position_tolerance: metres between the link and the pose that count as reached.
        rotation_tolerance: radians likewise.
        max_goals: how many valid configurations are handed to the planner at most.
    """

    link: str | None = None
    attempts: int = 64
    iterations: int = 100
    position_tolerance: float = 1e-4
    rotation_tolerance: float = 1e-3
    max_goals: int = 8

    def __post_init__(self) -> None:
        for name in ("attempts", "iterations", "max_goals"):
            whole(name, getattr(self, name), 1, error=PlanningError)
        for name in ("position_tolerance", "rotation_tolerance"):
            value = getattr(self, name)
            number(name, value, 0.0, above=True, finite=False, error=PlanningError)


@dataclass(frozen=True, eq=False)
class ReachRegion:
    """A goal: a link's origin somewhere in a box or a ball, its orientation fixed or free.

        plan(checker, q, ReachRegion.box([0.4, -0.1, 0.1], [0.6, 0.1, 0.2], link="panda_hand"))

    Places are drawn from the region, configurations are solved for, and those the checker
    accepts are the goals. OMPL's own way to sample goals while it plans (`GoalLazySamples`)
    does not work from Python: its thread never gets the interpreter's lock.

    Attributes:
        pose: (4, 4) frame of the region in the world, metres.
        extent: (3,) half the edges of a box along the axes of `pose`; or (1,) a radius.
        link: whose origin; the end effector if None.
        rotation: (3, 3) wanted rotation of the link in the world; None: any.
        tilt: largest angle between the link's rotation and the wanted one, radians.
        free_axis: (3,) axis in the link's own frame; turning about it changes nothing (a
            gripper's approach axis). `tilt` then is the angle between the two axes.
    """

    pose: Any
    extent: Any
    link: str | None = None
    rotation: Any = None
    tilt: float = 1e-3
    free_axis: Any = None

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "pose", rigid_pose("pose of a region", self.pose, error=PlanningError))
        extent = np.atleast_1d(np.array(self.extent, dtype=np.float64))
        if extent.shape not in {(1,), (3,)} or not (np.isfinite(extent) & (extent >= 0.0)).all():
            needed = "one radius or three half edges, metres, finite and not negative"
            raise PlanningError(f"extent is {self.extent!r}; it must be {needed}")
        set_(self, "extent", extent)
        if self.rotation is not None:
            turned = np.eye(4)
            turned[:3, :3] = self.rotation
            set_(self, "rotation", rigid_pose("rotation", turned, error=PlanningError)[:3, :3])
        number("tilt", self.tilt, 0.0, math.pi, "radians", above=True, error=PlanningError)
        if self.free_axis is not None:
            axis = np.array(self.free_axis, dtype=np.float64)
            length = float(np.linalg.norm(axis)) if axis.shape == (3,) else 0.0
            if not (math.isfinite(length) and length > 1e-9):
                raise PlanningError(f"free_axis is {self.free_axis!r}; it must be a direction (3,)")
            if self.rotation is None:
                raise PlanningError("free_axis without rotation: every orientation is free already")
            set_(self, "free_axis", axis / length)

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike, **others: Any) -> "ReachRegion":
        """Return the box between two corners (3,), world, metres; `others` as the attributes."""
        low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,) or not (low <= high).all():
            raise PlanningError(f"box from {lower!r} to {upper!r}; give two corners, lower first")
        pose = np.eye(4)
        pose[:3, 3] = 0.5 * (low + high)
        return cls(pose, 0.5 * (high - low), **others)

    @classmethod
    def sphere(cls, center: ArrayLike, radius: float, **others: Any) -> "ReachRegion":
        """Return the ball around a point (3,), world, metres; `others` as the attributes."""
        middle = np.array(center, dtype=np.float64)
        if middle.shape != (3,):
            raise PlanningError(f"center is {center!r}; it must be a point (3,)")
        pose = np.eye(4)
        pose[:3, 3] = middle
        return cls(pose, np.array([radius]), **others)

    def contains(
        self, rotations: Float[np.ndarray, "n 3 3"], positions: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return which poses of the link are in the region, up to rounding (1e-9)."""
        local = (positions - self.pose[:3, 3]) @ self.pose[:3, :3]
        if len(self.extent) == 1:
            inside = np.linalg.norm(local, axis=1) <= self.extent[0] + 1e-9
        else:
            inside = (np.abs(local) <= self.extent + 1e-9).all(axis=1)
        if self.rotation is None:
            return inside
        if self.free_axis is None:
            turns = Rotation.from_matrix(self.rotation @ rotations.transpose(0, 2, 1))
            angle = np.asarray(turns.magnitude())
        else:
            now, wanted = rotations @ self.free_axis, self.rotation @ self.free_axis
            angle = np.arctan2(np.linalg.norm(np.cross(now, wanted), axis=1), now @ wanted)
        return inside & (angle <= self.tilt + 1e-9)

    def draw(self, n: int, rng: np.random.Generator) -> Targets:
        """Draw targets, places uniform in the region, orientations within half the tilt."""
        if len(self.extent) == 1:
            local = rng.normal(size=(n, 3))
            local /= np.linalg.norm(local, axis=1, keepdims=True)
            local *= self.extent[0] * np.cbrt(rng.uniform(size=(n, 1)))
        else:
            local = self.extent * rng.uniform(-1.0, 1.0, (n, 3))
        # Solutions may miss their target by a little and must still be inside.
        positions = self.pose[:3, 3] + 0.999 * local @ self.pose[:3, :3].T
        if self.rotation is None:
            return Targets(positions)
        tilt = rng.normal(size=(n, 3))
        tilt *= 0.5 * self.tilt * rng.uniform(size=(n, 1)) / np.linalg.norm(tilt, axis=1)[:, None]
        rotations = Rotation.from_rotvec(tilt).as_matrix() @ self.rotation
        return Targets(positions, rotations, self.free_axis)


def solve_pose(
    robot: Any, pose: np.ndarray, reference: Configuration, seed: int, config: PoseGoalConfig
) -> Float[np.ndarray, "n dof"]:
    """Find configurations that bring a link to a pose (4, 4) in the world, metres.

    They are distinct, nearest to `reference` first, and not yet checked. The solver starts there
    and at random within the joint limits, in float64, with mimic and continuous joints.
    (pytorch-kinematics' reads its offsets in float32 and leaves mimic joints out:
    `experiments.benchmarks.inverse_kinematics`.) Raises PlanningError for what is no rigid
    transform, or an unknown link.
    """
    pose = rigid_pose("goal pose", pose, error=PlanningError)
    n = config.attempts
    targets = Targets(np.tile(pose[:3, 3], (n, 1)), np.tile(pose[:3, :3], (n, 1, 1)))
    _, q, away, turn = _descended(robot, config.link, lambda _: targets, reference, seed, config)
    good = (away <= config.position_tolerance) & (turn <= config.rotation_tolerance)
    return _distinct(robot, q[good], reference)


def solve_region(
    robot: Any, region: ReachRegion, reference: Configuration, seed: int, config: PoseGoalConfig
) -> Float[np.ndarray, "n dof"]:
    """Find configurations that bring a link into a region; arguments as `solve_pose`."""
    n, link = config.attempts, region.link or config.link
    tip, q, _, _ = _descended(robot, link, lambda rng: region.draw(n, rng), reference, seed, config)
    good = region.contains(*tip.behind(*frame_poses(robot.arrays, q)))
    return _distinct(robot, q[good], reference)


def _descended(
    robot: Any,
    link: str | None,
    draw: Callable[[np.random.Generator], Targets],
    reference: Configuration,
    seed: int,
    config: PoseGoalConfig,
) -> tuple[Tip, np.ndarray, np.ndarray, np.ndarray]:
    """The link, and what `descend` makes of the reference and random starts."""
    rng = np.random.default_rng(seed)
    tip = find_tip(robot, link)
    lower, upper = np.asarray(robot.lower), np.asarray(robot.upper)
    starts = rng.uniform(lower, upper, (config.attempts, robot.dof))
    starts[0] = reference
    return tip, *descend(robot, tip, draw(rng), starts, config.iterations)


def _distinct(
    robot: Any, q: Float[np.ndarray, "n dof"], reference: Configuration
) -> Float[np.ndarray, "m dof"]:
    """Drop near duplicates, and whole turns; nearest to the reference first."""
    q = nearest_turns(q, reference, np.asarray(robot.continuous, dtype=bool))
    kept: list[np.ndarray] = []
    for candidate in q[np.argsort(np.linalg.norm(q - reference, axis=1), kind="stable")]:
        if all(np.max(np.abs(candidate - other)) > _APART for other in kept):
            kept.append(candidate)
    return np.array(kept).reshape(-1, q.shape[1])


def configuration(q: Any, robot: Any, what: str) -> Configuration:
    """Return a fresh float64 copy of q, or raise PlanningError naming what is wrong.

    What is beyond a limit by no more than `LIMIT_TOLERANCE` is put on it.
    """
    array = numbers(q, robot, what)
    if array.shape != (robot.dof,):
        joints = f"({robot.dof},), one value per joint: {', '.join(robot.joint_names)}"
        raise PlanningError(f"{what} has shape {array.shape}; it must be {joints}")
    if not np.isfinite(array).all():
        raise PlanningError(f"{what} is {array}; every joint value must be finite")
    return np.where(outside_limits(robot, array), array, within_limits(robot, array))


def numbers(values: Any, robot: Any, what: str) -> Float[np.ndarray, "..."]:
    """Return values as a fresh float64 array of any shape; PlanningError if they are not."""
    try:
        return joint_values(values, robot, what)
    except RobotError as error:
        raise PlanningError(str(error)) from error


def _refusal(checker: CheckerLike, q: Configuration) -> tuple[str, Any] | None:
    """Why q must not be used, and the checker's report on it; None if it may be."""
    limits = limit_contacts(checker.robot, q)  # outside them OMPL would refuse without a reason
    if not limits and checker.is_valid(q):
        return None
    explanation = checker.explain(q)
    outside = ", ".join(contact.text() for contact in limits)
    return outside if explanation.valid else one_line(explanation), explanation


def refuse(
    checker: CheckerLike, q: Configuration, what: str, report: PlanReport
) -> PlanResult | None:
    """Return the refusal if q must not be used as start or goal, None if it may."""
    refusal = _refusal(checker, q)
    if refusal is None:
        return None
    status: Any = f"invalid_{what}"
    message = f"{what} is invalid: {refusal[0]}"
    return PlanResult(None, status, report, message, explanation=refusal[1])


def free_start(
    checker: CheckerLike, q: Configuration, nudge: float, seed: int
) -> tuple[Configuration, str]:
    """Return q, or for one that is refused the nearest free configuration that is found, no joint
    farther than `nudge` (radians or metres), and what to say of it; q and "" without one."""
    refusal = _refusal(checker, q) if nudge > 0.0 else None
    if refusal is None:
        return q, ""
    rng, wide = np.random.default_rng(seed), np.linspace(0.1, 1.0, _BESIDE)[:, None]
    near = q + nudge * wide * rng.uniform(-1.0, 1.0, (_BESIDE, len(q)))
    near = within_limits(checker.robot, near)
    moves = np.abs(near - q).max(axis=1)
    for k in np.argsort(moves):
        if moves[k] <= nudge and checker.is_valid(near[k]):
            away = f"{math.ceil(1e5 * moves[k]) / 100:g} mrad (mm) away"
            return near[k], (
                f"the start is refused ({refusal[0]}); the path begins at a free configuration "
                f"beside it, with joints up to {away}, and the way there is not checked"
            )
    return q, ""


def valid_goals(
    checker: CheckerLike,
    goal: Any,
    start: Configuration,
    config: PoseGoalConfig,
    report: PlanReport,
) -> tuple[Float[np.ndarray, "g dof"], PlanReport] | PlanResult:
    """Return valid goal configurations (g, dof) and the report of the others, or the refusal."""
    robot = checker.robot
    array = np.empty(0) if isinstance(goal, ReachRegion) else numbers(goal, robot, "goal")
    if isinstance(goal, ReachRegion):
        what, found = "region", solve_region(robot, goal, start, report.seed, config)
    elif array.shape == (4, 4) and (robot.dof != 4 or array[3].tolist() == [0.0, 0.0, 0.0, 1.0]):
        what, found = "pose", solve_pose(robot, array, start, report.seed, config)
    elif array.ndim == 2 and len(array) > 0 and array.shape[1] == robot.dof:
        found = np.stack([configuration(q, robot, f"goal {k}") for k, q in enumerate(array)])
        what = ""
    else:
        q = configuration(array, robot, "goal")
        refusal = refuse(checker, q, "goal", report)
        return (q[None], report) if refusal is None else refusal
    if len(found) == 0:
        message = (
            "goal is invalid: no configuration within the joint limits reaches the "
            f"{what} ({config.attempts} attempts)"
        )
        return PlanResult(None, "invalid_goal", report, message)
    good: list[np.ndarray] = []
    notes: list[RefusedGoal] = []
    explanations: list[Any] = []
    most = config.max_goals if what else len(found)  # the caller's own are all kept
    for q in found:
        why = _refusal(checker, q)
        if why is None:
            good.append(q)
        else:
            notes.append(RefusedGoal(tuple(q.tolist()), why[0]))
            explanations.append(why[1])
        if len(good) == most:
            break
    report = replace(report, refused_goals=tuple(notes))
    if good:
        return np.array(good), report
    said = f"found for the goal {what}" if what else "given as goals"
    message = f"all {len(found)} configurations {said} are invalid, the first: {notes[0].reason}"
    return PlanResult(None, "invalid_goal", report, message, explanation=explanations[0])
