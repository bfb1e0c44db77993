"""Margins per link and obstacle against formulas, dense points and finite differences."""

import json
from itertools import pairwise

import numpy as np
import pytest
from oracles.checker_oracle import sphere_positions
from oracles.random_robots import as_robot, random_arrays, random_q
from oracles.world_oracles import level_points, random_map
from scipy.spatial import cKDTree

import vprism_plan as vp
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.margins import margin_profile, safety_margin
from vprism_plan.collision.motion import sphere_jacobians
from vprism_plan.errors import RobotError, WorldError
from vprism_plan.perception import Plane
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.config import Box, Cylinder, HalfSpace, Sphere

VOXEL = 0.01
# Half a face diagonal of a voxel (bounds between nodes), the cell to which the level set's
# owner is resolved, and the oracle's own lattice.
FINE = 0.003
INFLATION = 0.75 * VOXEL + np.sqrt(3.0) * (0.5 * VOXEL + 0.5 * FINE)


def tilted(x, y, z):
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]
    pose[:3, 3] = x, y, z
    return pose


SOLIDS = (
    Sphere("ball", 0.07, (0.3, 0.1, 0.2)),
    Box("box", (0.1, 0.2, 0.15), tilted(-0.35, 0.1, 0.2)),
    Cylinder("can", 0.05, 0.2, tilted(0.1, -0.35, 0.25)),
)
WALL = HalfSpace("wall", (1.0, 0.0, 0.2), -0.7)


@pytest.fixture(scope="module")
def formula_map():
    return random_map(5, plane=Plane((0.0, 0.0, 1.0), 0.0))


@pytest.fixture(scope="module")
def small_world(formula_map):
    bounds = ((-0.6, -0.6, -0.05), (0.6, 0.6, 0.6))
    return World(formula_map, WorldConfig(bounds=bounds, known=(*SOLIDS, WALL), resolution=VOXEL))


@pytest.fixture(scope="module")
def robots():
    """Random robots whose base stands above the table."""
    cases = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        arrays = random_arrays(rng, dof=4, reach=0.5)
        base = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.15, 0.35)])
        arrays = arrays.__class__(**{**arrays.__dict__, "base_t": base})
        cases.append((rng, arrays))
    return cases


def margins_of(world, cases, each=3):
    for rng, arrays in cases:
        checker = CollisionChecker(world, as_robot(arrays))
        for _ in range(each):
            q = random_q(rng, arrays)
            yield checker, arrays, q, safety_margin(checker, q)


def on_grid(world, points):
    points = np.atleast_2d(points)
    return bool(((points >= world.grid.origin) & (points <= world.grid.upper)).all())


def exact(solid, arrays, q, margin):
    """True distance between a solid and the sphere that the margin names."""
    center = sphere_positions(arrays, q)[margin.sphere]
    return float(solid.signed_distance(center[None])[0]) - arrays.sphere_radius[margin.sphere]


def test_clearances_to_solids_are_bounds_and_points_lie_where_they_should(small_world, robots):
    solids = {f"known:{solid.name}": solid for solid in SOLIDS}
    seen = 0
    for _, arrays, q, found in margins_of(small_world, robots):
        centers = sphere_positions(arrays, q)
        for margin in found.margins:
            if margin.body not in solids:
                continue
            solid = solids[margin.body]
            link = int(margin.link.removeprefix("link"))
            own = arrays.sphere_link == link
            true = np.min(solid.signed_distance(centers[own]) - arrays.sphere_radius[own])
            assert margin.clearance <= true + 1e-9
            if true > -0.01 and on_grid(small_world, centers[own]):
                assert margin.clearance >= true - 0.75 * VOXEL
            assert margin.occupancy is margin.entropy is None
            center, radius = centers[margin.sphere], arrays.sphere_radius[margin.sphere]
            assert np.linalg.norm(np.array(margin.witness) - center) == pytest.approx(radius)
            if exact(solid, arrays, q, margin) + radius > 0.0:  # its centre is outside
                off = solid.signed_distance(np.array([margin.nearest]))[0]
                assert abs(off) <= VOXEL
                if not on_grid(small_world, center):
                    continue
                way = np.linalg.norm(np.array(margin.nearest) - center)
                assert abs(way - radius - exact(solid, arrays, q, margin)) <= VOXEL
                seen += 1
    assert seen > 60


