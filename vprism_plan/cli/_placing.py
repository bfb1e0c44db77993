# SPDX-License-Identifier: BSD-3-Clause
"""Where a robot could stand, start and end, when the user does not say."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from vprism_plan.cli._parsing import Command
from vprism_plan.errors import PlanningError

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.robots import Robot
    from vprism_plan.world import World

# Around the objects, from the camera's side: what the camera hides lies opposite.
_BEARINGS = np.deg2rad([0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0])
_SHARES_OF_REACH = (0.5, 0.4, 0.6, 0.7)
_ASIDE = 0.12  # metres between the objects' edge and where the hand starts or ends
_ACCEPT = 0.15  # metres between the hand and where it should be
_ODDNESS = 0.04  # metres of distance that a radian away from the usual posture is worth
_SAMPLES = 2048


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The objects as seen from above: middle, half widths, the camera; metres."""

    middle: Float[np.ndarray, "2"]
    points: Float[np.ndarray, "n 3"]
    table: float
    camera: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, m: "VPrismMap") -> "Surroundings":
        """Measure the labelled points of a map; of one without objects, the middle of the table.

        Raises:
            PlanningError: the world is not z up, so nothing can be placed on the table.
        """
        normal = m.plane.normal
        if normal[2] < 0.9:
            raise PlanningError(
                f"the table's normal is {np.round(normal, 3).tolist()} in this map, but a base is "
                "placed for a world with z up; give --base-xyz, or a view without a camera pose"
            )
        points = m.shown()
        low, high = np.percentile(points, [1.0, 99.0], axis=0)
        middle = 0.5 * (low + high)[:2]
        table = (m.plane.offset - float(normal[:2] @ middle)) / float(normal[2])
        return cls(middle, points, table, m.views[0].camera_center)

    def half_width(self, direction: Float[np.ndarray, "2"]) -> float:
        """Return how far the objects reach from their middle along a direction, metres."""
        return float(np.percentile(np.abs((self.points[:, :2] - self.middle) @ direction), 99.0))

    def base_pose(self, xyz: Any, yaw: float | None = None) -> Float[np.ndarray, "4 4"]:
        """Return the pose of an upright base, which faces the objects unless yaw is given."""
        if yaw is None:
            ahead = self.middle - np.asarray(xyz)[:2]
            yaw = float(np.arctan2(ahead[1], ahead[0]))
        c, s = np.cos(yaw), np.sin(yaw)
        pose = np.eye(4)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:3, 3] = xyz
        return pose


def candidate_bases(
    robot: "Robot", around: Surroundings, yaw: float | None = None
) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Yield places beside the objects, most sensible first."""
    towards = around.camera[:2] - around.middle
    bearing = float(np.arctan2(towards[1], towards[0])) if np.linalg.norm(towards) > 0.05 else 0.0
    # The bound on reach adds up links that cannot all be stretched at once.
    reach = min(robot.reach, 1.1)
    for turn in _BEARINGS:
        direction = np.array([np.cos(bearing + turn), np.sin(bearing + turn)])
        for share in _SHARES_OF_REACH:
            distance = max(share * reach, around.half_width(direction) + 0.2)
            xy = around.middle + distance * direction
            yield around.base_pose([*xy, around.table], yaw)


def read_robot(command: Command, **options: Any) -> "Robot":
    """Return the robot of a command's options; `options` as of `Robot.from_urdf` go before."""
    from vprism_plan.robots import Robot

    named = {name: getattr(command, name) for name in ("srdf", "spheres", "group", "package_dirs")}
    return Robot.from_urdf(command.robot, **named | options)


def places(
    command: Command, robot: "Robot", world: "World", around: Surroundings
) -> Iterator[tuple[int, "Robot"]]:
    """Yield the robot on the base that was given, else on the free ones of the candidates, each
    with its number among these."""
    if command.base_xyz is not None:
        yield 0, robot.with_base_pose(around.base_pose(command.base_xyz, command.base_yaw))
        return
    fixed = np.asarray(robot.fixed_links)[np.asarray(robot.sphere_links)]
    for number, pose in enumerate(candidate_bases(robot, around, command.base_yaw)):
        placed = robot.with_base_pose(pose)
        # The links that never move must keep clear of everything but the table.
        centers = placed.sphere_centers(robot.neutral[None])[0][fixed]
        if not fixed.any() or (world.field.lower_bound(centers) > robot.sphere_radii[fixed]).all():
            yield number, placed


