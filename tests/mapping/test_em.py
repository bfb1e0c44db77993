# SPDX-License-Identifier: BSD-3-Clause
"""The sparse EM against the dense textbook, and what the mathematics promises."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dense_em

from vprism_plan.errors import MapError
from vprism_plan.mapping.em import bouchard_lambda
from vprism_plan.mapping.factors import dense


def dense_fit(problem, iterations, updates=1, radius=np.inf, offset=None):
    phi = dense_em.features(problem.points, problem.space.hinges, problem.space.gamma, radius)
    prior = np.stack([np.diag(problem.variance)] * problem.classes)
    mean, members = problem.prior_mean.T, problem.members
    return dense_em.fit(phi, problem.labels, mean, prior, iterations, updates, offset, members)


def covariances(posterior):
    """Of all features; 0 where a class has none."""
    size = posterior.classes[0].space.size
    out = np.zeros((len(posterior.classes), size, size))
    for matrix, own in zip(out, posterior.classes, strict=True):
        matrix[np.ix_(own.members, own.members)] = dense(own.space, own.covariance)
    return out


def relative(a, b):
    return np.abs(a - b).max() / np.abs(b).max()


@pytest.mark.parametrize(("classes", "updates"), [(2, 1), (3, 1), (5, 2), (7, 1), (12, 3)])
def test_agrees_with_the_textbook_without_a_cutoff(make, classes, updates):
    problem = make(classes, classes, cutoff=0)
    ours = problem.fit(4, updates)
    theirs = dense_fit(problem, 4, updates)
    assert relative(ours.mean.T, theirs.mean) < 1e-6
    assert relative(covariances(ours), theirs.covariance) < 1e-6
    np.testing.assert_allclose(ours.history, theirs.bounds, rtol=1e-9)


@pytest.mark.parametrize("classes", [2, 5])
def test_agrees_with_the_textbook_around_an_offset(make, classes):
    """What is added to the logits is learned around, as if it were a feature of weight 1."""
    problem = make(classes, classes, cutoff=0)
    offset = np.random.default_rng(classes).normal(scale=3.0, size=(len(problem.points), classes))
    ours = problem.fit(4, 2, offset=offset)
    theirs = dense_fit(problem, 4, 2, offset=offset)
    assert relative(ours.mean.T, theirs.mean) < 1e-6
    np.testing.assert_allclose(ours.history, theirs.bounds, rtol=1e-9)
    assert (np.diff(ours.history) > 0).all()


@pytest.mark.parametrize("cutoff", [0, 1e-5])
def test_classes_with_hinges_of_their_own_agree_with_the_textbook(make, cutoff):
    """The full model with features masked per class: the same posterior, bound and draws."""
    problem = make(5, 4, n=200, hinges=40, cutoff=cutoff)
    rng = np.random.default_rng(0)
    problem.members = rng.random((4, problem.space.size)) < 0.5
    problem.members[0], problem.members[:, -1] = True, True
    problem.members[3, :-1] = False  # a class that no hinge is near: the bias alone
    offset = rng.normal(size=(200, 4))
    ours = problem.fit(4, 2, offset=offset)
    theirs = dense_fit(problem, 4, 2, problem.space.radius, offset)
    masked = np.where(problem.members, theirs.mean, 0.0)
    assert relative(ours.mean.T, masked) < 1e-6
    for own, expected in zip(ours.classes, theirs.covariance, strict=True):
        rows, columns = own.space.pairs.T
        found = own.covariance[own.space.base[rows] + columns]
        wanted = expected[own.members[rows], own.members[columns]]
        assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max()
    np.testing.assert_allclose(ours.history, theirs.bounds, rtol=1e-9)


def test_agrees_with_the_textbook_at_the_same_cutoff(make):
    """Same truncated features: the posterior is the same wherever a query can look."""
    problem = make(4, 4, n=300, hinges=60)
    ours, theirs = problem.fit(3), dense_fit(problem, 3, radius=problem.space.radius)
    assert problem.space.envelope_size < problem.space.size * (problem.space.size + 1) // 2
    assert relative(ours.mean.T, theirs.mean) < 1e-6
    sparse = covariances(ours)
    index = np.arange(problem.space.size)
    stored = index[None, :] >= problem.space.row_first[:, None]
    stored = np.where(index[None, :] <= index[:, None], stored, stored.T)
    assert np.abs(sparse - theirs.covariance)[:, stored].max() < 1e-6 * np.abs(sparse).max()
    # Every pair of hinges that one point can see is in the envelope, so nothing is lost.
    square = ((problem.space.hinges[:, None] - problem.space.hinges[None]) ** 2).sum(2)
    assert stored[:-1, :-1][square < (2 * problem.space.radius) ** 2].all()
    assert stored[-1].all()


@pytest.mark.parametrize("seed", range(3))
def test_effect_of_the_cutoff_is_bounded(make, seed):
    """Dropping features below 1e-5 moves no probability by more than 2e-3."""
    whole, cut = make(seed, 4, n=300, hinges=60, cutoff=0), make(seed, 4, n=300, hinges=60)
    query = np.random.default_rng(seed).uniform(-0.25, 0.25, (200, 3))
    answers = []
    for problem in (whole, cut):
        phi = dense_em.features(
            query, problem.space.hinges, problem.space.gamma, problem.space.radius
        )
        posterior = problem.fit(4)
        sigma = covariances(posterior)
        answers.append(dense_em.predict(phi, posterior.mean.T, sigma))
    assert np.abs(answers[0] - answers[1]).max() < 2e-3


@pytest.mark.slow
@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    classes=st.integers(2, 12),
    updates=st.integers(1, 3),
    scale=st.sampled_from([0.05, 1.0, 300.0]),
)
def test_evidence_bound_never_falls(make, seed, classes, updates, scale):
    problem = make(seed, classes, n=60, hinges=15)
    problem.variance = problem.variance * scale
    history = np.array(problem.fit(6, updates).history)
    assert len(history) >= 2
    assert (np.diff(history) >= -1e-9 * np.abs(history[1:])).all()


@settings(max_examples=60)
@given(
    z=st.lists(st.floats(-30, 30), min_size=2, max_size=12),
    alpha=st.floats(-30, 30),
    seed=st.integers(0, 10**6),
)
def test_bouchard_inequality(z, alpha, seed):
    z = np.array(z)
    xi = np.abs(np.random.default_rng(seed).normal(scale=5.0, size=len(z)))
    left = np.logaddexp.reduce(z)
    assert left <= dense_em.bouchard_right_side(z, alpha, xi) + 1e-9


def test_lambda_and_its_limit():
    xi = np.array([0.0, 1e-12, 1e-6, 0.999e-3, 1.001e-3, 0.5, 3.0, 40.0, 1e4])
    expected = [dense_em.lam(x) if x > 1e-4 else 0.125 for x in xi]
    np.testing.assert_allclose(bouchard_lambda(xi), expected, rtol=1e-7)
    assert bouchard_lambda(np.zeros(1))[0] == 0.125


def test_more_variational_updates_raise_the_bound(make):
    problem = make(11, 5)
    assert problem.fit(3, 4).history[-1] >= problem.fit(3, 1).history[-1]


def test_order_of_points_does_not_matter(make):
    problem = make(2, 4)
    first = problem.fit()
    order = np.random.default_rng(0).permutation(len(problem.points))
    problem.points, problem.labels = problem.points[order], problem.labels[order]
    second = problem.fit()
    np.testing.assert_allclose(second.mean, first.mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(covariances(second), covariances(first), rtol=1e-8, atol=1e-8)


def test_order_of_classes_does_not_matter(make):
    problem = make(3, 5)
    first = problem.fit()
    swap = np.array([3, 0, 4, 1, 2])  # old class -> new class
    problem.labels = swap[problem.labels]
    problem.prior_mean = problem.prior_mean[:, np.argsort(swap)]
    second = problem.fit()
    np.testing.assert_allclose(second.mean[:, swap], first.mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(covariances(second)[swap], covariances(first), rtol=1e-8, atol=1e-8)


def test_number_of_threads_does_not_change_a_bit(make, monkeypatch):
    problem = make(5, 6, n=400, hinges=60)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("VPRISM_PLAN_THREADS", threads)
        results.append(problem.fit())
    np.testing.assert_array_equal(results[0].mean, results[1].mean)
    np.testing.assert_array_equal(covariances(results[0]), covariances(results[1]))


def test_huge_logits_stay_finite(make):
    problem = make(6, 3)
    problem.variance = np.full(problem.space.size, 1e8)
    posterior = problem.fit(20)
    assert np.isfinite(posterior.mean).all()
    assert np.isfinite(posterior.history).all()


def test_a_tolerance_stops_early(make):
    problem = make(7, 3)
    posterior = problem.fit(200, tolerance=1e-3)
    assert 2 <= len(posterior.history) < 100


def test_a_label_that_is_no_class_is_refused(make):
    problem = make(8, 3)
    problem.labels = problem.labels.copy()
    problem.labels[7] = 3
    with pytest.raises(MapError, match=r"0\.\.2"):
        problem.fit()


@settings(max_examples=8)
@given(
    seed=st.integers(0, 10**6), classes=st.integers(2, 8), scale=st.sampled_from([0.05, 1.0, 300.0])
)
def test_longer_steps_never_lower_the_bound(make, seed, classes, scale):
    problem = make(seed, classes, n=40, hinges=10)
    problem.variance = problem.variance * scale
    history = np.array(problem.fit(8, 2, relaxation=1.9).history)
    assert (np.diff(history) >= -1e-9 * np.abs(history[1:])).all()


@pytest.mark.slow
def test_longer_steps_reach_the_same_posterior_sooner(make):
    """Both climb to one optimum; six long steps get farther than ten plain ones."""
    problem = make(2, 4, n=60, hinges=15)
    assert problem.fit(6, relaxation=1.9).history[-1] > problem.fit(10).history[-1]
    problem.variance = np.full(problem.space.size, 0.5)  # a firm prior converges soon
    plain, relaxed = problem.fit(100), problem.fit(50, relaxation=1.9)
    assert relaxed.history[-1] == pytest.approx(plain.history[-1], rel=1e-8)
    np.testing.assert_allclose(relaxed.mean, plain.mean, atol=2e-3)


def test_a_step_that_lowers_the_bound_is_taken_back(make, monkeypatch):
    """One wild step: the history goes on as if it had never been."""
    from vprism_plan.mapping import em

    problem = make(4, 3)
    towards = em._Variational.towards
    wild = [False, True, False, False, False]

    def jump(self, step, factor):
        return towards(self, step, 60.0 if wild.pop(0) else 1.0)

    plain = problem.fit(4).history
    monkeypatch.setattr(em._Variational, "towards", jump)
    assert problem.fit(5, relaxation=1.5).history == pytest.approx(plain, rel=1e-12)
