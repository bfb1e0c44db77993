# SPDX-License-Identifier: BSD-3-Clause
"""What public objects promise as values: they compare, can be copied, and are not changed by
accident; and what is no value for them is refused."""

import copy
import dataclasses
import importlib
import itertools
import pickle
import sys
import threading

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan import trajopt
from vprism_plan.collision import RiskEstimate
from vprism_plan.errors import ConfigError, MapError, ObservationError, PlanningError, RobotError
from vprism_plan.planning import PlanReport, PlanResult, last_valid

FOLDERS = ("perception", "mapping", "world", "robots", "collision", "planning", "trajopt")


@pytest.fixture(scope="module")
def arm(repository):
    return vp.Robot.from_urdf(repository / "urdf" / "planar3.urdf", base_pose=at(0.0, -0.3, 0.05))


@pytest.fixture(scope="module")
def map_():
    return small_map()


@pytest.fixture
def fresh(map_, arm):
    """A function that makes a world and a checker that nobody has asked yet."""

    def make(**settings):
        bounds = ((-0.3, -0.5, -0.03), (0.4, 0.4, 0.3))
        world = vp.World(map_, vp.WorldConfig(resolution=0.03, bounds=bounds, occluded="free"))
        return vp.CollisionChecker(world, arm, vp.CheckerConfig(n_worlds=64, **settings))

    return make


@pytest.fixture(scope="module")
def Q(arm):
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (60, arm.dof))


def deep(thing):
    return copy.deepcopy(thing)


def pickled(thing):
    return pickle.loads(pickle.dumps(thing))


@pytest.mark.parametrize("folder", FOLDERS)
def test_what_holds_arrays_is_not_compared_by_value(folder):
    """`==` of arrays is an array, which is neither true nor false."""
    public = vars(importlib.import_module(f"vprism_plan.{folder}"))
    for name, kind in public.items():
        if name.startswith("_") or not dataclasses.is_dataclass(kind):
            continue
        types = {f.name: str(f.type) for f in dataclasses.fields(kind) if f.compare}
        arrays = [
            field
            for field, type_ in types.items()
            if ("ndarray" in type_ or "Tensor" in type_) and "Callable" not in type_
        ]
        assert not (kind.__dataclass_params__.eq and arrays), (name, arrays)


def test_estimates_and_plans_compare_and_hash():
    def estimate():
        return RiskEstimate(
            probability=0.5,
            lower=0.4,
            upper=0.6,
            confidence=0.95,
            n_worlds=64,
            seed=0,
            per_waypoint=np.array([0.5, 0.5]),
            certain=False,
            spacing=0.01,
            configurations=2,
            trace=tuple,
            volume=dict,
        )

    def planned():
        report = PlanReport(planner="RRT", seed=0, time_limit=1.0)
        return PlanResult(path=np.zeros((2, 3)), status="exact", report=report)

    for make in (estimate, planned):
        one, other = make(), make()
        assert one != other
        assert [one, other].index(other) == 1
        assert len({one, other, one}) == 2


def answers(checker, Q):
    """Everything that could differ between a checker and its copy, as bytes."""
    report = checker.explain(Q[0])
    estimates = [checker.collision_probability(Q[i : i + 2]) for i in range(0, 12, 2)]
    bits = [
        checker.is_valid_batch(Q),
        checker.clearance_batch(Q),
        checker.self_clearance_batch(Q),
        np.array([checker.check_motion(a, b) for a, b in itertools.pairwise(Q)]),
        np.array([[e.probability, e.lower, e.upper] for e in estimates]),
        np.concatenate([e.per_waypoint for e in estimates]),
    ]
    return [array.tobytes() for array in bits], report.to_dict()


@pytest.mark.parametrize("duplicate", [deep, pickled])
@pytest.mark.parametrize("settings", [{}, {"max_risk": 0.2, "allowed_contacts": {"link3": {2}}}])
def test_checkers_are_copied_before_and_after_probabilities_were_asked(
    fresh, arm, Q, duplicate, settings
):
    """A lock somewhere inside made that a TypeError, for a world only once it had draws."""
    if settings:
        settings = {**settings, "allowed_contacts": {arm.link_names[-1]: {2}}}
    checker = fresh(**settings)
    before = duplicate(checker)
    expected = answers(checker, Q)
    after = duplicate(checker)
    for other in (before, after):
        assert answers(other, Q) == expected
        assert other.robot.lower.flags.writeable is False
    assert after.tightened(1) is not None if settings else after.config == checker.config


