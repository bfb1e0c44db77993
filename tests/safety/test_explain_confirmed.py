"""A thousand refused configurations: each has a reason, and slow geometry finds it there, too."""

from functools import cached_property

import numpy as np
import pytest
from oracles.checker_oracle import sphere_positions
from scipy.spatial import cKDTree

import vprism_plan as vp
from vprism_plan.collision.explain import unit_ball_points
from vprism_plan.world.config import Box, Cylinder, HalfSpace
from vprism_plan.world.seen import lost_cones

VOXEL = 0.01
FINE = 0.004  # of the oracle's own lattices
# How much nearer than it is an obstacle may seem: half a face diagonal of a voxel for the
# bounds between nodes, the diagonal of the cells (half a voxel) that obstacles are made of,
# and what the oracle's lattice leaves out. See `DistanceField` and `World`.
INFLATION = 0.75 * VOXEL + np.sqrt(3.0) * (0.5 * VOXEL + 0.5 * FINE)
COARSE = 2.0 * np.sqrt(3.0) * 0.1  # the same beyond the grid: nodes 10 cm apart
PIXEL = 0.002  # half the width of a pixel at the far end of the scene, metres


def at(*position):
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


SHELF = Box("shelf", (0.3, 0.1, 0.02), at(-0.2, 0.3, 0.35))
POLE = Cylinder("pole", 0.03, 0.6, at(0.35, 0.1, 0.3))
WALL = HalfSpace("wall", (0.0, -1.0, 0.0), -0.75)


class Oracle:
    """What is really there, asked point by point."""

    def __init__(self, world: vp.World) -> None:
        self.world, self.map = world, world.map

    @cached_property
    def level_set(self) -> dict[int, cKDTree]:
        """Points of {P(occupied) >= 1/2} on a fine lattice, by the likeliest object."""
        lower, upper = self.map.support_bounds()
        axes = [np.arange(a, b, 4 * FINE) for a, b in zip(lower, upper, strict=True)]
        coarse = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        near = coarse[self.map.occupancy_log_odds(coarse) > -6.0]
        offsets = (np.indices((4, 4, 4)).reshape(3, -1).T - 1.5) * FINE
        fine = (near[:, None] + offsets).reshape(-1, 3)
        p = self.map.predict_proba(fine)
        owner = np.where(p[:, 0] <= 0.5, p[:, 1:].argmax(axis=1), -1)
        return {
            i: cKDTree(np.concatenate([fine[owner == k], self.labelled(i)]))
            for k, i in enumerate(self.map.object_ids)
        }

    def labelled(self, object_id: int) -> np.ndarray:
        """Points that a camera saw of an object, and the cones of its pixels without depth:
        obstacles wherever the level set misses them."""
        found = []
        for view in self.map.views:
            points, labels = view.points()
            found.append(points[labels == object_id])
            for cone in lost_cones(view, self.map.plane):
                if cone.object_id != object_id:
                    continue
                for ray, start, end in zip(cone.rays, cone.start, cone.end, strict=True):
                    depths = np.arange(start, min(end, 3.0) + FINE, FINE)
                    found.append(view.camera_center + depths[:, None] * ray)
        return np.concatenate(found)

    @cached_property
    def clutter(self) -> cKDTree:
        points = self.labelled(0)
        return cKDTree(points[self.map.plane.signed_distance(points) > 0.01])

    def unseen(self, kind: str, center: np.ndarray, radius: float) -> bool:
        """Whether the cameras missed some point of a ball, as its kind says they did."""
        for step in (4 * FINE, 2 * FINE, 0.5 * FINE):
            axis = np.arange(-radius, radius, step)
            # Noise of a millimetre throws shadows that lie flat on the table: look there, too.
            levels = 0.0003 - center[2] if step < FINE else axis
            cube = np.stack(np.meshgrid(axis, axis, levels, indexing="ij"), -1).reshape(-1, 3)
            points = center + cube[np.linalg.norm(cube, axis=1) <= radius]
            status = self.world.status(points)
            if kind == "unobserved":
                grid = self.world.grid  # where the policy is "occupied", all outside of it is
                hits = (status >= 2) | ((points < grid.origin) | (points > grid.upper)).any(axis=1)
            else:  # what lies under the support surface is that surface's
                hits = (status == 1) & (self.map.plane.signed_distance(points) > 0.0)
            if hits.any():
                return True
        return False

    def reaches(self, contact, center: np.ndarray, radius: float) -> bool:
        """Whether the ball comes as near to the named obstacle as its field claims."""
        grid = self.world.grid
        coarse = ((center < grid.origin) | (center > grid.upper)).any()
        reach = radius + (COARSE if coarse else INFLATION)
        kind, _, name = contact.body.partition(":")
        if kind == "occluded" and self.map.plane.signed_distance(center) < 0.0:
            return True  # coarse cells reach to both sides of the table, where it answers anyway
        if kind == "object":
            return bool(self.level_set[int(name)].query(center)[0] <= reach + PIXEL)
        if kind == "background":
            return bool(self.clutter.query(center)[0] <= reach + PIXEL)
        if kind == "known":
            solid = {"shelf": SHELF, "pole": POLE}[name]
            return bool(solid.signed_distance(center[None])[0] <= radius + 0.75 * VOXEL)
        return self.unseen(kind, center, reach)


