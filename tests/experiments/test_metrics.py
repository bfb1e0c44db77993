# SPDX-License-Identifier: BSD-3-Clause
"""Scores of probabilities, against their definitions."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import calibration_oracle as oracle

from experiments.metrics import Reliability, object_iou
from vprism_plan.errors import ConfigError

# Multiples of 1/64 lie on no rounding error: a bin's edge is in the same bin on both sides.
CASES = st.lists(st.tuples(st.integers(0, 64), st.booleans()), min_size=1, max_size=60)


@given(cases=CASES, bins=st.sampled_from([1, 2, 4, 8, 16]))
def test_scores_are_those_of_the_definition(cases, bins):
    p, y = [k / 64 for k, _ in cases], [happened for _, happened in cases]
    table = Reliability.of(np.array(p), np.array(y), bins)
    assert table.brier == pytest.approx(oracle.brier(p, y), abs=1e-12)
    assert table.ece == pytest.approx(oracle.ece(p, y, bins), abs=1e-12)
    assert table.n == sum(row.count for row in table.rows()) == len(p)
    assert table.mean_observed == pytest.approx(np.mean(y))
    assert table.mean_predicted == pytest.approx(np.mean(p))


@given(cases=CASES, cut=st.integers(0, 60))
def test_tables_add_up(cases, cut):
    p, y = np.array([k / 64 for k, _ in cases]), np.array([happened for _, happened in cases])
    cut = min(cut, len(p))
    parts = Reliability.merged([Reliability.of(p[:cut], y[:cut]), Reliability.of(p[cut:], y[cut:])])
    whole = Reliability.of(p, y)
    assert (parts.counts, parts.positives) == (whole.counts, whole.positives)
    assert parts.ece == pytest.approx(whole.ece, abs=1e-12)
    assert parts.brier == pytest.approx(whole.brier, abs=1e-12)


def test_a_perfect_and_a_hopeless_forecast():
    y = np.array([True, False, True, True])
    perfect = Reliability.of(y.astype(float), y)
    assert (perfect.ece, perfect.brier) == (0.0, 0.0)
    assert Reliability.of(1.0 - y, y).ece == 1.0


@pytest.mark.parametrize(("k", "n"), [(0, 12), (3, 12), (12, 12)])
def test_intervals_are_clopper_and_pearsons(k, n):
    """At either end the tail beyond what was observed holds 2.5 percent."""
    happened = np.arange(n) < k
    (row,) = Reliability.of(np.full(n, 0.55), happened).rows()
    assert row.low <= row.observed <= row.high
    if k > 0:
        assert oracle.binomial_tail(k, n, row.low) == pytest.approx(0.025, rel=1e-6)
    if k < n:
        assert 1.0 - oracle.binomial_tail(k + 1, n, row.high) == pytest.approx(0.025, rel=1e-6)


def test_a_table_survives_json():
    rng = np.random.default_rng(0)
    table = Reliability.of(rng.random(200), rng.random(200) < 0.3)
    assert Reliability.from_dict(json.loads(json.dumps(table.to_dict()))) == table


def test_nothing_predicted_is_no_number():
    empty = Reliability.of(np.zeros(0), np.zeros(0, bool))
    assert empty.n == 0
    assert math.isnan(empty.brier)
    assert math.isnan(empty.ece)
    assert empty.rows() == ()


@given(points=st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 3)), max_size=40))
def test_iou_is_that_of_sets(points):
    found, true = [a for a, _ in points], [b for _, b in points]
    scores = object_iou(np.array(found, int), np.array(true, int), (1, 2, 3))
    for k, score in scores.items():
        assert score == pytest.approx(oracle.iou(found, true, k), nan_ok=True)


@pytest.mark.parametrize(
    ("p", "y", "bins"),
    [
        ([0.1, 1.2], [True, False], 10),
        ([0.1, math.nan], [True, False], 10),
        ([-0.1], [True], 10),
        ([0.1], [True, False], 10),
        ([0.1], [True], 0),
    ],
)
def test_what_is_no_forecast_is_refused(p, y, bins):
    with pytest.raises(ConfigError):
        Reliability.of(np.array(p), np.array(y), bins)


def test_tables_that_cannot_be_added_are_refused():
    one, other = (Reliability.of(np.array([0.5]), np.array([True]), bins) for bins in (5, 10))
    for tables in ([], [one, other]):
        with pytest.raises(ConfigError):
            Reliability.merged(tables)