@pytest.mark.parametrize("duplicate", [deep, pickled])
def test_worlds_and_draws_are_copied_before_and_after_they_were_asked(fresh, arm, Q, duplicate):
    checker = fresh()
    world = checker.world
    cold = duplicate(world)
    expected = answers(checker, Q)
    warm = duplicate(world)
    for other in (cold, warm):
        assert answers(vp.CollisionChecker(other, arm, checker.config), Q) == expected
        assert not other.planes.flags.writeable
    draws = world.posterior_worlds(64)
    centers = np.random.default_rng(1).uniform(-0.15, 0.15, (200, 3))
    found = draws.touched(centers, 0.03)
    half = duplicate(draws)
    draws.bake()
    for other in (half, duplicate(draws), duplicate(half.redrawn(draws.seed))):
        np.testing.assert_array_equal(other.touched(centers, 0.03), found)
        assert other._lock is not draws._lock


def test_draws_are_copied_while_another_thread_bakes_them(map_):
    """A block that is marked as drawn but not yet filled would answer by chance."""
    draws = vp.PosteriorWorlds(map_, 64, 0, 0.02, 0.2)
    centers = np.random.default_rng(1).uniform(-0.2, 0.2, (500, 3))
    thread = threading.Thread(target=draws.bake)
    thread.start()
    others = []
    while thread.is_alive():
        others.append(copy.deepcopy(draws))
    thread.join()
    expected = draws.touched(centers, 0.05)
    for other in others[:5] + others[-1:]:
        np.testing.assert_array_equal(other.touched(centers, 0.05), expected)


@pytest.mark.parametrize("duplicate", [deep, pickled])
def test_mesh_checkers_are_copied(fresh, Q, duplicate):
    pytest.importorskip("fcl")
    checker = vp.MeshChecker(fresh().world, fresh().robot, resolution=0.02)
    other = duplicate(checker)
    assert [other.clearance(q) for q in Q[:10]] == [checker.clearance(q) for q in Q[:10]]
    assert [other.is_valid(q) for q in Q] == [checker.is_valid(q) for q in Q]
    assert other.links == checker.links


def handed_out(checker):
    robot, world = checker.robot, checker.world
    names = ("lower", "upper", "continuous", "sphere_radii", "sphere_links", "collision_pairs")
    yield from ((name, getattr(robot, name)) for name in names)
    yield from (("base", robot.base_pose), ("speed", robot.velocity_limits))
    yield from (("planes", world.planes), ("normal", world.map.plane.normal))
    yield from ((f.name, getattr(robot.arrays, f.name)) for f in dataclasses.fields(robot.arrays))
    yield from robot.named_states.items()
    yield from robot.link_spheres.items()


def test_limits_and_half_spaces_are_not_changed_in_place(fresh, arm):
    """`q = robot.lower; q -= 0.5` widened the limits of every checker made afterwards."""
    checker = fresh()
    q = arm.neutral
    q[1] = arm.lower[1] - 0.3
    for subject in (checker, pickled(checker), copy.deepcopy(checker)):
        for name, array in handed_out(subject):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
            assert not array.flags.writeable, name
    assert not checker.is_valid(q)
    assert not vp.CollisionChecker(checker.world, arm.with_base_pose(np.eye(4))).is_valid(q)
    assert checker.explain(q).contacts
    assert arm.neutral.flags.writeable
    assert arm.random_configuration(np.random.default_rng(0)).flags.writeable


def test_no_kernel_is_compiled_for_read_only_arrays(fresh, arm):
    """To numba they are a type of their own: seconds of compiling, in the midst of a query."""
    checker = fresh(max_risk=0.5)
    low, high = arm.lower, arm.upper
    checker.is_valid(low)
    checker.is_valid_batch(np.broadcast_to(low, (3, arm.dof)))
    checker.check_motion(low, high)
    checker.check_motion_report(low, high)
    checker.clearance(low)
    checker.explain(low)
    checker.collision_probability(low)
    checker.collision_probability(np.broadcast_to(low, (3, arm.dof)))
    checker.min_clearance(np.broadcast_to(low, (3, arm.dof)))
    checker.safety_margin(low)
    checker.max_safe_motion(low, 0.01 * high)
    checker.path_entropy(low)
    last_valid(checker, low, high)
    points = np.broadcast_to([0.1, 0.0, 0.2], (2, 3))
    for some in (points, points[:1]):
        checker.world.map.predict_proba(some)
        checker.world.map.occupancy_log_odds(some)
        checker.world.field.lower_bound(some)
        checker.world.status(some)
        checker.world.posterior_worlds(64).touched(some, 0.02)
    vp.plan(checker, low, arm.neutral, time_limit=0.05)
    trajopt.ClearanceCost(checker)(torch.zeros(1, 3, arm.dof))
    for name, module in list(sys.modules.items()):
        if not name.startswith("vprism_plan._kernels."):
            continue
        for kernel, function in vars(module).items():
            for signature in getattr(function, "signatures", ()):
                assert not [a for a in signature if str(a).startswith("readonly")], kernel


