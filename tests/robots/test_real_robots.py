# SPDX-License-Identifier: BSD-3-Clause
"""Robots as their makers publish them, unmodified: read, held by spheres, planned with."""

import numpy as np
import pytest
import yourdfpy
from real_robots import ROBOTS, found

import vprism_plan as vp
from vprism_plan.robots import Robot
from vprism_plan.robots.report import sphere_gap
from vprism_plan.robots.surfaces import link_triangles, surface_samples


@pytest.fixture(scope="module", params=list(ROBOTS))
def real(request):
    files = found(request.param)
    if files is None:
        pytest.skip(f"needs the package {ROBOTS[request.param].package}: pip install it")
    robot = Robot.from_urdf(
        files.urdf, srdf=files.srdf, group=files.group, joints=files.joints, matrix_samples=300
    )
    return files, robot


def test_every_link_is_held_by_its_spheres(real):
    _, robot = real
    report = robot.report()
    assert report.enclosed is True
    assert report.spheres == len(robot.sphere_radii)
    for link in report.links:
        solids, meshes = robot.geometry.get(link.link, ()), robot.meshes.get(link.link, ())
        surface = link_triangles(solids, meshes, sides=1024)  # cylinders, all but exactly
        spheres = [solid for solid in solids if solid.kind == "sphere"]
        if not spheres:  # the polyhedron around a sphere is larger than the sphere
            gap = sphere_gap(surface_samples(surface, 2000, seed=1), robot.link_spheres[link.link])
            assert gap.max() <= 0.0, link.link
        assert link.coverage == 1.0


def test_kinematics_are_those_of_yourdfpy(real):
    files, robot = real
    model = yourdfpy.URDF.load(str(files.urdf), load_meshes=False)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = robot.random_configuration(rng)
        model.update_cfg(dict(zip(robot.joint_names, q.tolist(), strict=True)) | robot.locked)
        for link, T in robot.link_poses(q).items():
            other = model.get_transform(link, model.base_link)
            np.testing.assert_allclose(T, other, atol=1e-6, err_msg=link)


def test_followers_stay_in_their_own_limits(real):
    files, robot = real
    joints = yourdfpy.URDF.load(str(files.urdf), load_meshes=False).joint_map
    ends = dict(zip(robot.joint_names, np.column_stack([robot.lower, robot.upper]), strict=True))
    for name, joint in joints.items():
        if joint.mimic is not None and joint.mimic.joint in ends and joint.type != "continuous":
            values = joint.mimic.multiplier * ends[joint.mimic.joint] + joint.mimic.offset
            assert joint.limit.lower - 1e-9 <= values.min(), name
            assert values.max() <= joint.limit.upper + 1e-9, name


def test_it_can_be_planned_with(real, demo_world):
    """Away from the objects of the scene, over its table."""
    files, robot = real
    pose = np.eye(4)
    pose[:3, 3] = [-3.0, 0.0, files.height]
    checker = vp.CollisionChecker(demo_world, robot.with_base_pose(pose))
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(3000):
        near = rng.normal(ends[0], 0.4) if ends else robot.random_configuration(rng)
        q = np.clip(near, robot.lower, robot.upper)
        if checker.is_valid(q):
            ends.append(q)
            if len(ends) == 2:
                break
    assert len(ends) == 2, "hardly any configuration is free"
    result = vp.plan(checker, *ends, planner="RRTConnect", time_limit=20.0, seed=0)
    assert result.solved, result.message
