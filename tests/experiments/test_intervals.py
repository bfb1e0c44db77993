# SPDX-License-Identifier: BSD-3-Clause
"""Figures over scenes: what a draw of scenes says is what those scenes together say."""

import math

import numpy as np
import pytest

from experiments.metrics import Reliability
from experiments.reconstruction import ObjectScore, ReconstructionScores
from experiments.tables import claims, intervals
from experiments.tables.claims import Claim, decide
from experiments.tables.intervals import Estimate, SceneScores, estimate
from vprism_plan.errors import ConfigError


def made_up(rng, shift=0.0, objects=None):
    """Scores of one scene: some objects, one of them lost now and then, some points."""
    count = int(rng.integers(1, 6)) if objects is None else objects
    found = tuple(
        ObjectScore(
            k, 100, int(40 + rng.integers(0, 30) + 100 * shift), 100,
            math.nan if rng.random() < 0.15 else float(rng.uniform(0.01, 0.03)),
        )
        for k in range(count)
    )  # fmt: skip
    parts = []
    for n in (40, 30, 5, 0):
        p = rng.random(n)
        parts.append(Reliability.of(p, rng.random(n) < p**2))
    return ReconstructionScores(found, 1, tuple(parts), tuple(rng.random(4)))


@pytest.fixture(scope="module")
def scenes():
    rng = np.random.default_rng(5)
    return [made_up(rng) for _ in range(25)]


@pytest.mark.parametrize("draw", range(4))
def test_every_statistic_of_a_draw_is_that_of_those_scenes_merged(draw, scenes):
    """The vectorised sums against the plain dataclasses, scenes drawn twice included."""
    scores, rng = SceneScores(scenes), np.random.default_rng(draw)
    drawn = np.arange(25) if draw == 0 else rng.integers(0, 25, 25)
    together = ReconstructionScores.merged([scenes[i] for i in drawn])
    assert scores.iou()(drawn) == pytest.approx(together.mean_iou)
    assert scores.chamfer()(drawn) == pytest.approx(together.mean_chamfer)
    for parts in ((0,), (1,), (2, 3)):
        table = Reliability.merged([together.parts[k] for k in parts])
        assert scores.brier(parts)(drawn) == pytest.approx(table.brier)
        assert scores.ece(parts)(drawn) == pytest.approx(table.ece)
        assert scores.entropy(parts)(drawn) == pytest.approx(together.mean_entropy(*parts))
    both = np.stack([drawn, drawn[::-1]])
    for statistic in (scores.iou(), scores.chamfer(), scores.ece((0, 1))):
        assert statistic(both) == pytest.approx(np.full(2, statistic(drawn)))
    assert np.isnan(scores.brier((3,))(drawn))


def test_chamfer_is_compared_on_the_objects_that_both_find():
    def one(*chamfers):
        found = tuple(ObjectScore(k, 1, 1, 2, c) for k, c in enumerate(chamfers))
        empty = Reliability.of(np.zeros(0), np.zeros(0, bool))
        return SceneScores([ReconstructionScores(found, 0, (empty,) * 4, (0.0,) * 4)])

    a, b = one(0.01, 0.05, math.nan), one(0.02, math.nan, 0.1)
    assert claims.gain(a, b, "chamfer")(np.array([0])) == pytest.approx(0.5)
    assert a.chamfer()(np.array([0])) == pytest.approx(0.03)


def test_an_interval_is_as_wide_as_theory_says_and_repeats():
    values = np.random.default_rng(0).normal(2.0, 1.0, 300)
    statistic = intervals.ratio(values, np.ones(300))
    found = estimate(statistic, 300, seed=1)
    half = 1.96 * values.std() / math.sqrt(300)
    assert found.value == pytest.approx(values.mean())
    assert found.high - found.value == pytest.approx(half, rel=0.1)
    assert found.value - found.low == pytest.approx(half, rel=0.1)
    assert estimate(statistic, 300, seed=1) == found
    assert estimate(statistic, 300, seed=2) != found


def test_a_single_scene_has_no_interval_and_none_has_no_figure():
    one = estimate(intervals.ratio(np.array([3.0]), np.array([2.0])), 1)
    assert one.value == 1.5
    assert math.isnan(one.low)
    assert one.to_dict() == {"value": 1.5, "low": None, "high": None}
    assert str(Estimate.from_dict(one.to_dict())) == str(one)
    with pytest.raises(ConfigError, match="no scenes"):
        SceneScores([])
    with pytest.raises(ConfigError, match=r"parts is \[4\]"):
        SceneScores([made_up(np.random.default_rng(0))]).brier((4,))


@pytest.fixture(scope="module")
def three():
    """A method, one that is 0.2 better in every scene, and one that differs by chance."""
    draws = [np.random.default_rng([7, s]).bit_generator.state for s in range(30)]

    def all_of(shift, salt):
        scenes = []
        for number, state in enumerate(draws):
            rng = np.random.default_rng([7, number])
            rng.bit_generator.state = state
            if salt:
                rng = np.random.default_rng([salt, number])
            scenes.append(made_up(rng, shift, objects=4))
        return SceneScores(scenes)

    return {"a": all_of(0.0, 0), "better": all_of(0.2, 0), "chance": all_of(0.0, 9)}


