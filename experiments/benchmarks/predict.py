# SPDX-License-Identifier: BSD-3-Clause
"""How much faster is a prediction from kept factors than one that solves per call?

    python -m experiments.benchmarks.predict [--objects 8] [--seed 0]

The other side keeps the posterior precision and solves it for every call, dense, in
torch float32 with all cores. Both are asked the same points in calls of the same size:
points of a 1 cm grid in and around the objects, as meshes, slices and the baked field
ask them, and points strewn at random, which share nothing and are the worst case.
"""

import argparse
import math
import time

import numpy as np
import torch

from vprism_plan._threads import worker_count
from vprism_plan.mapping import VPrismMap, fit_map
from vprism_plan.mapping.factors import dense
from vprism_plan.simulation.scenes import random_scene


class DenseSolves:
    """Prediction with a dense solve per call and class, over the weights that the class has."""

    def __init__(self, fitted: VPrismMap) -> None:
        classes = fitted.posterior.classes
        self.members = [torch.from_numpy(own.members) for own in classes]
        self.precision = [
            torch.from_numpy(dense(own.space, own.precision)).float() for own in classes
        ]
        self.mean = torch.from_numpy(fitted.posterior.mean).float()
        self.hinges, self.gamma = fitted.hinge_points.float(), fitted.space.gamma
        self.prior = fitted.prior

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        phi = torch.exp(-self.gamma * torch.cdist(points, self.hinges) ** 2)
        phi = torch.cat([phi, torch.ones(len(points), 1)], dim=1)
        m = phi @ self.mean
        if self.prior is not None:
            m += torch.from_numpy(self.prior.at(points.double().numpy())).float()
        own = [phi[:, members].T for members in self.members]
        solved = [torch.linalg.solve(a, b) for a, b in zip(self.precision, own, strict=True)]
        variance = [(b * s).sum(dim=0) for b, s in zip(own, solved, strict=True)]
        v = torch.stack(variance, dim=1)
        spread = torch.sqrt(1.0 + math.pi / 8.0 * (v[:, None, :] + v[:, :, None]))
        gap = m[:, None, :] - m[:, :, None]
        return torch.softmax(-torch.logsumexp(gap / spread, dim=2), dim=1)


def seconds_per_point(ask, points, size: int, calls: int) -> float:
    ask(points[:size])
    time.sleep(0.5)  # threads of whoever was asked before spin for a while
    start = time.perf_counter()
    for call in range(calls):
        ask(points[call * size : (call + 1) * size])
    return (time.perf_counter() - start) / (calls * size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(worker_count())
    torch.set_flush_denormal(True)  # fair to the dense side, whose kernel values underflow
    fitted = fit_map(random_scene(args.objects, args.seed).observation)
    print(f"{args.objects} objects, {len(fitted.hinge_points)} hinge points")
    lower, upper = fitted.support_bounds()
    axes = [np.arange(a, b, 0.01) for a, b in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[fitted.support(grid) > 0.1]
    rng = np.random.default_rng(args.seed)
    strewn = rng.permutation(rng.uniform(-0.005, 0.005, grid.shape) + grid)
    dense = DenseSolves(fitted)
    reference = dense(torch.from_numpy(strewn[:500]).float()).numpy()
    error = np.abs(reference - fitted.predict_proba(strewn[:500]))
    print(f"largest difference between the two: {float(error.max()):.1e}")
    for name, points in (("grid", grid), ("strewn", strewn)):
        single = torch.from_numpy(points).float()
        for size in (1000, 10_000):
            slow = seconds_per_point(dense, single, size, max(1, 4000 // size))
            fast = seconds_per_point(fitted.predict_proba, points, size, max(5, 50_000 // size))
            print(
                f"{name}, calls of {size} points: dense solves {slow * 1e6:.0f} us per point, "
                f"ours {fast * 1e6:.2f} us: {slow / fast:.0f} x",
                flush=True,
            )
    start = time.perf_counter()
    fitted.occupancy_log_odds(grid)
    each = (time.perf_counter() - start) / len(grid)
    print(f"bake of the whole grid: {len(grid)} points, {each * 1e6:.2f} us per point")
    print("target: at least 50 x on the grid")


if __name__ == "__main__":
    main()
