# SPDX-License-Identifier: BSD-3-Clause
"""The collision checker: a robot's spheres against a world that knows what it has not seen."""

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan._kernels import checking as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.collision import _explain
from vprism_plan.collision._packing import pack_robot, pack_world
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.protocols import BakedWorld, Numbers, SphereRobot
from vprism_plan.collision.reports import MotionReport, StateReport
from vprism_plan.errors import RobotError

_BATCH_CHUNK = 512
_ROUNDING = 1e-9  # metres: gaps below it come from rounding, not from sampling


def interpolate(
    robot: SphereRobot, qa: Float[np.ndarray, "dof"], qb: Float[np.ndarray, "dof"], t: float
) -> Float[np.ndarray, "dof"]:
    """Return the point at fraction t of the straight edge qa -> qb that `check_motion` checks.

    Continuous joints go the short way round, so they may leave [-pi, pi].
    """
    delta = qb - qa
    turns = np.where(robot.continuous, np.round(delta / (2.0 * np.pi)), 0.0)
    return qa + t * (delta - 2.0 * np.pi * turns)


class CollisionChecker:
    """Answers whether configurations and edges of a robot are free of a world.

    A configuration is valid when its joints are within their limits, every collision
    sphere of every moving link keeps more than `config.margin` from the world, and
    every link pair that may collide keeps more than `config.self_margin`. All
    distances are lower bounds, so an error can only refuse. Links that no joint moves
    are not checked against the world: they stand on it.

    Construction compiles the kernels if they are not cached on disk (some twenty seconds,
    once per machine). Safe to share between threads; the kernels release the GIL.
    Single queries cost a microsecond or two of compiled code: O(frames + links), plus
    O(spheres) for the links whose bounding spheres come near something.

    Args:
        world: What to avoid.
        robot: Whose configurations are asked about.
        config: Margins and tolerances.
    """

    def __init__(
        self, world: BakedWorld, robot: SphereRobot, config: CheckerConfig | None = None
    ) -> None:
        self.world = world
        self.robot = robot
        self.config = CheckerConfig() if config is None else config
        packed = pack_robot(robot.arrays, self.config.self_margin)
        baked = pack_world(world, self.config.margin)
        self._rf, self._ri = packed.floats, packed.ints
        self._D, self._E, self._wf = baked.distance, baked.blocks, baked.floats
        self._dof = robot.dof
        self._shape = (robot.dof,)
        self._warm_up()

    def _warm_up(self) -> None:
        """Ask every kernel once, so that none compiles inside a planner's time limit."""
        q = np.zeros(self._dof)
        self.is_valid_batch(q[None])
        self.is_valid_buffer(q)
        self.clearance(q)
        self.check_motion_buffer(q, q)
        self.sphere_clearances(q)
        self.pair_gaps(q)

    def is_valid(self, q: Numbers) -> bool:
        """Return whether a configuration is free.

        Args:
            q: (dof,) joint values, radians or metres, in the order of `robot.joint_names`.

        Returns:
            False also for a configuration that is not finite; ask `explain` why.

        Raises:
            RobotError: q does not have shape (dof,).
        """
        return kernels.is_valid(
            self._configuration(q), self._rf, self._ri, self._D, self._E, self._wf
        )

    def is_valid_buffer(self, q: Float[np.ndarray, "dof"]) -> bool:
        """`is_valid` without looking at the shape: q must be a contiguous float64 (dof,) array.

        The path for planners' inner loops.
        """
        return kernels.is_valid(q, self._rf, self._ri, self._D, self._E, self._wf)

    def is_valid_batch(self, Q: Numbers) -> Bool[np.ndarray, "n"]:
        """Return `is_valid` for each row of Q (n, dof); runs on all worker threads."""
        Q = self._configurations(Q)
        out = np.empty(len(Q), dtype=np.bool_)

        def work(part: slice) -> None:
            kernels.is_valid_batch(
                Q[part], self._rf, self._ri, self._D, self._E, self._wf, out[part]
            )

        run_chunked(work, len(Q), _BATCH_CHUNK)
        return out

    def clearance(self, q: Numbers) -> float:
        """Return a lower bound of the distance from the robot to the world, metres.

        Negative when a sphere reaches into the level set, the table, known geometry or
        whatever else the world's policies make an obstacle. The margin is not
        subtracted, and self-collision and joint limits do not enter.

        Raises:
            RobotError: q does not have shape (dof,) or is not finite.
        """
        q = self._configuration(q)
        if not np.isfinite(q).all():
            raise RobotError(f"configuration is {q.tolist()}; clearance needs finite joint values")
        world, own = np.empty(1), np.empty(1)
        kernels.clearance_batch(q[None], self._rf, self._ri, self._D, self._E, self._wf, world, own)
        return float(world[0])

    def clearance_batch(self, Q: Numbers) -> Float[np.ndarray, "n"]:
        """Return `clearance` for each row of Q (n, dof), metres."""
        return self._clearances(Q)[0]

    def self_clearance_batch(self, Q: Numbers) -> Float[np.ndarray, "n"]:
        """Return the smallest gap between links that may collide, for each row of Q, metres."""
        return self._clearances(Q)[1]

    def check_motion(self, qa: Numbers, qb: Numbers) -> bool:
        """Return whether the straight edge from qa to qb is free, ends included.

        The edge is straight in joint space; continuous joints go the short way round.
        It is covered by conservative advancement on the clearances, with every link's
        displacement bounded from the kinematic chain. Where clearance is so small that
        the steps fall below `config.min_motion`, it samples: an accepted edge is free
        up to `config.tolerance` metres of motion.

        Raises:
            RobotError: An end does not have shape (dof,).
        """
        return self.check_motion_buffer(self._configuration(qa), self._configuration(qb))

    def check_motion_buffer(
        self, qa: Float[np.ndarray, "dof"], qb: Float[np.ndarray, "dof"]
    ) -> bool:
        """`check_motion` for contiguous float64 (dof,) arrays, without looking at shapes."""
        return self._check_motion(qa, qb, np.empty(4))

    def check_motion_report(self, qa: Numbers, qb: Numbers) -> MotionReport:
        """Return the verdict on an edge with its tolerance and, when refused, the reason."""
        qa, qb = self._configuration(qa), self._configuration(qb)
        stats = np.empty(4)
        valid = self._check_motion(qa, qb, stats)
        fraction = None if valid else float(stats[0])
        state = None
        if fraction is not None:
            state = self.explain(interpolate(self.robot, qa, qb, fraction))
        return MotionReport(
            valid=valid,
            certified=valid and bool(stats[2] <= _ROUNDING),
            tolerance=0.5 * float(stats[2]),
            collision_fraction=fraction,
            configurations=int(stats[1]),
            motion_bound=float(stats[3]),
            state=state,
        )

    def explain(self, q: Numbers) -> StateReport:
        """Return the verdict on a configuration with every reason that refuses it.

        Raises:
            RobotError: q does not have shape (dof,).
        """
        return _explain.explain(self, self._configuration(q))

    def sphere_clearances(
        self, q: Float[np.ndarray, "dof"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return each sphere's centre (S, 3) in the world, and what is near it.

        Returns:
            Centres; distance to the nearest half-space and its index in
            `world.planes`; lower bound of the distance to the baked obstacles. Metres.
        """
        n = int(self._ri[1])
        centers, plane, field = np.empty((3, n)), np.empty(n), np.empty(n)
        which = np.empty(n, dtype=np.int64)
        kernels.sphere_clearances(
            q, self._rf, self._ri, self._D, self._E, self._wf, centers, plane, which, field
        )
        return np.ascontiguousarray(centers.T), plane, which, field

    def pair_gaps(self, q: Float[np.ndarray, "dof"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the gap of each of `robot.collision_pairs`, metres, and the spheres (P, 2)."""
        n = int(self._ri[3])
        gaps, spheres = np.empty(n), np.zeros((n, 2), dtype=np.int64)
        kernels.pair_gaps(q, self._rf, self._ri, gaps, spheres)
        return gaps, spheres

    def _check_motion(self, qa: np.ndarray, qb: np.ndarray, stats: np.ndarray) -> bool:
        return kernels.check_motion(
            qa, qb, self._rf, self._ri, self._D, self._E, self._wf, self.config.min_motion, stats
        )

    def _clearances(self, Q: Numbers) -> tuple[np.ndarray, np.ndarray]:
        Q = self._configurations(Q)
        if not np.isfinite(Q).all():
            row = int(np.flatnonzero(~np.isfinite(Q).all(axis=1))[0])
            raise RobotError(
                f"configuration {row} is {Q[row].tolist()}; clearance needs finite joint values"
            )
        world, own = np.empty(len(Q)), np.empty(len(Q))

        def work(part: slice) -> None:
            kernels.clearance_batch(
                Q[part], self._rf, self._ri, self._D, self._E, self._wf, world[part], own[part]
            )

        run_chunked(work, len(Q), _BATCH_CHUNK)
        return world, own

    def _configuration(self, q: Numbers) -> Float[np.ndarray, "dof"]:
        array = np.ascontiguousarray(q, dtype=np.float64)
        if array.shape != self._shape:
            raise RobotError(
                f"configuration has shape {array.shape}; {self.robot.name} needs ({self._dof},): "
                f"{', '.join(self.robot.joint_names)}"
            )
        return array

    def _configurations(self, Q: Numbers) -> Float[np.ndarray, "n dof"]:
        array = np.ascontiguousarray(Q, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != self._dof:
            raise RobotError(
                f"configurations have shape {array.shape}; {self.robot.name} needs "
                f"(n, {self._dof}): {', '.join(self.robot.joint_names)}"
            )
        return array