def test_gradients_are_those_of_the_exact_clearance(small_world, robots):
    solids = {f"known:{solid.name}": solid for solid in SOLIDS}
    wrong, lever = [], []
    for _, arrays, q, found in margins_of(small_world, robots):
        for margin in found.margins:
            solid = solids.get(margin.body)
            if solid is None or exact(solid, arrays, q, margin) < 0.0:
                continue
            slope = [
                (exact(solid, arrays, q + step, margin) - exact(solid, arrays, q - step, margin))
                / 2e-6
                for step in 1e-6 * np.eye(len(q))
            ]
            jacobian = sphere_jacobians(arrays, q[None], np.array([margin.sphere]))[1][0]
            wrong.append(np.abs(np.array(margin.gradient) - slope).max())
            lever.append(np.linalg.norm(jacobian, 2))
    share = np.array(wrong) / np.array(lever)
    assert len(share) > 60
    assert np.median(share) < 0.01
    assert np.quantile(share, 0.95) < 0.1


def test_half_spaces_are_exact_in_every_number(small_world, robots):
    rows = {"support surface": np.array([0.0, 0.0, 1.0, 0.0]), "known:wall": None}
    rows["known:wall"] = np.array([*WALL.normal, WALL.offset])
    for _, arrays, q, found in margins_of(small_world, robots[:4]):
        for margin in found.margins:
            if margin.body not in rows:
                continue
            row = rows[margin.body]
            s = margin.sphere
            height = sphere_positions(arrays, q)[s] @ row[:3] - row[3]
            assert margin.clearance == pytest.approx(height - arrays.sphere_radius[s], abs=1e-12)
            assert np.array(margin.nearest) @ row[:3] == pytest.approx(row[3], abs=1e-12)
            step = 1e-6 * np.eye(len(q))
            slope = [
                (sphere_positions(arrays, q + d)[s] - sphere_positions(arrays, q - d)[s])
                @ row[:3] / 2e-6
                for d in step
            ]  # fmt: skip
            np.testing.assert_allclose(margin.gradient, slope, atol=1e-8)


def test_objects_are_as_far_as_their_level_set(formula_map, small_world, robots):
    points = level_points(formula_map, FINE, 0.5, np.array([0.2, 0.4, 0.7]))
    owner = 1 + formula_map.predict_proba(points)[:, 1:].argmax(axis=1)
    trees = {f"object:{k}": cKDTree(points[owner == k]) for k in (1, 2)}
    seen = 0
    for _, arrays, q, found in margins_of(small_world, robots):
        centers = sphere_positions(arrays, q)
        for margin in found.margins:
            if margin.body not in trees:
                continue
            own = arrays.sphere_link == int(margin.link.removeprefix("link"))
            near = (trees[margin.body].query(centers[own])[0] - arrays.sphere_radius[own]).min()
            assert margin.clearance <= near + 1e-9
            if near > 0.0 and on_grid(small_world, centers[own]):
                assert margin.clearance >= near - INFLATION
                seen += 1
            nearest = np.array([margin.nearest])
            assert margin.occupancy == pytest.approx(formula_map.occupancy(nearest)[0])
            assert margin.entropy == pytest.approx(formula_map.entropy(nearest)[0])
    assert seen > 40


def test_no_margin_is_below_the_checkers_own_clearance(demo_world, repository):
    base = np.eye(4)
    base[:3, 3] = [-0.1, -0.55, 0.0]
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)
    checker = CollisionChecker(demo_world, robot)
    rng = np.random.default_rng(0)
    sources = set()
    for q in rng.uniform(robot.lower, robot.upper, (12, robot.dof)):
        found = safety_margin(checker, q)
        assert found.clearance == checker.clearance(q)
        smallest = min(margin.clearance for margin in found.margins)
        assert smallest >= found.clearance - 1e-8
        if found.clearance > 0.0:
            assert smallest == pytest.approx(found.clearance, abs=0.75 * VOXEL)
        assert found.self_clearance == checker.self_clearance_batch(q[None])[0]
        sources |= {margin.body for margin in found.margins}
        moving = {n for n, f in zip(robot.link_names, robot.fixed_links, strict=True) if not f}
        assert {margin.link for margin in found.margins} == moving
    expected = {"support surface", "background", "occluded"}
    assert sources == expected | {f"object:{i}" for i in demo_world.map.object_ids}


