# SPDX-License-Identifier: BSD-3-Clause
"""An arm that stands in its own picture, between the camera and the objects."""

import numpy as np
import pytest
import torch

import vprism_plan as vp
from vprism_plan.perception import ignore_self
from vprism_plan.simulation import solids as shapes
from vprism_plan.simulation.camera import DepthNoise
from vprism_plan.simulation.scenes import Scene, demo_scene, render

Q = np.array([1.165, 0.402, -0.404, -2.102, -1.637, 1.372, -2.476])
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=float)
MARGIN = 0.005
ROOM = MARGIN + 2.0 * 0.01  # metres: what the documentation says is enough
HIDDEN = 0.025  # metres, radius of a ball behind the arm


def solids_of(robot: vp.Robot, q: np.ndarray) -> list[shapes.Solid]:
    """The robot's own solids, not its spheres, as the camera sees them."""
    placed: list[shapes.Solid] = []
    for link, T in robot.link_poses(q).items():
        for solid in robot.geometry.get(link, ()):
            pose, size = T @ solid.T_link, solid.size
            if solid.kind == "box":
                placed.append(shapes.Box((size[0] / 2, size[1] / 2, size[2] / 2), pose=pose))
            elif solid.kind == "cylinder":
                placed.append(shapes.cylinder(size[0], size[1] / 2, pose))
            else:
                placed.append(shapes.sphere(size[0], pose))
    return placed


class Setting:
    """The demo scene, a Panda before it, and a ball that only the arm hides."""

    def __init__(self, repository) -> None:
        self.robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=BASE)
        scene = demo_scene()
        self.arm = solids_of(self.robot, Q)
        eye = scene.camera.center
        hand = self.robot.link_poses(Q)["panda_hand"][:3, 3]
        self.axis = (hand - eye) / np.linalg.norm(hand - eye)
        # 4 cm clear of the robot's spheres: nearer, `room` says that it is not there.
        pose = np.eye(4)
        pose[:3, 3] = hand + 0.18 * self.axis
        self.hidden = shapes.sphere(HIDDEN, pose)
        solids = (*scene.solids, *self.arm, self.hidden)
        labels = (*scene.labels, *[0] * len(self.arm), 7)
        self.truth = Scene(
            (*scene.solids, self.hidden), (*scene.labels, 7), scene.camera, None, 0, ""
        )
        full = Scene(solids, labels, scene.camera, None, 0, "arm")
        self.seen = render(full, scene.camera, noise=DepthNoise(), seed=3)
        assert 7 not in self.seen.object_ids
        self.marked = ignore_self(self.seen, self.robot, Q, room=ROOM)

    def checker(self, observation, robot, **config) -> vp.CollisionChecker:
        world = vp.World(vp.fit_map(observation, seed=0), vp.WorldConfig(**config))
        return vp.CollisionChecker(world, robot, vp.CheckerConfig(margin=MARGIN))


@pytest.fixture(scope="module")
def setting(repository) -> Setting:
    return Setting(repository)


@pytest.fixture(scope="module")
def checker(setting) -> vp.CollisionChecker:
    return setting.checker(setting.marked, setting.robot)


def test_the_pictured_configuration_is_refused_without_the_filter_and_valid_with_it(
    setting, checker
):
    assert "0.025 m around them counts as free by your word" in " ".join(checker.warnings)
    report = setting.checker(setting.seen, setting.robot).explain(Q)
    assert not report.valid
    bodies = {contact.body for contact in report.contacts}
    assert bodies >= {"background", "occluded"}
    assert checker.is_valid(Q)
    assert checker.explain(Q).shares["occluded"] == 0.0
    assert checker.clearance(Q) > MARGIN


@pytest.fixture(scope="module")
def strict(setting) -> vp.CollisionChecker:
    """Without anybody's word: only the robot's own solids are known to be free."""
    return setting.checker(ignore_self(setting.seen, setting.robot, Q), setting.robot)


