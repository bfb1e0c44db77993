# SPDX-License-Identifier: BSD-3-Clause
"""Guides RRTstar and its kin along a path that is known already.

The bindings let nobody replace the sampler of a state space. But these planners ask their
goal for samples all along, with probability `goalBias`, and take the answers as states to
grow towards. So the goal first hands out a known path, state by state, which makes that path
the planner's first solution, and afterwards states around the best path so far.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from ompl import base as ob

from vprism_plan.planning._spaces import StateReader, write_state
from vprism_plan.planning.ompl_adapter import nearest_turns

_BIAS = 0.5  # share of the samples that come from here
_FINEST, _WIDEST = 0.01, 0.5  # spread of samples around a path, as a share of the step
_LEAD_PART = 0.1  # of the planner's step, between states of the lead: see `lead`
_MANY = 2**31 - 1


class GuidedGoal(ob.GoalSampleableRegion):
    """Several goal configurations, and samples that lead there.

    The tree reaches a goal by growing exactly to it; the last state of the lead is one.
    `sampleGoal` hands the lead out once, then only states around the best path: of goals the
    tree would collect copies.

    Args:
        si: the space information.
        goals: (g, dof).
        seed: of the samples.
        step: how far the planner grows at once, in the metric of the space.
    """

    def __init__(self, si: Any, goals: Float[np.ndarray, "g dof"], seed: int, step: float) -> None:
        super().__init__(si)
        self.setThreshold(1e-9)
        self._space = si.getStateSpace()
        self._reader = StateReader(self._space, goals.shape[1])
        self._wraps = np.array(self._reader.wraps)
        self._goals = goals
        self._rng = np.random.default_rng([seed, 0x601D])
        self._step = step
        self._queue: list[np.ndarray] = []
        self._path: np.ndarray | None = None

    def lead(self, path: Float[np.ndarray, "t dof"]) -> None:
        """Hand out the states of a path, start left out, then states around it.

        The tree grows to each from its nearest node, which near a thin obstacle may be one on
        the other side: states much closer together than a step leave the last one nearest.
        """
        pieces = [path[:1]]
        for a, b in pairwise(path):
            # The distance of a compound space is at most sqrt(dof) times the Euclidean one.
            width = float(np.abs(b - a).sum() if self._wraps.any() else np.linalg.norm(b - a))
            n = max(1, int(np.ceil(width / (_LEAD_PART * self._step))))
            pieces.append(a + (b - a) * (np.arange(1, n + 1)[:, None] / n))
        self._queue = list(np.concatenate(pieces)[:0:-1])
        self._path = path

    def follow(self, path: Float[np.ndarray, "t dof"]) -> None:
        """Sample around another path from now on."""
        self._path = path

    def distanceGoal(self, state: Any) -> float:  # noqa: N802 - OMPL's name
        """Return the distance to the nearest goal, largest over the joints."""
        q = self._reader.read(state)
        gap = np.abs(nearest_turns(self._goals, q, self._wraps) - q)
        return float(gap.max(axis=1).min())

    def maxSampleCount(self) -> int:  # noqa: N802 - OMPL's name
        """Return a number that is never reached, so that samples are asked for all along."""
        return _MANY

    def sampleGoal(self, state: Any) -> None:  # noqa: N802 - OMPL's name
        """Write the next state to grow towards."""
        if self._queue:
            q = self._queue.pop()
        else:
            assert self._path is not None, "lead() comes first"
            q = self._around(self._path)
        write_state(self._space, q, state)
        self._space.enforceBounds(state)  # OMPL takes a goal's samples as they are

    def _around(self, path: Float[np.ndarray, "t dof"]) -> Float[np.ndarray, " dof"]:
        """Return a state near a random place of a path."""
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        place = self._rng.uniform(0.0, float(lengths.sum()))
        edge = min(int(np.searchsorted(np.cumsum(lengths), place)), len(lengths) - 1)
        t = self._rng.uniform()
        q = path[edge] + t * (path[edge + 1] - path[edge])
        spread = self._step * np.exp(self._rng.uniform(np.log(_FINEST), np.log(_WIDEST)))
        return q + self._rng.normal(size=q.shape) * spread / np.sqrt(len(q))


def guide(planner: Any) -> None:
    """Let a planner ask its goal for half of its samples."""
    planner.setGoalBias(_BIAS)
