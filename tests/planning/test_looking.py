# SPDX-License-Identifier: BSD-3-Clause
"""The view that would let a motion through, against worlds looked at one by one."""

import numpy as np
import pytest
from oracles import sight_oracle
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan.collision.risk import count_path
from vprism_plan.errors import ConfigError, PlanningError
from vprism_plan.planning import camera_views, plan
from vprism_plan.simulation.camera import Camera
from vprism_plan.world import Box

RADIUS = 0.02
START = [0.02, -0.2, 0.15]
MIDDLE = np.array([0.05, 0.0, 0.05])


def orbit(azimuth, elevation=0.7, distance=0.7):
    return Camera.orbit(MIDDLE, distance, azimuth, elevation).T_world_camera


VIEWS = [orbit(a, e) for a in np.arange(8) * np.pi / 4 for e in (0.4, 0.9)]


@pytest.fixture(scope="module")
def world():
    return vp.World(small_map())


@pytest.fixture(scope="module")
def checker(world, ball_robot):
    return vp.CollisionChecker(world, ball_robot(RADIUS))


@pytest.fixture(scope="module")
def goal(checker):
    """A place that is refused although nothing was seen there."""
    rng = np.random.default_rng(3)
    places = rng.uniform([-0.05, -0.1, 0.025], [0.15, 0.1, 0.12], (4000, 3))
    risky = places[~checker.is_valid_batch(places)]
    risky = risky[checker.relaxed(0.9).is_valid_batch(risky)]
    chance = np.array([checker.collision_probability(q).probability for q in risky])
    return risky[np.argmin(np.abs(chance - 0.4))]


@pytest.fixture(scope="module")
def found(checker, goal):
    return vp.next_view(checker, START, goal, VIEWS)


def test_views_show_what_each_world_looked_at_by_itself_shows(checker, found):
    setting = checker.risk_setting(held_out=True)
    worlds, field, view = setting.worlds, checker.world.field, checker.world.map.views[0]
    sweep = count_path(setting, found.plan.approximate_path, worlds.n_worlds)
    radii = RADIUS + sweep.slack[:, 0]
    balls = np.column_stack([sweep.centers[:, :, 0], radii])
    balls = balls[worlds.touched(balls[:, :3], radii).any(axis=1)]
    first, occupied = sight_oracle.dense_worlds(worlds, (-0.15, -0.2, 0.0), (0.3, 0.2, 0.2))
    collide = np.flatnonzero(sweep.touched)
    assert found.risk == len(collide) / worlds.n_worlds
    for v in (0, 5, 9):
        shown = [
            sight_oracle.shown(
                balls, VIEWS[v], view.intrinsics, view.depth.shape, first, occupied[..., s],
                worlds.resolution, field,
            )
            for s in collide
        ]  # fmt: skip
        assert found.values[v].shown == np.mean(shown)


def test_no_view_is_worth_less_than_none_and_the_best_is_first(found):
    assert found.plan.status == "too_risky"
    assert 0.1 < found.risk < 1.0
    worth = [v.utility for v in found.values]
    assert min(worth) >= found.utility == 0.0
    for value in found.values:
        assert 0.0 <= value.shown <= 1.0
        assert value.go == pytest.approx(1.0 - value.shown * found.risk)
        assert value.risk == pytest.approx(found.risk * (1.0 - value.shown) / value.go)
        assert value.utility == pytest.approx(max(0.0, value.go * (1.0 - value.risk / 0.1)))
        assert value.entropy >= 0.0
    assert sorted(found.ranking) == list(range(len(VIEWS)))
    assert worth[found.best] == max(worth) > 0.3
    np.testing.assert_array_equal(found.views, VIEWS)
    assert f"view {found.best} of {len(VIEWS)} would show " in found.text()


