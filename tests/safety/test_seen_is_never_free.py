# SPDX-License-Identifier: BSD-3-Clause
"""What a camera saw is an obstacle: labelled or not, in the grid or not, whatever the policies.

A robot that is one ball of 5 mm (the smallest that the promise is about) is put on points that
were seen. Random scenes of boxes and balls; the points are the image's own.
"""

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at

import vprism_plan as vp
from vprism_plan.perception.camera import depth_sigma

K = intrinsics()
RADIUS = 0.005
POINTS = 2000
SMALL = ((-0.08, -0.08, 0.0), (0.08, 0.08, 0.1))  # most of what is seen lies outside

_JOINT = (
    '<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{2}"/><axis xyz="{3}"/>'
    '<limit lower="-5" upper="5" velocity="1" effort="1"/></joint>'
)
_URDF = (
    '<robot name="ball"><link name="w"/><link name="a"/><link name="b"/><link name="ball"/>'
    + _JOINT.format("x", "w", "a", "1 0 0")
    + _JOINT.format("y", "a", "b", "0 1 0")
    + _JOINT.format("z", "b", "ball", "0 0 1")
    + "</robot>"
)


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> vp.Robot:
    path = tmp_path_factory.mktemp("ball") / "ball.urdf"
    path.write_text(_URDF)
    spheres = {"ball": [{"center": [0, 0, 0], "radius": RADIUS}]}
    return vp.Robot.from_urdf(path, spheres=spheres)


def slow(value):
    """A parameter for the long run alone."""
    return pytest.param(value, marks=pytest.mark.slow)


def observed(kind: str, seed: int) -> vp.Observation:
    """Five things near the middle and a post 0.9 m away; of them labelled what `kind` says."""
    rng = np.random.default_rng(seed)
    boxes, spheres = [], []

    def box(at, size) -> None:
        boxes.append((np.array(at) - np.array(size) / 2, np.array(at) + np.array(size) / 2))

    for place in rng.permutation(5)[:3]:
        at = 0.16 * np.array([np.cos(1.3 * place), np.sin(1.3 * place)])
        size = rng.uniform(0.03, 0.09, 3)
        box((*at, size[2] / 2), size)
    radius = float(rng.uniform(0.02, 0.05))
    spheres.append((np.array([0.0, 0.0, radius]), radius))
    box((0.75, 0.45, 0.25), (0.1, 0.1, 0.5))
    # A rod, a few pixels wide: thinner than the map's kernels.
    box((0.02, -0.05, 0.15), (0.006, 0.006, 0.3))
    pose = look_at((-0.75, float(rng.uniform(-0.3, 0.3)), 0.65), (0.3, 0.1, 0.05))
    table = ((-1.0, -1.0), (1.5, 1.0))
    depth, labels = Scene(spheres=spheres, boxes=boxes, table=table).render(pose, K)
    sigma = depth_sigma(np.where(depth > 0, depth, 1.0))
    depth = np.where(depth > 0, depth + 0.3 * sigma * rng.standard_normal(depth.shape), 0.0)
    ids = np.unique(labels[labels > 0])
    if kind == "unlabelled":
        labels = np.where(labels == ids[0], labels, 0)
    elif kind == "mixed":
        labels = np.where(np.isin(labels, ids[::2]), labels, 0)
    plane = vp.perception.Plane((0.0, 0.0, 1.0), 0.0)
    return vp.Observation(depth, labels, K, pose, plane=plane)


def seen_points(view: vp.Observation, seed: int) -> np.ndarray:
    """Points of the image above the stated thresholds."""
    points, labels = view.points()
    slope = np.abs((points - view.camera_center)[:, 2]) / view.depth[view.depth > 0]
    noise = 3.0 * depth_sigma(view.depth[view.depth > 0]) * slope
    least = np.maximum(np.where(labels > 0, 0.003, 0.015), noise)
    points = points[points[:, 2] > least + 1e-6]
    chosen = np.random.default_rng(seed).choice(len(points), min(POINTS, len(points)), False)
    return points[chosen]


@pytest.fixture(scope="module", params=["mixed", slow("labelled"), slow("unlabelled")])
def fitted(request):
    view = observed(request.param, seed=len(request.param))
    return vp.fit_map(view), seen_points(view, 0)