def test_all_that_the_arm_hides_is_refused_and_the_remedy_named(setting, strict, ball_robot):
    """Points in its shadow up to its very surface, where collision spheres stand out of it."""
    assert strict.warnings == ()
    report = strict.explain(Q)
    assert {contact.body for contact in report.contacts} == {"occluded"}
    assert "ignore_self(..., room=0.025) is your word for it" in report.text()
    small = vp.CollisionChecker(strict.world, ball_robot(0.005))
    image, eye = setting.marked.point_image(), setting.seen.camera_center
    on_arm = image[setting.marked.sees_robot]
    on_arm = on_arm[:: len(on_arm) // 300]
    ways = (on_arm - eye) / np.linalg.norm(on_arm - eye, axis=1, keepdims=True)
    checked = 0
    for distance in np.arange(0.03, 0.3, 0.01):
        points = on_arm + distance * ways
        gap = np.min([solid.signed_distance(points) for solid in setting.arm], axis=0)
        behind = (gap > 0.001) & (points[:, 2] > 0.0)
        assert not small.is_valid_batch(points[behind]).any()
        checked += int((behind & (gap < 0.02)).sum())
    assert checked > 200


def test_space_behind_the_arm_is_refused(setting, checker, ball_robot):
    """Rays through the middle of the arm, from a hand's breadth behind it to the table."""
    small = vp.CollisionChecker(checker.world, ball_robot(0.01))
    image, eye = setting.marked.point_image(), setting.seen.camera_center
    on_arm = image[setting.marked.sees_robot]
    on_arm = on_arm[:: len(on_arm) // 400]
    ways = (on_arm - eye) / np.linalg.norm(on_arm - eye, axis=1, keepdims=True)
    centers = setting.robot.sphere_centers(torch.tensor(Q)).numpy()
    grid = checker.world.grid
    checked = 0
    for distance in np.arange(0.05, 0.5, 0.05):
        points = on_arm + distance * ways
        gap = np.linalg.norm(points[:, None] - centers, axis=2) - setting.robot.sphere_radii
        behind = (gap.min(axis=1) > 0.03) & (points[:, 2] > 0.0)
        behind &= ((points > grid.origin) & (points < grid.upper)).all(axis=1)
        assert not small.is_valid_batch(points[behind]).any()
        checked += behind.sum()
    assert checked > 500
    report = small.explain(setting.hidden.center)
    assert "occluded" in {contact.body for contact in report.contacts}


def test_nothing_accepted_touches_what_the_arm_hides(setting, checker, ball_robot):
    rng = np.random.default_rng(0)
    for radius in (0.01, 0.03):
        small = vp.CollisionChecker(checker.world, ball_robot(radius))
        near = setting.hidden.center + rng.normal(size=(4000, 3)) * 0.04
        touching = setting.hidden.signed_distance(near) <= radius
        assert touching.sum() > 500
        assert not small.is_valid_batch(near)[touching].any()


def test_space_before_the_arm_stays_free(setting, checker, ball_robot):
    small = vp.CollisionChecker(checker.world, ball_robot(0.01))
    eye = setting.seen.camera_center
    on_arm = setting.marked.point_image()[setting.marked.sees_robot]
    front = eye + (on_arm[:: len(on_arm) // 300] - eye) * 0.85
    assert small.is_valid_batch(front).mean() > 0.95


def test_moving_on_into_its_own_shadow_is_refused(setting, checker):
    """Configurations near the pictured one: none that is accepted touches the hidden ball."""
    rng = np.random.default_rng(1)
    Qs = Q + rng.normal(size=(1500, 7)) * 0.25
    Qs = np.clip(Qs, setting.robot.lower, setting.robot.upper)
    valid = checker.is_valid_batch(Qs)
    assert 5 < valid.sum() < len(Qs)
    centers = setting.robot.sphere_centers(torch.tensor(Qs)).numpy()
    moving = ~setting.robot.fixed_links[setting.robot.sphere_links]
    gap = setting.truth.signed_distance(centers.reshape(-1, 3)).reshape(len(Qs), -1)
    touching = (gap <= setting.robot.sphere_radii)[:, moving].any(axis=1)
    assert touching.sum() > 20
    assert not (valid & touching).any()