def test_the_side_that_nobody_saw_is_better_than_the_same_again(checker, goal, found):
    own = checker.world.map.views[0]
    again = vp.next_view(checker, START, goal, [own.pose, VIEWS[found.best]], result=found.plan)
    same, best = again.values
    assert again.best == 1
    assert same.baseline == pytest.approx(0.0, abs=1e-6)
    assert same.shown < 0.5 * best.shown
    assert best.baseline > 0.5


def test_views_that_show_nothing_are_worth_nothing(checker, goal, found, ball_robot):
    best = VIEWS[found.best]
    away = best @ np.diag([1.0, -1.0, -1.0, 1.0])
    nothing = vp.next_view(checker, START, goal, [away], result=found.plan)
    assert nothing.best is None
    assert nothing.values[0].shown == nothing.values[0].entropy == 0.0
    # A crate between: what is known hides as well.
    between = 0.5 * (best[:3, 3] + MIDDLE)
    crate = Box("crate", (0.3, 0.3, 0.02), at(*between, *best[:3, :3].reshape(-1)[:0]))
    hidden = vp.CollisionChecker(
        vp.World(checker.world.map, vp.WorldConfig(known=(crate,), bounds=_bounds())),
        ball_robot(RADIUS),
    )
    blocked = vp.next_view(hidden, START, goal, [best], result=found.plan)
    assert blocked.values[0].shown < 0.2 * found.values[found.best].shown


def _bounds():
    return (-0.6, -0.6, 0.0), (0.6, 0.6, 0.6)


def test_where_nothing_hides_no_view_is_asked_for(checker):
    found = vp.next_view(checker, START, [0.02, -0.2, 0.2], VIEWS)
    assert found.plan.solved
    assert (found.risk, found.utility, found.best) == (0.0, 1.0, None)
    assert found.text().endswith(f"none of {len(VIEWS)} views shows anything that may be touched")


def test_a_seen_thing_in_the_way_has_no_view(checker):
    found = vp.next_view(checker, START, [0.0, 0.0, -0.05], VIEWS)
    assert found.plan.status == "invalid_goal"
    assert found.values == found.ranking == ()
    assert found.best is None
    assert found.text().startswith("no motion to look for (invalid_goal)")


def test_a_camera_on_a_link_is_where_the_robot_can_bring_it(checker):
    places = np.array([START, [0.0, 0.0, -0.05], [0.1, -0.2, 0.2]])
    mounted = at(0.0, 0.03, 0.0)
    link = checker.robot.link_names[-1]
    poses, rows = camera_views(checker, link, mounted, places)
    assert rows.tolist() == [0, 2]
    for pose, q in zip(poses, places[rows], strict=True):
        np.testing.assert_allclose(pose, checker.robot.link_poses(q)[link] @ mounted)


def test_what_cannot_be_weighed_is_refused(checker, world, ball_robot):
    with pytest.raises(PlanningError, match="views is empty"):
        vp.next_view(checker, START, START, [])
    with pytest.raises(PlanningError, match="view 1"):
        vp.next_view(checker, START, START, [np.eye(4), 2.0 * np.eye(4)])
    empty = vp.CollisionChecker(vp.World(known=[]), ball_robot(RADIUS))
    with pytest.raises(PlanningError, match="give intrinsics and shape"):
        vp.next_view(empty, START, START, VIEWS)
    nothing = vp.next_view(
        empty, START, [0.1, 0.0, 0.2], VIEWS, intrinsics=np.eye(3), shape=(480, 640)
    )
    assert (nothing.risk, nothing.utility, nothing.best) == (0.0, 1.0, None)
    certain = vp.CollisionChecker(world, ball_robot(RADIUS), vp.CheckerConfig(max_risk=None))
    with pytest.raises(ConfigError, match="max_risk"):
        vp.next_view(certain, START, START, VIEWS)


def test_one_more_view_of_the_same_plan_changes_nothing(checker, goal, found):
    assert plan(checker, START, goal).status == found.plan.status
    again = vp.next_view(checker, START, goal, VIEWS)
    assert again.ranking == found.ranking
    assert again.values == found.values