MALFORMED = {
    "text": ["a", "b", "c"],
    "word": "abc",
    "ragged": [[1.0], [2.0, 3.0], 4.0],
    "huge": [10**400, 0, 0],
    "complex": np.zeros(3, dtype=complex),
    "masked": np.ma.array(np.zeros(3), mask=[1, 0, 0]),
    "gradient": torch.zeros(3, requires_grad=True),
}


@pytest.mark.parametrize("kind", MALFORMED)
def test_what_is_no_configuration_is_refused_by_name(fresh, kind):
    q, checker = MALFORMED[kind], fresh()
    good = checker.robot.neutral
    asked = [
        lambda: checker.is_valid(q),
        lambda: checker.clearance(q),
        lambda: checker.explain(q),
        lambda: checker.collision_probability(q),
        lambda: checker.check_motion(q, good),
        lambda: checker.check_motion(good, q),
        lambda: checker.check_motion_report(good, q),
        lambda: checker.is_valid_batch(q),
        lambda: checker.clearance_batch(q),
        lambda: checker.min_clearance(q),
        lambda: checker.safety_margin(q),
        lambda: checker.max_safe_motion(q, good),
        lambda: checker.max_safe_motion(good, q),
        lambda: checker.path_entropy(q),
        lambda: checker.robot.check_configuration(q),
        lambda: last_valid(checker, q, good),
    ]
    for ask in asked:
        with pytest.raises((RobotError, TypeCheckError), match=r"cannot be read|parameter"):
            ask()
    for start, goal in ((q, good), (good, q)):
        with pytest.raises((PlanningError, TypeCheckError), match=r"cannot be read|parameter"):
            vp.plan(checker, start, goal)


@pytest.mark.parametrize("q", ["abc", [1j, 0.0, 0.0], [[0.0], [0.0, 1.0]]])
def test_sphere_centers_of_what_are_no_numbers_are_refused(arm, q):
    with pytest.raises((RobotError, TypeCheckError), match=r"cannot be read|parameter"):
        arm.sphere_centers(q)


@pytest.mark.parametrize(
    "setting",
    [
        {"margin": "a"},
        {"margin": None},
        {"margin": True},
        {"self_margin": "0"},
        {"min_motion": [0.1, 0.2]},
        {"max_risk": "0.1"},
        {"confidence": None},
        {"n_worlds": 256.0},
        {"risk_seed": 1.5},
    ],
)
def test_settings_of_a_checker_that_are_no_numbers_are_refused(setting):
    (name,) = setting
    with pytest.raises((ConfigError, TypeCheckError), match=name):
        vp.CheckerConfig(**setting)


@pytest.mark.parametrize("margin", [0.25, np.float64(0.25)])
def test_settings_of_a_checker_may_be_any_real_numbers(margin):
    assert vp.CheckerConfig(margin=margin).margin == margin


@pytest.mark.parametrize(
    "option",
    [{"time_limit": "1"}, {"step": "1"}, {"interpolate": "1"}, {"simplify_time": None}],
)
def test_options_of_a_query_that_are_no_numbers_are_refused(fresh, option):
    checker = fresh()
    q = checker.robot.neutral
    (name,) = option
    with pytest.raises((PlanningError, TypeCheckError), match=name):
        vp.plan(checker, q, q, **option)


@pytest.mark.parametrize("seed", [-1, 0.5, "0", torch.Generator()])
def test_seeds_of_a_map_are_whole_numbers(map_, seed):
    with pytest.raises((MapError, TypeCheckError), match="seed"):
        vp.fit_map(map_.views, map_.config, seed=seed)


@pytest.mark.parametrize("views", [None, 3, [None], "scene"])
def test_maps_are_fitted_to_observations_only(views):
    with pytest.raises((ObservationError, TypeCheckError), match=r"[oO]bservation"):
        vp.fit_map(views)