def test_what_a_link_may_touch_is_shown_and_does_not_count(demo_map, demo_world, ball_robot):
    seen = demo_map.views[0].points()
    middle = seen[0][seen[1] == 3].mean(axis=0)
    robot = ball_robot(0.02)
    rule = vp.CheckerConfig(allowed_contacts={"ball": {3}})
    strict = safety_margin(CollisionChecker(demo_world, robot), middle)
    checker = CollisionChecker(demo_world, robot, rule)
    loose = safety_margin(checker, middle)
    touched = loose.between("ball", "object:3")
    assert touched.allowed
    assert touched.clearance == strict.between("ball", "object:3").clearance < 0.0
    assert not strict.between("ball", "object:3").allowed
    assert loose.clearance == checker.clearance(middle) > strict.clearance
    counted = [margin.clearance for margin in loose.margins if not margin.allowed]
    assert min(counted) >= loose.clearance - 1e-8
    assert "object:3 (allowed)" in loose.text()
    # Hidden space inside the object goes with it.
    assert (
        loose.between("ball", "occluded").clearance >= strict.between("ball", "occluded").clearance
    )
    _, profile = margin_profile(checker, np.stack([middle, middle + 0.1]))
    assert "object:3" not in profile


def test_torch_differentiates_the_same_jacobian(repository):
    import torch

    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf")
    q = torch.tensor(robot.neutral + 0.1, requires_grad=True)
    last = len(robot.sphere_radii) - 1
    graph = torch.autograd.functional.jacobian(lambda x: robot.sphere_centers(x)[last], q)
    own = sphere_jacobians(robot.arrays, q.detach().numpy()[None], np.array([last]))[1][0]
    np.testing.assert_allclose(own, graph.numpy(), atol=1e-10)


def test_along_a_path_every_margin_bounds_all_configurations(small_world, robots):
    for rng, arrays in robots[:3]:
        if arrays.continuous.any():
            continue
        checker = CollisionChecker(small_world, as_robot(arrays))
        path = np.array([random_q(rng, arrays) for _ in range(3)])
        found = safety_margin(checker, path, tolerance=0.01)
        assert found.tolerance == 0.01
        share = np.linspace(0.0, 1.0, 9)[:, None]
        Q = np.concatenate([a + share * (b - a) for a, b in pairwise(path)])
        for q in Q:
            for margin in safety_margin(checker, q).margins:
                whole = found.between(margin.link, margin.body)
                # Bounds drop by a voxel's worth between neighbours; true distances do not.
                assert whole.clearance <= margin.clearance + 0.5 * VOXEL
        for margin in found.margins:
            edge = min(int(margin.place), 1)
            q = path[edge] + (margin.place - edge) * (path[edge + 1] - path[edge])
            there = safety_margin(checker, q).between(margin.link, margin.body)
            assert there.clearance - found.tolerance == pytest.approx(margin.clearance, abs=1e-9)
        places, profile = margin_profile(checker, path, tolerance=0.01)
        assert len(places) == found.configurations
        for body, margin in found.of_bodies().items():
            assert profile[body].min() - 0.01 == pytest.approx(margin.clearance, abs=1e-9)


def test_sources_apart_are_the_field_together(small_world, demo_world):
    for world in (small_world, demo_world):
        fields = [world.source_field(name).distance for name in world.sources]
        together = np.min(fields, axis=0)
        outside = world.field.distance > 0.0
        np.testing.assert_array_equal(together[outside], world.field.distance[outside])
        assert (together >= world.field.distance).all()
    with pytest.raises(WorldError, match="no source 'object:77'"):
        demo_world.source_field("object:77")


def test_reports_are_json_and_a_table(small_world, robots):
    _, _, _, found = next(margins_of(small_world, robots))
    data = json.loads(json.dumps(found.to_dict()))
    assert len(data["margins"]) == len(found.margins)
    first = data["margins"][0]
    assert {"link", "body", "clearance", "gradient", "nearest", "witness", "entropy"} <= set(first)
    assert [m.clearance for m in found.margins] == sorted(m.clearance for m in found.margins)
    lines = found.text(rows=4).splitlines()
    assert len(lines) == 6
    assert lines[0].startswith("link")
    assert "farther" in lines[-1]
    with pytest.raises(RobotError, match="obstacles: "):
        found.between("link1", "object:99")


def test_nonsense_is_refused(small_world, robots):
    checker = CollisionChecker(small_world, as_robot(robots[0][1]))
    with pytest.raises(RobotError, match="shape"):
        safety_margin(checker, np.zeros(9))
    with pytest.raises(RobotError, match="shape"):
        safety_margin(checker, np.zeros((1, 2, 4)))
    with pytest.raises(RobotError, match="finite"):
        safety_margin(checker, np.full(4, np.nan))
    with pytest.raises(RobotError, match="tolerance"):
        safety_margin(checker, np.zeros((2, 4)), tolerance=-1.0)
    far = np.tile([checker.robot.lower, checker.robot.upper], (20, 1))
    with pytest.raises(RobotError, match="coarser tolerance"):
        safety_margin(checker, far, tolerance=1e-6)
