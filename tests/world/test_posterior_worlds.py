# SPDX-License-Identifier: BSD-3-Clause
"""Posterior worlds against their definition: every draw evaluated at every voxel asked about."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from oracles.risk_oracle import DrawnVoxels, ball_touches
from oracles.small_scenes import at, small_camera, small_config, small_map, small_scene
from oracles.worlds_oracle import draw_logits, draw_owners, owners_of

import vprism_plan as vp
from vprism_plan.errors import WorldError
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import sphere
from vprism_plan.world.posterior_worlds import PosteriorWorlds

H = 0.01
S = 64

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def small():
    return small_map()


@pytest.fixture(scope="module")
def one_ball_map():
    alone = Scene((sphere(0.04, at(0.03, -0.02, 0.04)),), (1,), small_camera())
    return vp.fit_map(alone.observation, small_config(), seed=0)


@pytest.fixture(scope="module")
def paper_map():
    return vp.fit_map(small_scene().observation, vp.MapConfig.paper(), seed=0)


@pytest.fixture(scope="module", params=["small", "one_ball_map", "paper_map", "demo_map"])
def some_map(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def worlds(small):
    return PosteriorWorlds(small, n_worlds=S, seed=5, resolution=H, reach=0.15, tolerance=0.0)


@pytest.fixture(scope="module")
def drawn(small):
    """The definition, at any voxel of the small map."""
    return DrawnVoxels(small, S, 5, H)


def support_voxels(map_):
    lower, upper = map_.support_bounds()
    first = np.ceil(lower / H).astype(int)
    shape = tuple(np.floor(upper / H).astype(int) - first + 1)
    return np.indices(shape).reshape(3, -1).T + first


def random_voxels(map_, rng, n):
    """Half of them in the support, half near hinges; of a large map only around two places."""
    lower, upper = map_.support_bounds()
    anywhere = rng.uniform(lower, upper, (4000, 3))
    near = rng.choice(map_.space.hinges, 4000) + rng.normal(scale=0.03, size=(4000, 3))
    if len(map_.space.hinges) > 500:
        places = map_.space.hinges[:: len(map_.space.hinges) // 2][:2]
        anywhere, near = (
            p[(np.abs(p[:, None] - places).max(axis=2) < 0.09).any(axis=1)]
            for p in (anywhere, near)
        )
    chosen = np.concatenate([anywhere[: n // 2], near[: n // 2]])
    return np.unique(np.round(chosen / H).astype(int), axis=0)


def balls_near(map_, rng, n, largest):
    centers = rng.choice(map_.space.hinges, n) + rng.normal(scale=0.05, size=(n, 3))
    return centers, rng.uniform(0.0, largest, n)


# --- who owns a voxel ---------------------------------------------------------------------
def test_owners_are_those_of_the_definition(some_map):
    """With nothing skipped, every bit of every draw, on maps of several kinds."""
    rng = np.random.default_rng(3)
    index = random_voxels(some_map, rng, 400)
    worlds = PosteriorWorlds(some_map, n_worlds=S, seed=9, resolution=H, tolerance=0.0)
    expected = draw_owners(some_map, H * index, S, 9)
    lower, upper = some_map.support_bounds()
    supported = ((lower <= H * index) & (H * index <= upper)).all(axis=1)
    ours = worlds.owners(index)
    assert ours.dtype == np.uint8
    np.testing.assert_array_equal(ours[supported], expected[supported])
    assert not ours[~supported].any()
    assert 0.01 < (expected > 0).mean() < 0.9  # the case is not trivial


def test_the_order_of_asking_does_not_matter(small):
    rng = np.random.default_rng(0)
    index = random_voxels(small, rng, 800)
    at_once = PosteriorWorlds(small, n_worlds=S, seed=1)
    one_by_one = PosteriorWorlds(small, n_worlds=S, seed=1)
    shuffled = rng.permutation(len(index))
    pieces = [one_by_one.owners(index[i : i + 1]) for i in shuffled]
    np.testing.assert_array_equal(at_once.owners(index)[shuffled], np.concatenate(pieces))


def test_a_seed_repeats_itself_and_another_differs(small):
    index = random_voxels(small, np.random.default_rng(0), 800)
    first, again, other = (
        PosteriorWorlds(small, n_worlds=S, seed=seed).owners(index) for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    redrawn = PosteriorWorlds(small, n_worlds=S, seed=4).redrawn(5)
    np.testing.assert_array_equal(redrawn.owners(index), other)


def test_redrawing_leaves_the_original_alone(small):
    index = random_voxels(small, np.random.default_rng(0), 300)
    centers, radii = balls_near(small, np.random.default_rng(1), 60, 0.05)
    fresh = PosteriorWorlds(small, n_worlds=S, seed=4)
    used = PosteriorWorlds(small, n_worlds=S, seed=4)
    used.touched(centers, radii, without=small.object_ids[:1])
    before = used.owners(index)
    other = used.redrawn(77)
    new = PosteriorWorlds(small, n_worlds=S, seed=77)
    for without in ((), small.object_ids[:1]):
        np.testing.assert_array_equal(
            other.touched(centers, radii, without), new.touched(centers, radii, without)
        )
        np.testing.assert_array_equal(
            used.touched(centers, radii, without), fresh.touched(centers, radii, without)
        )
    np.testing.assert_array_equal(used.owners(index), before)


def test_draws_agree_with_predictions(demo_map):
    """If features change and the draws do not, or predictions and not the draws, this fails."""
    rng = np.random.default_rng(8)
    index = random_voxels(demo_map, rng, 900)
    predicted = demo_map.occupancy(H * index)
    n = 512
    z = draw_logits(demo_map, H * index, n, 2, thresholds=False)
    e = np.exp(z - z.max(axis=2, keepdims=True))
    # The draws' mean of the softmax is the prediction, up to the map's closed form for it.
    mean = 1.0 - (e[:, :, 0] / e.sum(axis=2)).mean(axis=1)
    assert np.abs(mean - predicted).mean() < 0.02
    assert np.abs(mean - predicted).max() < 0.2
    # How often a voxel is occupied is what its logits' mean and variance say: both are
    # shares of n draws, so their difference has a known spread.
    moments = demo_map.logit_moments(H * index)
    m, v = (a[:, None] for a in moments)
    fresh = m + np.sqrt(v) * rng.standard_normal((len(index), n, demo_map.n_classes))
    informed = demo_map.informed(H * index)
    assert 0.2 < informed.mean() < 0.98
    fresh[informed, :, 1:] += rng.logistic(size=(informed.sum(), n, demo_map.n_classes - 1))
    share, expected = (
        np.mean(o > 0, axis=1)
        for o in (PosteriorWorlds(demo_map, n, seed=2).owners(index), owners_of(fresh))
    )
    p = 0.5 * (share + expected)
    spread = np.sqrt(2.0 * p * (1.0 - p) / n + 1.0 / n**2)
    assert np.abs((share - expected) / spread).max() < 5.0
    # Where a prior has looked, that is the probability itself: a draw's own threshold decides.
    assert np.abs(share - predicted)[informed].max() < 0.12
    assert np.abs(share - predicted)[informed & (predicted > 0.1) & (predicted < 0.9)].mean() < 0.03
    assert np.mean(((share - expected) / spread)[(p > 0.05) & (p < 0.95)] ** 2) < 2.0
    # The most frequent owner is the class that the map finds likeliest.
    sure = predicted > 0.8
    assert sure.sum() > 10
    likeliest = 1 + demo_map.predict_proba(H * index[sure])[:, 1:].argmax(axis=1)
    counts = [(owners_of(z[sure]) == k).sum(axis=1) for k in range(1, demo_map.n_classes)]
    assert np.mean(likeliest == 1 + np.argmax(counts, axis=0)) > 0.95


# --- what is skipped ----------------------------------------------------------------------
def test_skipping_certain_voxels_errs_as_rarely_as_stated(small):
    """Of all draws of all seeds, those that differ anywhere are as few as the bounds say."""
    index = support_voxels(small)
    wrong_free = wrong_occupied = draws = 0
    for seed in range(3):
        skipping = PosteriorWorlds(small, 512, seed, tolerance=0.1)
        whole = PosteriorWorlds(small, 512, seed, tolerance=0.0)
        assert whole.error_free == whole.error_occupied == 0.0
        assert 0.0 < skipping.error_free <= 0.05
        assert 0.0 <= skipping.error_occupied <= 0.05
        assert len(skipping._owners.voxels) < len(whole._owners.voxels)
        free = np.zeros(512, bool)
        occupied = np.zeros(512, bool)
        for part in np.array_split(index, 20):
            a, b = skipping.owners(part), whole.owners(part)
            free |= ((a == 0) & (b > 0)).any(axis=0)
            occupied |= ((a > 0) & (a != b)).any(axis=0)
        wrong_free += int(free.sum())
        wrong_occupied += int(occupied.sum())
        draws += 512
    for wrong, bound in (
        (wrong_free, skipping.error_free),
        (wrong_occupied, skipping.error_occupied),
    ):
        # Four standard deviations above a count that the bound would explain.
        assert wrong <= draws * bound + 4.0 * np.sqrt(draws * bound) + 1.0


def test_the_default_tolerance_changes_next_to_nothing(demo_map):
    index = random_voxels(demo_map, np.random.default_rng(5), 500)
    skipping = PosteriorWorlds(demo_map, S, 0)
    assert skipping.error_free <= 5e-4
    assert skipping.error_occupied <= 5e-4
    whole = draw_owners(demo_map, H * index, S, 0)
    assert (skipping.owners(index) != whole).any(axis=0).sum() <= 1


# --- balls --------------------------------------------------------------------------------
@settings(max_examples=8)
@given(seeds)
def test_touching_is_what_it_is_defined_to_be(worlds, drawn, seed):
    rng = np.random.default_rng(seed)
    ids = worlds.map.object_ids
    gone = [i for i in ids if rng.random() < 0.4]
    classes = [ids.index(i) + 1 for i in gone]
    centers, radii = balls_near(worlds.map, rng, 6, 0.07)
    ours = worlds.touched(centers, radii, gone)
    for center, radius, mine in zip(centers, radii, ours, strict=True):
        exact = ball_touches(drawn, center, radius, H, classes)
        np.testing.assert_array_equal(mine, exact)


def test_a_voxel_centre_on_the_sphere_counts(small):
    """Balls around voxel centres with radii of whole voxels: rounding must not lose the rim."""
    worlds = PosteriorWorlds(small, S, 0, tolerance=0.0, reach=0.31)
    index = support_voxels(small)
    occupied = worlds.owners(index) > 0
    rim = index[(occupied.any(axis=1)) & ~(occupied.all(axis=1))]
    rng = np.random.default_rng(0)
    for steps in range(1, 28):
        for voxel in rng.choice(rim, 3):
            offset = np.zeros(3, int)
            offset[rng.integers(3)] = steps * rng.choice([-1, 1])
            center = H * (voxel + offset)
            hit = worlds.touched(center[None], H * steps)[0]
            assert not (worlds.owners(voxel[None])[0].astype(bool) & ~hit).any(), steps


def test_without_every_object_nothing_is_touched(worlds):
    centers, radii = balls_near(worlds.map, np.random.default_rng(0), 200, 0.1)
    everything = worlds.map.object_ids
    assert worlds.touched(centers, radii).any()
    assert not worlds.touched(centers, radii, everything).any()
    each = [
        worlds.touched(centers, radii, [i for i in everything if i != kept]) for kept in everything
    ]
    whole = worlds.touched(centers, radii)
    assert not (np.any(each, axis=0) & ~whole).any()
    # Nodes of one cell may blame different objects, for which no single object answers.
    assert (whole & ~np.any(each, axis=0)).mean() < 0.001


def test_larger_balls_touch_more(worlds):
    centers, radii = balls_near(worlds.map, np.random.default_rng(1), 300, 0.09)
    small, large = (worlds.touched(centers, r) for r in (radii, radii + 0.01))
    assert not (small & ~large).any()
    assert (large & ~small).any()


def test_balls_far_from_everything_touch_nothing(worlds):
    far = np.array([[5.0, 0.0, 0.0], [0.0, -1e6, 0.0], [0.0, 0.0, 1e30]])
    assert not worlds.touched(far, 0.1).any()
    assert worlds.touched(np.zeros((0, 3)), 0.1).shape == (0, S)


# --- baking -------------------------------------------------------------------------------
def test_lazy_baking_is_eager_baking(small):
    rng = np.random.default_rng(2)
    centers, radii = balls_near(small, rng, 150, 0.08)
    lower, upper = small.support_bounds()
    lazy, eager, region = (PosteriorWorlds(small, S, 3, reach=0.12) for _ in range(3))
    eager.bake()
    held = eager.nbytes
    region.bake(0.5 * (lower + upper), upper)
    for gone in ((), small.object_ids[:1]):
        answers = np.concatenate(
            [lazy.touched(c[None], r, gone) for c, r in zip(centers, radii, strict=True)]
        )
        np.testing.assert_array_equal(answers, eager.touched(centers, radii, gone))
        np.testing.assert_array_equal(answers, region.touched(centers, radii, gone))
        if not gone:
            assert eager.nbytes == held  # nothing was left to bake


def test_nbytes_is_about_what_is_held(small):
    worlds = PosteriorWorlds(small, S, 3, reach=0.12)
    before = worlds.nbytes
    worlds.bake()
    tables = worlds.tables
    expected = tables.rows.size + 8 * tables.distance_row.size + 2 * worlds._owners.table.size
    assert before < worlds.nbytes
    assert worlds.nbytes == pytest.approx(expected, rel=0.5)
    assert str(worlds.nbytes) in repr(worlds)
    # As stated: 4 bytes per voxel of the table, 2 S per drawn voxel and S per baked voxel.
    baked = (tables.distance_row >= 0).sum()
    assert tables.rows.shape == (baked, S)


def test_threads_that_ask_at_once_get_what_one_gets(small):
    rng = np.random.default_rng(6)
    centers, radii = balls_near(small, rng, 120, 0.08)
    ids = small.object_ids
    alone = PosteriorWorlds(small, S, 3, reach=0.12)
    expected = {gone: alone.touched(centers, radii, gone) for gone in ((), (ids[0],), (ids[1],))}
    shared = PosteriorWorlds(small, S, 3, reach=0.12)
    failures = []

    def ask(number):
        order = np.random.default_rng(number).permutation(len(centers))
        for i in order:
            for gone, answer in expected.items():
                mine = shared.touched(centers[i : i + 1], radii[i : i + 1], gone)
                if (mine != answer[i]).any():
                    failures.append((number, i, gone))

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


# --- wrong input ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("numbers", "named"),
    [
        ({"n_worlds": 0}, "n_worlds is 0"),
        ({"n_worlds": 100}, "multiple of 64"),
        ({"n_worlds": -64}, "n_worlds is -64"),
        ({"resolution": 0.0}, "resolution is 0"),
        ({"resolution": float("nan")}, "resolution is nan"),
        ({"reach": 0.01}, "reach is 0.01"),
        ({"reach": 0.4}, "coarser resolution"),
        ({"reach": float("nan")}, "reach is nan"),
        ({"tolerance": -0.1}, "tolerance is -0.1"),
        ({"tolerance": 0.5}, "tolerance is 0.5"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"resolution": 0.0005, "reach": 0.01}, "coarser resolution"),
    ],
)
def test_wrong_numbers_are_refused_by_name(one_ball_map, numbers, named):
    with pytest.raises(WorldError, match=named):
        PosteriorWorlds(one_ball_map, **numbers)


def test_wrong_questions_are_refused_by_name(worlds):
    ask = worlds
    point = np.zeros((1, 3))
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(WorldError, match="finite"):
            ask.touched(np.array([[0.0, bad, 0.0]]), 0.01)
        with pytest.raises(WorldError, match="radii must be finite"):
            ask.touched(point, bad)
    with pytest.raises(WorldError, match="at least 0"):
        ask.touched(point, -0.01)
    with pytest.raises(WorldError, match="beyond reach") as caught:
        ask.touched(point, 0.2)
    assert "0.230" in str(caught.value)  # the remedy: a reach that would do
    with pytest.raises(WorldError, match="no object 99"):
        ask.touched(point, 0.01, without=[99])
    for index in (np.zeros((2, 2), int), np.zeros((2, 3)), np.zeros(3, int)):
        with pytest.raises((WorldError, TypeCheckError), match=r"integers|Int"):
            ask.owners(index)
    assert ask.owners(np.zeros((0, 3), int)).shape == (0, S)


def test_the_remedy_for_a_short_reach_works(small):
    for radius in (0.05, 0.1, 0.15):
        short = PosteriorWorlds(small, S, 0, reach=0.04)
        with pytest.raises(WorldError, match="reach of at least") as caught:
            short.touched(np.zeros((1, 3)), radius)
        stated = float(str(caught.value).split("at least ")[1].split(" m")[0])
        PosteriorWorlds(small, S, 0, reach=stated).touched(np.zeros((1, 3)), radius)


def test_the_level_counts_all_objects_together():
    """Two objects that share a voxel occupy it although neither beats emptiness alone."""
    logits = np.array([[[0.0, -0.1, -0.2], [0.0, -2.0, -2.0], [0.0, -1.0, 0.3]]])
    np.testing.assert_array_equal(owners_of(logits)[0], [1, 0, 2])
    from vprism_plan._kernels.risk import classify

    out, odds = np.empty(3, np.uint8), np.empty(3, np.int8)
    classify(logits[0].T.astype(np.float32), out, odds)
    np.testing.assert_array_equal(out, [1, 0, 2])
    np.testing.assert_array_equal(odds, [7, -16, 6])
