# SPDX-License-Identifier: BSD-3-Clause
"""What motions risk, against slow loops over samples, spheres and worlds."""

from itertools import pairwise

import numpy as np
import pytest
from ompl import base as ob

from vprism_plan._resources import urdf_path
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.errors import PlanningError
from vprism_plan.planning import (
    PoseGoalConfig,
    ReachRegion,
    VPrismRiskObjective,
    plan,
    quiet_ompl,
    state_space,
    to_state,
)
from vprism_plan.planning.goals import solve_region
from vprism_plan.planning.objectives import MotionRisk, RiskObjective
from vprism_plan.robots import Robot


@pytest.fixture(scope="module")
def checker(flat_world):
    """A Panda that stands beside what the map is unsure of, and looks at it."""
    lower, upper = flat_world.map.support_bounds()
    base = np.eye(4)
    base[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    base[:2, 3] = 0.5 * (lower + upper)[:2] - [0.0, 0.55]
    robot = Robot.from_urdf(urdf_path("panda"), base_pose=base)
    return CollisionChecker(flat_world, robot, CheckerConfig(n_worlds=64))


@pytest.fixture(scope="module")
def motions(checker):
    """Short motions in and around uncertain places, and a few anywhere."""
    rng = np.random.default_rng(0)
    risk = MotionRisk(checker, "survival", 0.02)
    worlds = checker.risk_setting().worlds
    owners, _, first = worlds.owner_tables
    places = worlds.resolution * (np.argwhere(owners >= 0) + first)
    unsure: list[np.ndarray] = []
    for place in places[rng.choice(len(places), 12)]:
        region = ReachRegion.sphere(place, 0.12, link="panda_hand")
        few = PoseGoalConfig(attempts=24, iterations=20)
        near = solve_region(checker.robot, region, np.zeros(7), 0, few)
        unsure += [q for q in near if 0.0 < risk.state(q) < 3.0]
    assert len(unsure) >= 4
    pairs = []
    for q in unsure[:8]:
        for size in (0.05, 0.6):
            other = q + rng.normal(size=q.shape) * size
            pairs.append((q, np.clip(other, checker.robot.lower, checker.robot.upper)))
    anywhere = [checker.robot.random_configuration(rng) for _ in range(6)]
    return pairs + list(pairwise(anywhere))


def steps_of(checker, qa, qb, spacing):
    """Samples of a motion, by what bounds the way of every sphere."""
    from vprism_plan.collision.motion import motion_bounds

    way = float(motion_bounds(checker.robot.arrays, (qb - qa)[None])[0][0])
    turned = float(np.abs(qb - qa).sum())
    return max(int(np.ceil(way / spacing)), int(np.ceil(turned / 0.5))), way


def touched(checker, Q):
    """(n, worlds): which worlds the moving spheres touch at each row, exactly."""
    setting = checker.risk_setting()
    moving = np.flatnonzero(setting.sphere_tables >= 0)
    rows = []
    for q in Q:
        centers = np.asarray(checker.sphere_clearances(q)[0])[moving]
        rows.append(setting.worlds.touched(centers, setting.radii[moving]).any(axis=0))
    return np.array(rows)


def test_the_joint_risk_of_a_motion_misses_no_world_and_adds_few(checker, motions):
    risk = MotionRisk(checker, "joint", 0.02)
    excess = []
    for qa, qb in motions:
        t = np.linspace(0.0, 1.0, 30)[:, None]
        exact = touched(checker, qa + t * (qb - qa)).any(axis=0).mean()
        p = -np.expm1(-risk.motion(qa, qb))
        assert p >= min(exact, 1.0 - 0.5 / 64) - 1e-12
        excess.append(p - exact)
    assert np.mean(excess) < 0.1


def test_the_rate_of_survival_bounds_the_marginal(checker, motions):
    risk = MotionRisk(checker, "survival", 0.02)
    for q, _ in motions:
        p = -np.expm1(-risk.state(q))
        assert p >= min(touched(checker, [q]).mean(), 1.0 - 0.5 / 64) - 1e-12


@pytest.mark.parametrize(("kind", "seed"), [("joint", 7), ("entropy", 8)])
def test_an_objective_is_prepared_in_parts_and_bakes_nothing_that_nobody_asks_for(
    flat_world, checker, monkeypatch, kind, seed
):
    """Its first use took ten seconds, whatever the time limit."""

    def baked(*_, **__):
        raise AssertionError("planners check motions by themselves")

    monkeypatch.setattr(type(flat_world), "certain_field", baked)
    config = CheckerConfig(n_worlds=64, risk_seed=seed)  # draws that nobody has asked for
    alone = CollisionChecker(flat_world, checker.robot, config)
    for step in RiskObjective(kind).preparation(alone):
        step()
    monkeypatch.setattr("vprism_plan.world.posterior_worlds.judge", baked)
    cost = RiskObjective(kind).cost(alone)
    cost.edge(np.zeros(7), np.full(7, 0.05))
    worlds = alone.risk_setting().worlds
    before = len(worlds.tables.rows)
    worlds.bake()
    assert len(worlds.tables.rows) > 2 * before


@pytest.mark.parametrize("kind", ["occupancy", "entropy"])
def test_fields_are_read_at_every_sample_that_matters(checker, motions, kind):
    """The stride over free stretches leaves nothing out: sample by sample it is the same."""
    risk = MotionRisk(checker, kind, 0.03)
    seen = 0.0
    for pair in motions:
        qa, qb = sorted(pair, key=lambda q: q.tobytes())
        n, way = steps_of(checker, qa, qb, 0.03)
        rates = np.array([risk.state(qa + k / n * (qb - qa)) for k in range(n + 1)])
        slow = way * (rates.sum() - 0.5 * (rates[0] + rates[-1])) / n
        assert risk.motion(qa, qb) == pytest.approx(slow, rel=1e-9, abs=1e-12)
        assert risk.worst(qa, qb) == pytest.approx(rates.max(), rel=1e-9, abs=1e-12)
        seen += slow
    assert seen > 0.0


def differs(worlds, index):
    """Whether a voxel is one of those that have to be drawn."""
    row, _, first = worlds.owner_tables
    local = index - first
    inside = ((local >= 0) & (local < row.shape)).all(axis=1)
    found = np.zeros(len(index), dtype=bool)
    found[inside] = row[tuple(local[inside].T)] >= len(worlds.map.object_ids)
    return found


@pytest.mark.parametrize("kind", ["occupancy", "entropy"])
def test_rates_are_what_the_map_says_in_the_spheres(checker, motions, kind):
    risk = MotionRisk(checker, kind, 0.02)
    setting, map_ = checker.risk_setting(), checker.world.map
    resolution = setting.worlds.resolution
    moving = np.flatnonzero(setting.sphere_tables >= 0)
    radii = setting.radii[moving]
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T / np.sqrt(3.0)
    points = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3), corners])
    points = points if kind == "occupancy" else 0.8 * points
    for q, _ in motions[:6]:
        centers = np.asarray(checker.sphere_clearances(q)[0])[moving]
        places = centers[:, None] + radii[:, None, None] * points
        voxels = resolution * np.floor(places / resolution + 0.5).reshape(-1, 3)
        if kind == "occupancy":
            values = np.asarray(map_.occupancy(voxels))
            index = np.rint(voxels / resolution).astype(int)
            occupied = setting.worlds.owners(index) > 0
            # What all worlds agree about is settled; about the rest the map is asked.
            rarely = ~occupied.any(axis=1) & (values < 0.5)
            values[rarely] = np.where(differs(setting.worlds, index[rarely]), values[rarely], 0.0)
            expected = values.reshape(len(moving), -1).max(axis=1).sum()
        else:
            values = np.asarray(map_.entropy(voxels))
            values[np.asarray(map_.support(voxels)) < checker.world.config.min_support] = 0.0
            weights = radii**3 / (radii**3).sum()
            expected = weights @ values.reshape(len(moving), -1).mean(axis=1)
        # What is less than a thousandth, or skipped as certain, counts as nothing.
        assert risk.state(q) == pytest.approx(expected, abs=2e-3 * len(moving))