def confirm(checker, oracle, q, contact) -> None:
    """Assert that one reason is true."""
    robot, margin = checker.robot, checker.config.margin
    if contact.kind == "joint_limit":
        j = robot.joint_names.index(contact.link)
        excess = max(robot.lower[j] - q[j], q[j] - robot.upper[j])
        assert contact.depth == pytest.approx(excess)
        assert excess > 0.0
        return
    centers = sphere_positions(robot.arrays, q)
    s = contact.sphere
    center, radius = centers[s], robot.sphere_radii[s]
    link = int(robot.sphere_links[s])
    assert robot.link_names[link] == contact.link
    if contact.kind == "risk":
        ball = center + (radius + margin + VOXEL) * unit_ball_points(8000)
        assert 0.0 < contact.probability <= 1.0
        assert contact.probability < 0.05 or oracle.map.occupancy(ball).max() > 0.01
        assert contact.depth > 0.0
        return
    away = np.linalg.norm(np.array(contact.position) - center)
    assert away == pytest.approx(radius, abs=1e-6)
    assert contact.depth >= 0.0
    if contact.kind == "self":
        other = np.flatnonzero(robot.sphere_links == robot.link_names.index(contact.body))
        gaps = np.linalg.norm(centers[other] - center, axis=1) - robot.sphere_radii[other] - radius
        assert checker.config.self_margin - gaps.min() == pytest.approx(contact.depth, abs=1e-9)
        return
    assert not robot.fixed_links[link]
    planes = {"support surface": (oracle.map.plane.normal, oracle.map.plane.offset)}
    planes["known:wall"] = (WALL.normal, WALL.offset)
    if contact.body in planes:
        normal, offset = planes[contact.body]
        gap = center @ normal - offset - radius
        assert margin - gap == pytest.approx(contact.depth, abs=1e-9)
        np.testing.assert_allclose(contact.normal, normal, atol=1e-12)
        return
    assert oracle.reaches(contact, center, radius + margin), (contact, q.tolist())
    if contact.probability is not None:
        assert 0.0 <= contact.probability <= 1.0


@pytest.fixture(scope="module", params=[np.inf, 2.0], ids=["obstacle", "few unseen objects"])
def furnished(request, demo_map):
    """Known geometry, and nothing is free that nobody saw; hidden space that the map does not judge
    is an obstacle, or left to unseen objects, which without a bound on risk are no reason."""
    config = vp.WorldConfig(
        known=(SHELF, POLE, WALL), unobserved="occupied",
        hidden_objects=request.param,
    )  # fmt: skip
    return vp.World(demo_map, config)


@pytest.fixture(scope="module")
def oracle(demo_world):
    return Oracle(demo_world)


def arm(repository):
    base = np.eye(4)
    base[:3, 3] = [-0.1, -0.55, 0.0]
    return vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)


def refused(checker, sample, n):
    """The first n refused configurations of an endless sampler."""
    found = np.empty((0, checker.robot.dof))
    while len(found) < n:
        Q = sample(4 * n)
        found = np.concatenate([found, Q[~checker.is_valid_batch(Q)]])
    return found[:n]


def examine(checker, oracle, Q):
    """Confirm every reason of every refusal; count them by kind."""
    kinds: dict[str, int] = {}
    for q in Q:
        report = checker.explain(q)
        assert not report.valid
        assert report.contacts
        for contact in report.contacts:
            confirm(checker, oracle, q, contact)
            kinds[contact.kind] = kinds.get(contact.kind, 0) + 1
    return kinds


@pytest.mark.slow
def test_reasons_of_an_arm_are_confirmed(demo_world, oracle, repository):
    checker = vp.CollisionChecker(demo_world, arm(repository))
    rng = np.random.default_rng(0)
    low, high = checker.robot.lower, checker.robot.upper
    Q = refused(checker, lambda n: rng.uniform(low - 0.03, high + 0.03, (n, 7)), 400)
    kinds = examine(checker, oracle, Q)
    assert set(kinds) >= {"support", "self", "joint_limit", "occluded", "object"}, kinds


def test_reasons_of_a_ball_among_everything_are_confirmed(demo_map, furnished, oracle, ball_robot):
    checker = vp.CollisionChecker(furnished, ball_robot(0.025), vp.CheckerConfig(margin=0.004))
    rng = np.random.default_rng(1)
    seen = np.concatenate([view.points()[0] for view in demo_map.views])
    seen = seen[demo_map.plane.signed_distance(seen) > 0.01]

    behind = seen - demo_map.views[0].camera_center
    behind /= np.linalg.norm(behind, axis=1, keepdims=True)

    def sample(n):
        row = rng.integers(len(seen), size=n)
        Q = seen[row] + rng.uniform(-0.02, 0.2, (n, 1)) * behind[row]
        Q[::4] = rng.uniform([-0.6, -0.5, 0.0], [0.6, 0.9, 0.7], Q[::4].shape)
        Q[1::4] = [(-0.2, 0.3, 0.35), (0.35, 0.1, 0.3)][int(rng.integers(2))]
        Q[1::4] += rng.normal(0.0, 0.04, Q[1::4].shape)
        return Q[rng.permutation(n)]

    Q = refused(checker, sample, 400)
    kinds = examine(checker, oracle, Q)
    assert set(kinds) >= {"object", "known", "unobserved", "support"}, kinds
    assert ("occluded" in kinds) == (furnished.config.hidden_objects == np.inf)


def test_reasons_of_a_ball_near_clutter_are_confirmed(demo_map, oracle, ball_robot):
    everything = vp.World(demo_map, vp.WorldConfig(lone_share=0.0))
    checker = vp.CollisionChecker(everything, ball_robot(0.015))
    rng = np.random.default_rng(2)
    points, eye = oracle.clutter.data, demo_map.views[0].camera_center

    def sample(n):
        at = points[rng.integers(len(points), size=n)]
        towards = (eye - at) / np.linalg.norm(eye - at, axis=1, keepdims=True)
        return at + rng.uniform(0.0, 0.03, (n, 1)) * towards + rng.normal(0.0, 0.003, (n, 3))

    kinds = examine(checker, oracle, refused(checker, sample, 500))
    assert kinds.get("background", 0) > 20, kinds
