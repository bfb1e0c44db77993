# SPDX-License-Identifier: BSD-3-Clause
"""What a fitted map answers."""

import numpy as np
import pytest
import torch
from oracles import dense_em

from vprism_plan.errors import MapError
from vprism_plan.mapping.factors import dense

QUESTIONS = ("predict_proba", "occupancy", "entropy", "support")


def dense_posterior(fitted):
    sigma = np.zeros((fitted.n_classes, fitted.space.size, fitted.space.size))
    for matrix, own in zip(sigma, fitted.posterior.classes, strict=True):
        matrix[np.ix_(own.members, own.members)] = dense(own.space, own.covariance)
    return fitted.posterior.mean.T, sigma


def test_rows_sum_to_one(small_map, query):
    proba = small_map.predict_proba(query)
    assert proba.shape == (len(query), small_map.n_classes)
    assert np.abs(proba.sum(axis=1) - 1.0).max() < 1e-9
    assert (proba >= 0).all()


def test_agrees_with_per_point_textbook_prediction(small_map, query):
    space = small_map.space
    phi = dense_em.features(query[:200], space.hinges, space.gamma, space.radius)
    expected = dense_em.predict(phi, *dense_posterior(small_map))
    np.testing.assert_allclose(small_map.predict_proba(query[:200]), expected, atol=1e-9)
    np.testing.assert_allclose(small_map.support(query[:200]), phi[:, :-1].sum(1), atol=1e-12)


def test_the_questions_are_consistent(small_map, query):
    proba = small_map.predict_proba(query)
    np.testing.assert_allclose(small_map.occupancy(query), 1.0 - proba[:, 0], atol=1e-12)
    np.testing.assert_allclose(
        small_map.entropy(query), -(proba * np.log(proba + 1e-300)).sum(1), atol=1e-9
    )
    odds = small_map.occupancy_log_odds(query)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-odds)), small_map.occupancy(query), atol=1e-12)
    assert np.abs(odds).max() <= 40.0
    assert (small_map.entropy(query) <= np.log(small_map.n_classes) + 1e-12).all()


def test_a_batch_is_the_loop_bit_for_bit(small_map, query):
    mean, variance = small_map.logit_moments(query)
    for row in range(0, len(query), 7):
        one_mean, one_variance = small_map.logit_moments(query[row : row + 1])
        np.testing.assert_array_equal(mean[row], one_mean[0])
        np.testing.assert_array_equal(variance[row], one_variance[0])


def test_threads_do_not_change_a_bit(small_map, query, monkeypatch):
    many = np.tile(query, (30, 1)) + np.random.default_rng(0).normal(
        scale=1e-3, size=(30 * len(query), 3)
    )
    answers = []
    for threads in ("1", "4"):
        monkeypatch.setenv("VPRISM_PLAN_THREADS", threads)
        answers.append(small_map.occupancy_log_odds(many))
    np.testing.assert_array_equal(*answers)


def test_support_is_zero_outside_its_bounds(small_map):
    lower, upper = small_map.support_bounds()
    rng = np.random.default_rng(1)
    points = rng.uniform(lower - 0.5, upper + 0.5, (3000, 3))
    outside = ((points < lower) | (points > upper)).any(axis=1)
    assert (small_map.support(points[outside]) == 0).all()
    np.testing.assert_allclose(
        small_map.occupancy(points[outside]), small_map.unsupported_occupancy, atol=1e-12
    )


def test_nothing_seen_means_the_prior_occupancy(small_map):
    """The pinned bias: out of reach the map says what it was told, not what it averaged."""
    far = small_map.occupancy(np.array([[9.0, 9.0, 9.0]]))[0]
    assert far == pytest.approx(small_map.config.prior_occupancy, abs=1e-3)
    assert small_map.unsupported_occupancy == pytest.approx(far, abs=1e-14)


@pytest.mark.parametrize("name", QUESTIONS)
def test_torch_in_torch_out(small_map, query, name):
    ask = getattr(small_map, name)
    expected = ask(query)
    assert isinstance(expected, np.ndarray)
    assert expected.dtype == np.float64
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-3)):
        answer = ask(torch.from_numpy(query).to(dtype))
        assert answer.dtype == dtype
        np.testing.assert_allclose(answer.numpy(), expected, atol=tolerance)
    answer = ask(torch.from_numpy(query).requires_grad_())
    assert answer.requires_grad
    np.testing.assert_allclose(answer.detach().numpy(), expected, atol=1e-10)