def test_both_directions_cost_the_same_bits(checker, motions):
    for kind in ("joint", "survival", "occupancy", "entropy"):
        there, back = MotionRisk(checker, kind, 0.02), MotionRisk(checker, kind, 0.02)
        for qa, qb in motions:
            assert there.motion(qa, qb) == back.motion(qb, qa)


def test_ompl_gets_the_same_cost_and_length_beside_it(checker, motions):
    si = ob.SpaceInformation(state_space(checker.robot))
    with quiet_ompl():
        objective = VPrismRiskObjective(si, checker, kind="joint", length_weight=0.25)
    risk = MotionRisk(checker, "joint", 0.02)
    for qa, qb in motions[:6]:
        a, b = (to_state(si.getStateSpace(), q) for q in (qa, qb))
        expected = risk.motion(qa, qb) + 0.25 * np.linalg.norm(qb - qa)
        assert objective.motionCost(a, b).value() == pytest.approx(expected, rel=1e-12)


def test_a_plan_never_costs_more_than_the_path_it_was_led_along(checker, motions):
    free = [q for pair in motions for q in pair if checker.is_valid(q)]
    if len(free) < 2:
        pytest.skip("no two free configurations near the objects")
    result = plan(
        checker, free[0], free[-1], "InformedRRTstar", time_limit=0.5, simplify_time=0.2,
        clock="process", objective=RiskObjective("joint"),
    )  # fmt: skip
    assert result.report.objective == "joint"
    if result.solved and not result.report.direct:
        assert result.report.history[0].cost >= result.report.cost - 1e-12


@pytest.mark.parametrize(("kind", "spacing", "message"), [
    ("fear", 0.02, "'fear'.*joint"),
    ("joint", 0.0, "spacing is 0"),
    ("joint", np.inf, "spacing is inf"),
])  # fmt: skip
def test_a_malformed_risk_names_the_value(checker, kind, spacing, message):
    with pytest.raises(PlanningError, match=message):
        MotionRisk(checker, kind, spacing)