def standing(command: Command, robot: "Robot", world: "World") -> "Robot":
    """Return the robot on the base that was given, else on the first free place."""
    for _, placed in places(command, robot, world, Surroundings.of(world.map)):
        return placed
    raise PlanningError("no free place for the base beside the objects; give --base-xyz")


def choose_ends(
    checker: "CollisionChecker",
    around: Surroundings,
    rng: np.random.Generator,
    *,
    start: Any = None,
    goal: Any = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return start and goal; what is None is chosen on the other side of the objects.

    A given start or goal is kept as it is, valid or not: that verdict is the planner's. What is
    chosen takes, if it can, a quarter of the checker's bound on risk: the way needs the rest.
    None if nothing valid was found for what is open.
    """
    from vprism_plan.viz import hand_path

    robot = checker.robot
    careful = None if checker.max_risk is None else checker.tightened(2)
    ahead = around.middle - robot.base_pose[:2, 3]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    aside = np.array([-ahead[1], ahead[0]])
    away = around.half_width(aside) + _ASIDE
    # Low enough that what stands between must be crossed, not flown over.
    height = around.table + 0.10 + 0.2 * (float(around.points[:, 2].max()) - around.table)
    right, left = (np.array([*(around.middle + s * away * aside), height]) for s in (-1.0, 1.0))
    leftward = left - right
    leftward = leftward / np.linalg.norm(leftward)
    middle = np.array([*around.middle, 0.0])

    def side_of(end: np.ndarray) -> float:
        at = end[:3, 3] if end.shape == (4, 4) else hand_path(robot, end[None])[0]
        return 1.0 if (at - middle) @ leftward > 0 else -1.0

    def reach(sign: float, like: np.ndarray) -> np.ndarray | None:
        target, edge = left if sign > 0 else right, around.half_width(leftward[:2])
        outward = sign * leftward
        for judge in filter(None, (careful, checker)):
            q = _reach_for(judge, target, lambda p: (p - middle) @ outward > edge, like, rng)
            if q is not None:
                return q
        return None

    first = None if start is None else np.asarray(start, dtype=np.float64)
    last = None if goal is None else np.asarray(goal, dtype=np.float64)
    if first is None:
        like = robot.neutral if last is None or last.ndim != 1 else last
        first = reach(-1.0 if last is None else -side_of(last), like)
    if first is not None and last is None:
        last = reach(-side_of(first), first)
    return None if first is None or last is None else (first, last)


def _reach_for(
    checker: "CollisionChecker",
    target: Float[np.ndarray, "3"],
    beyond: Callable[[np.ndarray], np.ndarray],
    like: Float[np.ndarray, "dof"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "dof"] | None:
    """Return a valid configuration with the hand near `target` (metres), or None.

    Samples around the posture `like`, then around the best ones, and prefers postures
    that resemble it. `beyond` says of hand positions (n, 3) which are on the right side.
    """
    from vprism_plan.viz import hand_path

    robot = checker.robot
    span = robot.upper - robot.lower
    best = np.asarray(like)[None]
    found, score, near = None, np.inf, False
    for spread in (0.12, 0.12, 0.06, 0.03, 0.01):
        seeds = best[rng.integers(len(best), size=_SAMPLES)]
        sample = seeds + spread * span * rng.standard_normal(seeds.shape)
        sample = np.concatenate([best, np.clip(sample, robot.lower, robot.upper)])
        hand = hand_path(robot, sample)
        cost = np.linalg.norm(hand - target, axis=1)
        cost += _ODDNESS * np.linalg.norm(sample - like, axis=1)
        cost[~checker.is_valid_batch(sample)] += 10.0
        cost[~beyond(hand)] += 10.0
        order = np.argsort(cost, kind="stable")
        best = sample[order[:16]]
        if cost[order[0]] < min(score, 10.0):
            found, score = best[0], float(cost[order[0]])
            near = bool(np.linalg.norm(hand[order[0]] - target) < _ACCEPT)
    return found if near else None
