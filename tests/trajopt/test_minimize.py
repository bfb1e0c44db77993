# SPDX-License-Identifier: BSD-3-Clause
"""The batched minimisers against scipy's, one problem at a time."""

import time

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vprism_plan.trajopt._minimize import REASONS, Limits, adam, lbfgs

MINIMISERS = {"lbfgs": lbfgs, "adam": adam}


def with_gradient(function):
    def evaluate(x, rows):
        x = x.detach().requires_grad_()
        value = function(x, rows)
        (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient

    return evaluate


def rosenbrock(x, rows):
    a, b = x[:, :-1], x[:, 1:]
    return (100.0 * (b - a.square()).square() + (1.0 - a).square()).sum(dim=1)


def hinges(x, rows):
    return (x - 1.0).clamp(min=0.0).sum(dim=1) + 0.1 * (x - 3.0).square().sum(dim=1)


def scipys(evaluate, row, k):
    def one(v):
        value, gradient = evaluate(torch.from_numpy(v)[None], torch.tensor([k]))
        return float(value), gradient[0].numpy()

    return scipy.optimize.minimize(
        one, row.numpy(), jac=True, method="L-BFGS-B", options={"maxiter": 3000, "maxfun": 9000}
    )


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(2, 9))
def test_quadratics_of_any_shape_end_at_their_minimum(seed, count, n):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, n, n))
    A = torch.from_numpy(A @ A.transpose(0, 2, 1) + np.eye(n))
    b = torch.from_numpy(rng.normal(size=(count, n)))

    def bowl(x, rows):
        return 0.5 * torch.einsum("bi,bij,bj->b", x, A[rows], x) - (b[rows] * x).sum(dim=1)

    start = torch.from_numpy(rng.normal(size=(count, n)))
    found = lbfgs(with_gradient(bowl), start, Limits(200, 1e-11))
    best = torch.linalg.solve(A, b[..., None])[..., 0]
    least = -0.5 * (b * best).sum(dim=1)
    assert torch.allclose(found.value, least, rtol=1e-6, atol=1e-8)


def test_rosenbrock_is_as_quick_as_scipys_and_each_row_for_itself():
    rng = np.random.default_rng(1)
    evaluate = with_gradient(rosenbrock)
    start = torch.from_numpy(rng.normal(size=(5, 12)))
    looked: list[list[float]] = [[] for _ in start]

    def counted(x, rows):
        value, gradient = evaluate(x, rows)
        for k, v in zip(rows.tolist(), value.tolist(), strict=True):
            looked[k].append(v)
        return value, gradient

    found = lbfgs(counted, start, Limits(3000, 1e-10))
    for k, row in enumerate(start):
        reference = scipys(evaluate, row, k)
        there = [n for n, v in enumerate(looked[k]) if v <= reference.fun + 1e-8]
        assert there[0] < 1.5 * reference.nfev + 10
        alone = lbfgs(evaluate, row[None], Limits(3000, 1e-10))
        assert torch.allclose(alone.x[0], found.x[k], atol=1e-8)
    assert len({len(values) for values in looked}) > 1, (
        "rows that are done are not asked about again"
    )


@pytest.mark.parametrize("method", MINIMISERS)
def test_kinks_are_no_obstacle(method):
    start = torch.from_numpy(np.random.default_rng(2).normal(size=(4, 6)) + 2.0)
    found = MINIMISERS[method](with_gradient(hinges), start, Limits(500, 1e-9))
    least = hinges(torch.ones(1, 6, dtype=torch.float64), None)
    assert torch.allclose(found.value, least.expand(4), rtol=5e-3)


@pytest.mark.parametrize("method", MINIMISERS)
def test_what_is_returned_is_the_best_that_was_seen(method):
    seen = torch.full((3,), np.inf, dtype=torch.float64)
    inner = with_gradient(rosenbrock)

    def watched(x, rows):
        value, gradient = inner(x, rows)
        seen[rows] = torch.minimum(seen[rows], value)
        return value, gradient

    start = torch.from_numpy(np.random.default_rng(3).normal(size=(3, 5)))
    found = MINIMISERS[method](watched, start, Limits(30, 1e-12))
    assert torch.equal(found.value, inner(found.x, torch.arange(3))[0])
    assert (found.value <= seen * (1.0 + 1e-3)).all()
    assert [REASONS[k] for k in found.reason] == ["iterations"] * 3
    assert (found.iterations <= 30).all()


@pytest.mark.parametrize("method", MINIMISERS)
def test_values_that_are_not_finite_are_stepped_back_from(method):
    """-log has a wall at 0 behind which nothing is defined."""

    def walled(x, rows):
        return (x - x.log()).sum(dim=1)

    start = torch.full((2, 3), 0.05, dtype=torch.float64)
    found = MINIMISERS[method](with_gradient(walled), start, Limits(420, 1e-9))
    assert torch.isfinite(found.value).all()
    assert torch.allclose(found.x, torch.ones_like(start), atol=2e-2)


@pytest.mark.parametrize("method", MINIMISERS)
def test_a_flat_start_is_an_end_and_time_is_kept(method):
    evaluate = with_gradient(lambda x, rows: 0.0 * x.sum(dim=1))
    found = MINIMISERS[method](evaluate, torch.ones(2, 3), Limits(50, 1e-6))
    assert [REASONS[k] for k in found.reason] == ["converged"] * 2
    assert torch.equal(found.x, torch.ones(2, 3))
    limits = Limits(50, 1e-6, deadline=time.perf_counter() - 1.0)
    late = MINIMISERS[method](with_gradient(rosenbrock), torch.zeros(2, 3), limits)
    assert [REASONS[k] for k in late.reason] == ["time"] * 2