@pytest.mark.parametrize(
    ("pairs", "least", "answer", "value"),
    [
        ((("better", "a"),), 0.0, "yes", 0.2),
        ((("better", "a"),), 0.19, "yes", 0.2),
        ((("better", "a"),), 0.21, "no", 0.2),
        ((("a", "better"),), 0.0, "no", -0.2),
        ((("better", "a"), ("a", "better")), 0.0, "no", -0.2),
    ],
)
def test_a_claim_holds_if_its_weakest_pair_does(pairs, least, answer, value, three):
    verdict = decide(Claim("t", pairs, "iou", least=least), three)
    assert verdict.answer == answer
    assert verdict.gain.value == pytest.approx(value)
    assert verdict.gain.low == pytest.approx(value)  # the same gain in every scene
    assert verdict.pair == pairs[-1]


def test_chance_decides_nothing(three):
    verdicts = [
        decide(Claim("t", (pair,), "brier", "visible"), three).answer
        for pair in (("a", "chance"), ("chance", "a"))
    ]
    assert sorted(verdicts) == ["not in the mean", "yes in the mean"]
    one = {k: SceneScores(v.scenes[:1]) for k, v in three.items()}
    assert decide(Claim("t", (("better", "a"),), "iou"), one).answer == "yes in the mean"
    lost = ReconstructionScores(
        (ObjectScore(1, 1, 0, 1, math.nan),), 0, one["a"].scenes[0].parts, (0.0,) * 4
    )
    nothing = {"a": SceneScores([lost] * 3), "b": SceneScores([lost] * 3)}
    assert decide(Claim("t", (("a", "b"),), "chamfer"), nothing).answer == "undefined"


def test_claims_name_only_methods_that_ran():
    every = claims.claims_of("presets", ("vprism", "vprism-paper", "vprism-fine"))
    without = claims.claims_of("presets", ("vprism", "vprism-paper"))
    assert set(without) < set(every)
    assert claims.claims_of("sampling", ("vprism-paper",)) == ()
    found = claims.claims_of("baselines", ("voxel", "sgd", "vprism-paper"))
    assert all(better == "vprism-paper" for claim in found for better, _ in claim.pairs)
    assert {worse for claim in found for _, worse in claim.pairs} == {"voxel", "sgd"}


def test_the_pair_that_gains_least_in_the_mean_spoke_for_all(three):
    """A pair of a larger but less sure gain hid behind one of a small and sure gain."""

    def shifted(shifts):
        return SceneScores(
            [
                made_up(np.random.default_rng([7, n]), shift, objects=4)
                for n, shift in enumerate(shifts)
            ]
        )

    spread = 0.15 * np.repeat([1.0, -1.0], 15)
    scores = {
        "best": shifted(np.full(30, 0.2)),
        "near": shifted(np.full(30, 0.17)),  # by 0.03 in every scene
        "far": shifted(0.2 - 0.04 - spread),  # by 0.04 in the mean, by chance in each scene
    }
    sure, unsure = ("best", "near"), ("best", "far")
    each = [decide(Claim("t", (pair,), "iou"), scores) for pair in (sure, unsure)]
    assert [one.answer for one in each] == ["yes", "yes in the mean"]
    assert each[0].gain.value < each[1].gain.value
    both = decide(Claim("t", (sure, unsure), "iou"), scores)
    assert (both.answer, both.pair, both.gain) == ("yes in the mean", unsure, each[1].gain)
    # One pair to the contrary refutes the claim, whatever gains less in the mean.
    wild = {**scores, "above": shifted(np.full(30, 0.21)), "all": shifted(0.25 - 2 * spread)}
    found = decide(Claim("t", (("best", "all"), ("best", "above")), "iou"), wild)
    assert (found.answer, found.pair) == ("no", ("best", "above"))
    assert found.gain.value > decide(Claim("t", (("best", "all"),), "iou"), wild).gain.value


def test_voxels_of_a_scene_passed_for_independent_cases():
    """Scenes that are right or wrong as a whole: as many cases as scenes, not as voxels."""
    rng = np.random.default_rng(3)
    truth = rng.random(40) < 0.3
    tables = [Reliability.of(np.full(500, 0.25), np.full(500, bool(y))) for y in truth]
    (naive,) = Reliability.merged(tables).rows()
    (row,) = intervals.over_scenes(tables)
    half = 1.96 * math.sqrt(truth.mean() * (1.0 - truth.mean()) / 40)
    assert naive.high - naive.low < 0.2 * half
    assert row.observed - row.low == pytest.approx(half, rel=0.25)
    assert row.high - row.observed == pytest.approx(half, rel=0.25)
    assert (row.count, row.predicted, row.observed) == (20000, 0.25, truth.mean())
    # Independent cases, none of which happened: the bootstrap alone would be sure of it.
    never = [Reliability.of(np.full(5, 0.05), np.zeros(5, bool)) for _ in range(10)]
    assert intervals.over_scenes(never) == Reliability.merged(never).rows()
    # A bin that one scene has: many a draw leaves it empty.
    one = [*never, Reliability.of(np.full(4, 0.95), np.ones(4, bool))]
    assert intervals.over_scenes(one)[1] == Reliability.merged(one).rows()[1]