@pytest.mark.parametrize("bounds", [SMALL, slow(None)], ids=["small grid", "default grid"])
@pytest.mark.parametrize("occluded", ["posterior", slow("occupied"), slow("free")])
def test_no_ball_on_a_seen_point_is_accepted(fitted, ball, occluded, bounds):
    map_, points = fitted
    resolution = 0.01 if bounds else 0.015
    world = vp.World(map_, vp.WorldConfig(resolution, occluded=occluded, bounds=bounds))
    for max_risk in (None, 0.1, 0.9):
        config = vp.CheckerConfig(max_risk=max_risk, n_worlds=64)
        checker = vp.CollisionChecker(world, ball, config)
        accepted = checker.is_valid_batch(points)
        assert not accepted.any(), (max_risk, points[accepted][:3])
        assert not checker.is_valid(points[0])
        assert checker.clearance(points[0]) <= 0.0


@pytest.mark.parametrize("kind", ["unlabelled", slow("labelled")])
def test_what_was_seen_outside_the_grid_has_a_name_and_no_clearance(kind, ball):
    view = observed(kind, seed=3)
    world = vp.World(vp.fit_map(view), vp.WorldConfig(occluded="free", bounds=SMALL))
    checker = vp.CollisionChecker(world, ball, vp.CheckerConfig(max_risk=None))
    points, _ = view.points()
    post = points[(points[:, 0] > 0.6) & (points[:, 2] > 0.15) & (points[:, 2] < 0.2)]
    assert len(post) > 100
    assert not checker.is_valid_batch(post).any()
    (contact,) = checker.explain(post[0]).contacts
    assert contact.kind == ("object" if kind == "labelled" else "background")
    # Nobody looked behind the post: with hidden space free it is free, else it is not.
    ahead = (post[0] - view.camera_center) * (1, 1, 0)
    behind = post[0] + 0.25 * ahead / np.linalg.norm(ahead)
    assert checker.is_valid(behind)
    wary = vp.World(world.map, vp.WorldConfig(bounds=SMALL))
    report = vp.CollisionChecker(wary, ball).explain(behind)
    assert [contact.kind for contact in report.contacts] == ["occluded"]
    # In the open beside it the coarse cells take two steps at most.
    free = post[0] + np.array([-0.3, 0.0, 0.0])
    assert vp.CollisionChecker(wary, ball).clearance(free) > 0.3 - 2 * 0.1 * np.sqrt(3.0) - 0.02


@pytest.mark.slow
def test_farther_than_was_judged_is_refused_and_says_so(ball):
    world = vp.World(vp.fit_map(observed("labelled", seed=3)), vp.WorldConfig(bounds=SMALL))
    checker = vp.CollisionChecker(world, ball)
    (contact,) = checker.explain([0.0, -4.9, 0.5]).contacts
    assert contact.kind == "unobserved"
    assert "bounds" in contact.detail


def _box(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    size, at = rng.uniform(0.03, 0.1, 3), rng.uniform(-0.15, 0.15, 2)
    low = np.array([*(at - size[:2] / 2), 0.0])
    return low, low + size


@pytest.mark.parametrize("seed", [0, *map(slow, range(1, 8))])
def test_nothing_that_the_newest_view_of_a_changing_table_shows_is_accepted(seed, ball):
    rng = np.random.default_rng(seed)
    boxes = {k: _box(rng) for k in (1, 2, 3, 4)}
    plane, map_ = vp.perception.Plane((0.0, 0.0, 1.0), 0.0), None
    for step in range(4):
        if step:  # one has left, one has moved, one has come
            rest = rng.permutation([*boxes])[1:].tolist()
            boxes = {k: boxes[k] for k in rest} | {rest[0]: _box(rng), 10 + step: _box(rng)}
        eye = (-0.75, 0.0, 0.65) if rng.random() < 0.5 else (*rng.uniform(-0.6, 0.6, 2), 0.75)
        pose = look_at(eye, (0.0, 0.0, 0.03))
        depth, labels = Scene(boxes=list(boxes.values()), table=((-1.0, -1.0), (1.0, 1.0))).render(
            pose, K
        )
        sigma = depth_sigma(np.where(depth > 0, depth, 1.0))
        depth = np.where(depth > 0, depth + 0.3 * sigma * rng.standard_normal(depth.shape), 0.0)
        labels = np.array([0, *rng.permutation(len(boxes)) + 1])[labels]
        view = vp.Observation(depth, labels, K, pose, plane=plane)
        if map_ is None:
            map_ = vp.fit_map(view)
            continue
        map_ = map_.update(view)
        points = seen_points(map_.views[-1], step)  # whose masks are mended
        config = vp.CheckerConfig(max_risk=0.9, n_worlds=64)
        world = vp.World(map_, vp.WorldConfig(0.01, bounds=SMALL))
        accepted = vp.CollisionChecker(world, ball, config).is_valid_batch(points)
        assert not accepted.any(), (step, map_.changes, points[accepted][:3])
