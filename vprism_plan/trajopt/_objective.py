# SPDX-License-Identifier: BSD-3-Clause
"""What the optimiser minimises: a user's cost of whole trajectories, in smooth coordinates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from vprism_plan.trajopt._seeds import smooth_basis
from vprism_plan.trajopt.result import History

_WIDTH = 4  # waypoints around a refused edge whose cost counts again


@dataclass
class Emphasis:
    """What repairs add to the cost of each seed.

    Attributes:
        guard: cost of coming too near to something.
        weight: (S,) of the whole trajectory's.
        edge: (S,) an edge that was refused; its surroundings count again.
        edge_weight: (S,) of theirs.
    """

    guard: Any
    weight: torch.Tensor
    edge: torch.Tensor
    edge_weight: torch.Tensor


class Objective:
    """Cost and gradient of trajectories given by coordinates z of their inner waypoints.

    The inner waypoints are those of the seed plus B z, with B from the inverse of the
    smoothness metric: a step along the gradient in z moves the trajectory smoothly, which
    is CHOMP's covariant gradient (Ratliff and others 2009) as a change of variables. The
    ends are not variables.

    Args:
        cost: any module (k, T, dof) -> (k,); if it has `terms`, they enter the history.
        begun: (S, T, dof) the seeds.
        order: of the smoothness metric.
    """

    def __init__(self, cost: Any, begun: Float[np.ndarray, "s t dof"], order: int = 1) -> None:
        self.cost = cost
        self.emphasis: Emphasis | None = None
        self.evaluations = 0
        self._base = torch.from_numpy(begun)
        self._basis = torch.from_numpy(smooth_basis(begun.shape[1] - 2, order))
        self._inner = begun.shape[1] - 2, begun.shape[2]
        self._best = torch.full((len(begun),), math.inf, dtype=torch.float64)
        self._terms: dict[str, np.ndarray] = {}
        self._rows: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = []
        self._round = -1

    @property
    def origin(self) -> torch.Tensor:
        """Coordinates (S, n) of the seeds."""
        return torch.zeros(len(self._base), self._inner[0] * self._inner[1], dtype=torch.float64)

    def trajectories(self, z: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Coordinates (k, n) of seeds (k,) to waypoints (k, T, dof)."""
        base = self._base[rows]
        inner = base[:, 1:-1] + self._basis @ z.reshape(-1, *self._inner)
        return torch.cat([base[:, :1], inner, base[:, -1:]], dim=1)

    def begin_round(self, emphasis: Emphasis | None) -> None:
        """Change what is minimised; the history starts anew."""
        self.emphasis = emphasis
        self._best.fill_(math.inf)
        self._round += 1

    def __call__(self, z: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return costs (k,) and their gradients (k, n)."""
        z = z.detach().requires_grad_()
        q = self.trajectories(z, rows)
        terms = self._named(q, rows)
        total = torch.stack(list(terms.values())).sum(dim=0)
        (gradient,) = torch.autograd.grad(total.sum(), z)
        total = total.detach()
        self.evaluations += len(rows)
        self._note(rows, total, terms)
        return total, gradient

    def values(self, q: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return costs (k,) of waypoints (k, T, dof), seeds (k,) with their emphasis."""
        with torch.no_grad():
            return torch.stack(list(self._named(q, rows).values())).sum(dim=0)

    def _named(self, q: torch.Tensor, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        terms = getattr(self.cost, "terms", None)
        named = dict(terms(q)) if callable(terms) else {"cost": self.cost(q)}
        emphasis = self.emphasis
        if emphasis is not None and emphasis.guard is not None:
            near = torch.clamp(emphasis.edge[rows] - _WIDTH // 2 + 1, 0, q.shape[1] - _WIDTH)
            window = near[:, None] + torch.arange(_WIDTH)
            around = q[torch.arange(len(rows))[:, None], window]
            named["repair"] = emphasis.weight[rows] * emphasis.guard(q) + (
                emphasis.edge_weight[rows] * emphasis.guard(around)
            )
        return named

    def _note(
        self, rows: torch.Tensor, total: torch.Tensor, terms: dict[str, torch.Tensor]
    ) -> None:
        better = total < self._best[rows]
        at = rows[better]
        self._best[at] = total[better]
        for name, values in terms.items():
            column = self._terms.setdefault(name, np.zeros(len(self._best)))
            column[at.numpy()] = values.detach()[better].numpy()
        copies = {name: values.copy() for name, values in self._terms.items()}
        self._rows.append((self._round, self._best.numpy().copy(), copies))

    def history(self) -> History:
        """Return what was noted."""
        names: Sequence[str] = tuple(self._terms)
        count = len(self._best)
        empty = np.zeros(count)
        rounds: Int[np.ndarray, " i"] = np.array([row[0] for row in self._rows], dtype=np.int64)
        return History(
            cost=np.array([row[1] for row in self._rows]).reshape(-1, count),
            terms={
                name: np.array([row[2].get(name, empty) for row in self._rows]).reshape(-1, count)
                for name in names
            },
            round=rounds,
        )
