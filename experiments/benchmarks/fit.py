# SPDX-License-Identifier: BSD-3-Clause
"""How much faster is the sparse EM than the textbook's dense one?

    python -m experiments.benchmarks.fit [--objects 8] [--iterations 3] [--seed 0]

Both learn from the same points, hinge points and prior, with the same number of
iterations, in one run, each with all cores. The textbook is written for speed in torch
float32: dense features, one GEMM per class for the Gram matrix, one Cholesky, one GEMM
for the quadratic forms. Ours works in float64.
"""

import argparse
import dataclasses
import resource
import time

import numpy as np
import torch

from vprism_plan._threads import worker_count
from vprism_plan.mapping import MapConfig
from vprism_plan.mapping.em import fit_weights, prior_means, weight_prior, weight_variances
from vprism_plan.mapping.features import FeatureSpace, block_features, sorted_hinges
from vprism_plan.mapping.fitting import TrainingData, new_hinges, training_data
from vprism_plan.perception import fit_plane
from vprism_plan.simulation.scenes import random_scene


def dense_em(
    data: TrainingData, space: FeatureSpace, config: MapConfig, classes: int, iterations: int
) -> torch.Tensor:
    """Algorithm 1 with dense float32 matrices; returns the means (K, M)."""
    points = torch.from_numpy(data.points).float()
    hinges = torch.from_numpy(space.hinges).float()
    phi = torch.exp(-space.gamma * torch.cdist(points, hinges) ** 2)
    phi = torch.cat([phi, torch.ones(len(points), 1)], dim=1)
    y = torch.nn.functional.one_hot(torch.from_numpy(data.classes), classes).float()
    prior = (1.0 / torch.from_numpy(weight_variances(space, config))).float()
    prior_mean = torch.zeros(classes, space.size)
    prior_mean[0, :-1], prior_mean[0, -1] = prior_means(config, classes)
    xi, alpha = torch.ones(len(points), classes), torch.zeros(len(points), 1)
    mean = torch.empty(classes, space.size)
    variance = torch.empty(len(points), classes)
    for _ in range(iterations):
        weight = (torch.sigmoid(xi) - 0.5) / (2.0 * xi)
        linear = y - 0.5 + 2.0 * alpha * weight
        for k in range(classes):
            precision = (phi * (2.0 * weight[:, k : k + 1])).T @ phi
            precision.diagonal().add_(prior)
            factor = torch.linalg.cholesky(precision)
            information = prior * prior_mean[k] + phi.T @ linear[:, k]
            mean[k] = torch.cholesky_solve(information[:, None], factor)[:, 0]
            variance[:, k] = ((phi @ torch.cholesky_inverse(factor)) * phi).sum(dim=1)
        m = phi @ mean.T
        for _ in range(config.variational_updates):
            weight = (torch.sigmoid(xi) - 0.5) / (2.0 * xi)
            top = 0.5 * (0.5 * classes - 1.0) + (weight * m).sum(dim=1, keepdim=True)
            alpha = top / weight.sum(dim=1, keepdim=True)
            xi = torch.sqrt(variance + (m - alpha) ** 2).clamp_min(1e-4)
    return mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    config = dataclasses.replace(MapConfig(), iterations=args.iterations, tolerance=0.0)
    obs = random_scene(args.objects, args.seed).observation
    rng = np.random.default_rng(args.seed)
    plane = fit_plane(obs)
    data = training_data([obs], obs.object_ids, plane, config, rng)
    hinges = sorted_hinges(new_hinges(data, (obs,), plane, config, rng))
    classes = len(obs.object_ids) + 1
    print(
        f"{classes - 1} objects, {len(data.points)} points, {len(hinges)} hinge points", flush=True
    )
    torch.set_num_threads(worker_count())
    # Far kernel values underflow; left denormal they would slow the dense side tenfold.
    torch.set_flush_denormal(True)

    def ours(iterations: int) -> np.ndarray:
        space = FeatureSpace(hinges, config.gamma, config.cutoff_radius)
        posterior = fit_weights(
            block_features(space, data.points), data.classes,
            weight_prior(space, config, classes),
            iterations=iterations, variational_updates=config.variational_updates,
        )  # fmt: skip
        return posterior.mean.T

    ours(1)  # compiles, or loads what was compiled before
    start = time.perf_counter()
    mean = ours(args.iterations)
    sparse_time = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"sparse float64: {sparse_time:.2f} s (peak memory of the process {peak:.2f} GiB)",
        flush=True,
    )
    start = time.perf_counter()
    space = FeatureSpace(hinges, config.gamma, config.cutoff_radius)
    reference = dense_em(data, space, config, classes, args.iterations).numpy()
    dense_time = time.perf_counter() - start
    difference = np.abs(mean - reference).max() / np.abs(mean).max()
    print(f"dense float32:  {dense_time:.2f} s (weights differ by {difference:.1e} at most)")
    print(f"ratio: {dense_time / sparse_time:.1f} x (target: at least 10)")


if __name__ == "__main__":
    main()
