# SPDX-License-Identifier: BSD-3-Clause
"""Random scenes with an arm in the picture: what stands beside and behind it stays an obstacle.

The map says "empty" everywhere, so that nothing but what was seen and what was hidden counts.
"""

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.world_oracles import KernelMap
from scipy.spatial.transform import Rotation

from vprism_plan.perception import Observation, Plane, ignore_robot, ignore_self
from vprism_plan.robots import Robot
from vprism_plan.simulation import solids as shapes
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene, render
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.visibility import depth_sigma

K = np.array([[230.0, 0.0, 119.5], [0.0, 230.0, 89.5], [0.0, 0.0, 1.0]])
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
PADDING = 0.01
ARM, THING = 99, 50  # the renderer's labels: the arm, and from 50 on what carries no label
SMALL = 0.005  # metres, radius of the balls that must not be accepted


def placed(center, rotation=None) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = center
    if rotation is not None:
        pose[:3, :3] = rotation.as_matrix()
    return pose


def random_arm(rng, folder) -> tuple[Robot, list[shapes.Solid]]:
    """Boxes, cylinders and balls in a row in the air; spheres stand out of them by a lot."""
    parts, solids, spheres = [], [], []
    middle = np.array([rng.uniform(-0.08, 0.0), rng.uniform(-0.1, 0.1), rng.uniform(0.15, 0.25)])
    for _ in range(3):
        rotation = Rotation.random(random_state=rng)
        pose = placed(middle, rotation)
        kind = rng.integers(3)
        if kind == 0:
            half = rng.uniform(0.015, 0.06, 3)
            shape = '<box size="{} {} {}"/>'.format(*(2 * half))
            solids.append(shapes.Box(tuple(half.tolist()), pose=pose))
        elif kind == 1:
            radius, half = rng.uniform(0.015, 0.05), rng.uniform(0.02, 0.08)
            shape = f'<cylinder radius="{radius}" length="{2 * half}"/>'
            solids.append(shapes.cylinder(radius, half, pose))
        else:
            radius = rng.uniform(0.02, 0.05)
            shape = f'<sphere radius="{radius}"/>'
            solids.append(shapes.sphere(radius, pose))
        roll, pitch, yaw = rotation.as_euler("xyz")
        xyz = " ".join(map(str, middle))
        parts.append(
            f'<collision><origin xyz="{xyz}" rpy="{roll} {pitch} {yaw}"/>'
            f"<geometry>{shape}</geometry></collision>"
        )
        fat = solids[-1].bounding_radius + 0.03
        spheres.append({"center": middle.tolist(), "radius": fat})
        middle = middle + rng.uniform(-0.05, 0.05, 3) + [0.0, 0.06, 0.0]
    text = (
        f'<robot name="arm"><link name="base"/><link name="arm">{"".join(parts)}</link>'
        '<joint name="x" type="prismatic"><parent link="base"/><child link="arm"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (folder / "arm.urdf").write_text(text)
    return Robot.from_urdf(folder / "arm.urdf", spheres={"arm": spheres}), solids


def gap_to(solids, points) -> np.ndarray:
    return np.min([solid.signed_distance(points) for solid in solids], axis=0)


def random_things(rng, arm) -> list[shapes.Solid]:
    """Small things close to the arm, beside and behind it, none in it."""
    things: list[shapes.Solid] = []
    while len(things) < 4:
        center = rng.choice(arm).center + rng.uniform(-0.14, 0.14, 3) + [0.03, 0.0, 0.0]
        half = rng.uniform(0.008, 0.03, 3)
        thing = shapes.Box(
            tuple(half.tolist()), pose=placed(center, Rotation.random(random_state=rng))
        )
        inside = thing.surface_points(0.004)
        if center[2] > 0.06 and gap_to(arm, inside).min() > 0.002:
            things.append(thing)
    return things


def picture(rng, arm, things, labels) -> tuple[Observation, np.ndarray]:
    """What a camera before the arm sees, and what each pixel truly shows."""
    eye = (-0.65, rng.uniform(-0.3, 0.3), rng.uniform(0.35, 0.6))
    camera = Camera.look_at(
        np.array(eye), np.array([0.0, 0.05, 0.18]), intrinsics=K, width=240, height=180
    )
    shown = Scene((*things, *arm), (*labels, *[ARM] * len(arm)), camera)
    exact = render(shown, camera)
    depth = np.asarray(exact.depth, dtype=np.float64)
    noise = np.clip(rng.normal(size=depth.shape), -3.0, 3.0) * 0.0015 * depth**2
    seen = np.where(exact.labels < THING, exact.labels, 0)
    noisy = np.where(depth > 0, depth + noise, 0.0)
    return Observation(noisy, seen, camera.intrinsics, camera.T_world_camera), exact.labels


def world_of(*views: Observation, **config) -> World:
    hinges, weights = np.array([[5.0, 5.0, 0.0]] * 2), np.array([[1.0, -1.0]] * 2)
    map_ = KernelMap(hinges, weights, np.array([6.0, 0.0]), views=views, plane=TABLE)
    ids = tuple(sorted({i for view in views for i in view.object_ids})) or (1,)
    map_ = dataclasses.replace(
        map_, object_ids=ids, weights=np.tile([[1.0, *[-1.0] * len(ids)]], (2, 1)),
        bias=np.array([6.0, *[0.0] * len(ids)]),
    )  # fmt: skip
    return World(map_, WorldConfig(bounds=((-0.2, -0.25, 0.0), (0.25, 0.4, 0.4)), **config))


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_only_the_robots_own_solids_are_cleared_and_masked(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    robot, arm = random_arm(rng, tmp_path_factory.mktemp("arm"))
    things = random_things(rng, arm)
    raw, truth = picture(rng, arm, things, (1, 2, THING, THING + 1))
    obs = ignore_self(raw, robot, [0.0], PADDING, remove_flying=False)
    np.testing.assert_array_equal(obs.labels, raw.labels)
    points = obs.point_image()
    depth = np.asarray(obs.depth, dtype=np.float64)
    stated = PADDING + 3.0 * 0.002 * np.maximum(depth, 0.5) ** 2
    gap = gap_to(arm, points.reshape(-1, 3)).reshape(depth.shape)

    # Pixels of the arm are no obstacles, and no others are taken for it than stated.
    assert obs.sees_robot[truth == ARM].all()
    assert (gap[obs.sees_robot] <= stated[obs.sees_robot] + 1e-6).all()

    world = world_of(obs)
    grid = world.grid
    in_grid = ((points > grid.origin) & (points < grid.upper)).all(axis=-1)
    # Nothing that was seen is given away: with a label wherever it is, without one beyond that.
    other = (truth > 0) & (truth != ARM) & in_grid & (points[..., 2] > 0.02)
    kept = other & ((obs.labels > 0) | (gap > stated))
    assert kept.sum() > 20
    assert (world.field.lower_bound(points[kept]) <= SMALL).all()

    # Nothing hidden is given away, up to the surface of the solids.
    eye = obs.camera_center
    asked = rng.uniform((-0.15, -0.2, 0.02), (0.2, 0.35, 0.38), (6000, 3))
    asked = asked[gap_to(arm, asked) > 1e-4]
    way = asked - eye
    first = np.min([solid.intersect(eye, way) for solid in (*arm, *things)], axis=0)
    reach = (asked - eye) @ obs.pose[:3, 2]
    slack = np.maximum(0.01, 3.0 * depth_sigma(first * reach)) + 3.0 * 0.0015 * reach**2
    pixels = (np.linalg.inv(obs.pose)[:3, :3] @ way.T).T @ K.T
    inside = (pixels[:, :2] / pixels[:, 2:] > 1).all(axis=1)
    inside &= (pixels[:, :2] / pixels[:, 2:] < np.array([238, 178])).all(axis=1)
    hidden = inside & ((1.0 - first) * reach > slack)
    assert hidden.sum() > 100
    assert (world.field.lower_bound(asked[hidden]) <= 0.0).all()


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_labelled_things_within_balls_that_stand_out_of_the_arm_stay(tmp_path_factory, seed):
    """Also where unobserved space counts as occupied, and with the word for some room."""
    rng = np.random.default_rng(seed)
    robot, arm = random_arm(rng, tmp_path_factory.mktemp("arm"))
    things = random_things(rng, arm)
    raw, truth = picture(rng, arm, things, (1, 2, 3, 4))
    centers = np.array([solid.center for solid in arm])
    radii = np.array([solid.bounding_radius + 0.06 for solid in arm])
    by_hand = ignore_robot(raw, centers, radii, remove_flying=False)
    with_word = ignore_self(raw, robot, [0.0], PADDING, room=0.03, remove_flying=False)
    eye = raw.camera_center
    for obs in (by_hand, with_word):
        np.testing.assert_array_equal(obs.labels, raw.labels)
        world = world_of(obs, unobserved="occupied")
        points = obs.point_image()
        seen = (truth > 0) & (truth != ARM) & (points[..., 2] > 0.01)
        assert (world.field.lower_bound(points[seen]) <= SMALL).all()
        for thing in things:
            # Its inside, where it is the first that the camera sees.
            asked = thing.center + rng.uniform(-0.03, 0.03, (300, 3))
            asked = asked[thing.signed_distance(asked) < -SMALL]
            own = thing.intersect(eye, asked - eye)
            rest = [solid.intersect(eye, asked - eye) for solid in (*arm, *things)]
            asked = asked[own <= np.min(rest, axis=0)]
            if len(asked):
                assert (world.field.lower_bound(asked) <= SMALL).all()