@pytest.mark.parametrize("name", QUESTIONS)
def test_gradients(small_map, name):
    rng = np.random.default_rng(3)
    hinges = small_map.space.hinges
    near = hinges[rng.integers(0, len(hinges), 12)] + rng.normal(scale=0.03, size=(12, 3))
    points = torch.from_numpy(near).requires_grad_()
    # A smaller step than 1e-6 finds rounding; a larger one, features that jump at the cutoff.
    assert torch.autograd.gradcheck(getattr(small_map, name), (points,), eps=1e-7, atol=2e-5)


def test_a_second_derivative_is_refused_not_wrong(small_map):
    points = torch.from_numpy(small_map.space.hinges[:3] + 0.01).requires_grad_()
    (first,) = torch.autograd.grad(small_map.occupancy(points).sum(), points, create_graph=True)
    with pytest.raises(MapError, match="second derivatives"):
        torch.autograd.grad(first.sum(), points)


@pytest.mark.parametrize("name", QUESTIONS)
def test_the_path_for_other_devices_is_equal(small_map, query, name, monkeypatch):
    """The plain-torch path, run here on the CPU, with its gradient."""
    ask = getattr(small_map, name)
    points = torch.from_numpy(query[:100]).requires_grad_()
    ours = ask(points)
    (slope,) = torch.autograd.grad(ours.sum(), points)
    monkeypatch.setattr(
        "vprism_plan.mapping.prediction.LogitMoments.apply",
        lambda x, *_: small_map._dense_moments(x),
    )
    plain = ask(points)
    (plain_slope,) = torch.autograd.grad(plain.sum(), points)
    np.testing.assert_allclose(plain.detach(), ours.detach(), atol=1e-10)
    np.testing.assert_allclose(plain_slope, slope, atol=1e-8)


def test_no_points_give_no_answers(small_map):
    assert small_map.predict_proba(np.zeros((0, 3))).shape == (0, small_map.n_classes)
    assert small_map.occupancy_log_odds(np.zeros((0, 3))).shape == (0,)
    assert small_map.occupancy(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize(
    "points",
    [
        np.array([[0.0, np.nan, 0.0]]), np.array([[0.0, np.inf, 0.0]]), np.zeros(3),
        np.zeros((2, 2)), np.zeros((1, 2, 3)), "here", torch.tensor([[float("nan"), 0, 0]]),
        torch.zeros(3), torch.zeros(2, 3, dtype=torch.int64),
    ],
)  # fmt: skip
def test_unusable_points_are_refused(small_map, points):
    with pytest.raises(MapError):
        small_map.occupancy(points)


def test_nan_is_refused_everywhere(small_map):
    bad = np.full((1, 3), np.nan)
    for ask in (small_map.logit_moments, small_map.occupancy_log_odds, small_map.support):
        with pytest.raises(MapError, match="finite"):
            ask(bad)


def test_prediction_is_near_monte_carlo(small_map, query):
    """Daunizeau's approximation, normalised, against 4000 draws of the softmax."""
    inside = query[small_map.support(query) > 0.3][:150]
    mean, variance = small_map.logit_moments(inside)
    noise = np.random.default_rng(0).standard_normal((4000, *mean.shape))
    logits = mean + np.sqrt(variance) * noise
    softmax = np.exp(logits - logits.max(2, keepdims=True))
    expected = (softmax / softmax.sum(2, keepdims=True)).mean(0)
    error = np.abs(small_map.predict_proba(inside) - expected)
    assert error.max() < 0.12
    assert error.mean() < 0.02


def test_weight_draws_have_the_posterior_moments(small_map):
    draws = small_map.sample_weights(4000, seed=3)
    _, sigma = dense_posterior(small_map)
    assert draws.shape == (4000, small_map.space.size, small_map.n_classes)
    point = small_map.space.hinges[:40] + 0.005
    phi = dense_em.features(
        point, small_map.space.hinges, small_map.space.gamma, small_map.space.radius
    )
    logits = np.einsum("nm,smk->snk", phi, draws)
    m, v = small_map.logit_moments(point)
    spread = np.sqrt(v)
    assert (np.abs(logits.mean(0) - m) < 5.0 * spread / np.sqrt(4000)).all()
    assert (np.abs(logits.std(0) / spread - 1.0) < 0.08).all()
    # Jointly: the correlation of two near points, not just their variances.
    expected = np.einsum("i,kij,j->k", phi[0], sigma, phi[1]) / (spread[0] * spread[1])
    found = ((logits[:, 0] - m[0]) * (logits[:, 1] - m[1])).mean(0) / (spread[0] * spread[1])
    np.testing.assert_allclose(found, expected, atol=0.08)
    np.testing.assert_array_equal(draws[:5], small_map.sample_weights(4000, seed=3)[:5])
    with pytest.raises(MapError):
        small_map.sample_weights(0, seed=0)
