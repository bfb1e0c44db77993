# SPDX-License-Identifier: BSD-3-Clause
"""The relaxed joint risk in plain torch: for other devices, second derivatives and tests."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan.trajopt._draw_field import DrawField
from vprism_plan.trajopt._field import SplineField, spline_weights

_AT_ONCE = 1 << 24  # numbers


def survival_losses(
    centers: Float[Tensor, "m s 3"],
    trajectory: Int[Tensor, " m"],
    count: int,
    rules: Int[np.ndarray, " s"],
    grown: Float[np.ndarray, " s"],
    radii: Float[np.ndarray, " s"],
    draws: DrawField,
    certain: SplineField | None,
    planes: Float[np.ndarray, "p 4"],
    tau: float,
    cut: float,
) -> Float[Tensor, " b"]:
    """Return -ln mean_s 1 / (1 + odds_s) of each trajectory; see `RiskCost`."""
    n_worlds = draws.steps.shape[-1]
    owners: list[Tensor] = []
    depths: list[Tensor] = []
    rows, columns = _near(centers.detach(), rules, grown + cut, draws)
    table = torch.from_numpy(draws.steps.reshape(-1, n_worlds)).to(centers.device)
    step = max(1, _AT_ONCE // (27 * n_worlds))
    for start in range(0, len(rows), step):
        i, s = rows[start : start + step], columns[start : start + step]
        away = _distances(centers[i, s], rules[s.cpu().numpy()], draws, table)
        owners.append(trajectory[i])
        depths.append(torch.as_tensor(grown).to(centers)[s, None] - away)
    if certain is not None:
        gap = certain(centers, rules) - torch.as_tensor(grown).to(centers)
        owners, depths = _with_common(owners, depths, -gap, trajectory, n_worlds)
        for row in torch.as_tensor(planes).to(centers):
            away = centers @ row[:3] - row[3] - torch.as_tensor(radii).to(centers)
            owners, depths = _with_common(owners, depths, -away, trajectory, n_worlds)
    if not owners:
        return (0.0 * centers.sum()).expand(count)
    owner, depth = torch.cat(owners), torch.cat(depths)
    high = depth.new_zeros(count, n_worlds)
    index = owner[:, None].expand(-1, n_worlds)
    high = high.scatter_reduce(0, index, depth.detach() / tau, "amax", include_self=True)
    soft = -torch.expm1(-(depth + cut).clamp(min=0.0) / tau)
    grown_odds = torch.exp(depth / tau - high[owner]) * soft.square()
    odds = torch.zeros_like(high).index_add(0, owner, grown_odds)
    loss = high + torch.log(torch.exp(-high) + odds)
    return -(torch.logsumexp(-loss, dim=1) - float(np.log(n_worlds)))


def _with_common(
    owners: list[Tensor],
    depths: list[Tensor],
    depth: Float[Tensor, "m s"],
    trajectory: Int[Tensor, " m"],
    n_worlds: int,
) -> tuple[list[Tensor], list[Tensor]]:
    """Add contacts that every draw has."""
    flat = depth.reshape(-1, 1).expand(-1, n_worlds)
    owner = trajectory[:, None].expand(depth.shape).reshape(-1)
    return [*owners, owner], [*depths, flat]


def _near(
    centers: Float[Tensor, "m s 3"],
    rules: Int[np.ndarray, " s"],
    enough: Float[np.ndarray, " s"],
    draws: DrawField,
) -> tuple[Tensor, Tensor]:
    """(sample, sphere) where a draw may be near enough to count."""
    grid = torch.as_tensor(draws.grid).to(centers)
    top = torch.tensor(draws.steps.shape[1:4], device=centers.device) - 1
    scaled = (centers - grid[:3]) / grid[3]
    inside = ((scaled >= 0.0) & (scaled <= top)).all(dim=-1)
    rows, columns = inside.nonzero(as_tuple=True)
    block = scaled[rows, columns].long() >> 2
    blocks = torch.from_numpy(draws.blocks).to(centers)
    own = torch.as_tensor(rules, device=centers.device)[columns]
    least = blocks[own, block[:, 0], block[:, 1], block[:, 2]]
    near = least < torch.as_tensor(enough).to(centers)[columns]
    return rows[near], columns[near]


def _distances(
    points: Float[Tensor, "n 3"], rules: Int[np.ndarray, " n"], draws: DrawField, table: Any
) -> Float[Tensor, "n d"]:
    """Spline of every draw's signed distance, metres."""
    grid = torch.as_tensor(draws.grid).to(points)
    sizes = draws.steps.shape[1:4]
    around, weights = spline_weights((points - grid[:3]) / grid[3], sizes)
    first = torch.as_tensor(rules, device=points.device) * int(np.prod(sizes))
    total = points.new_zeros(len(points), draws.steps.shape[-1])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                row = (around[:, 0, i] * sizes[1] + around[:, 1, j]) * sizes[2] + around[:, 2, k]
                share = weights[:, 0, i] * weights[:, 1, j] * weights[:, 2, k]
                total = total + share[:, None] * (draws.unit * table[first + row].to(points))
    return total
