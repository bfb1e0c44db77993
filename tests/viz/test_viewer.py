# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's scene holds the map and the robot, follows its controls, and ends."""

import json
import urllib.request

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.errors import ConfigError, MissingDependencyError
from vprism_plan.simulation import Box, Camera, Scene, render
from vprism_plan.viz.robot_plot import link_meshes
from vprism_plan.viz.viewer import EntropyVolume

viser = pytest.importorskip("viser", reason="viser is not installed (extra `viewer`)")


@pytest.fixture(scope="module")
def small_map():
    """Two boxes, one of them hidden in part."""
    pinhole = np.array([[152.0, 0.0, 79.5], [0.0, 152.0, 59.5], [0.0, 0.0, 1.0]])
    size = {"width": 160, "height": 120, "intrinsics": pinhole}
    camera = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.8, 0.3, 0.7, **size)
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, 3], poses[1][:3, 3] = [0.0, 0.0, 0.05], [-0.1, 0.02, 0.03]
    solids = (Box((0.03, 0.03, 0.05), pose=poses[0]), Box((0.03, 0.03, 0.03), pose=poses[1]))
    view = render(Scene(solids, (4, 7), camera), camera)
    return vp.fit_map(view, vp.MapConfig(hinge_spacing=0.05, iterations=2))


@pytest.fixture(scope="module")
def arm(repository):
    base = np.eye(4)
    base[0, 3] = -0.5
    return vp.Robot.from_urdf(repository / "urdf" / "planar3.urdf", base_pose=base)


@pytest.fixture
def trajectory(arm):
    from vprism_plan.planning import time_parameterize

    return time_parameterize(arm, np.array([[0.3, 0.2, 0.1], [1.0, -0.4, 0.6]]))


@pytest.fixture
def shown(small_map, arm, trajectory):
    from vprism_plan.viz.viewer import Viewer

    viewer = Viewer(small_map, arm, trajectory, resolution=0.02, port=0)
    yield viewer
    viewer.stop()


def test_the_scene_holds_map_and_robot_and_a_browser_is_served(shown, arm):
    expected = {"/objects/4", "/objects/7", "/points/4", "/points/7", "/cameras/0",
                "/entropy/cloud", "/entropy/slice", "/robot/spheres", "/robot/path"}  # fmt: skip
    assert expected <= set(shown.nodes)
    assert {f"/robot/solids/{link}/0" for link in arm.geometry} <= set(shown.nodes)
    with urllib.request.urlopen(shown.url, timeout=10) as page:
        assert b"<html" in page.read().lower()


def test_the_robot_follows_the_trajectory(shown, arm, trajectory):
    import torch

    shown.controls["time"].value = trajectory.duration
    shown.place_robot(trajectory.positions[-1])
    centers = arm.sphere_centers(torch.tensor(trajectory.positions[-1])).numpy()
    drawn = shown.nodes["/robot/spheres"].batched_positions
    np.testing.assert_allclose(drawn, centers, atol=1e-6)
    np.testing.assert_allclose(shown.nodes["/robot/spheres"].batched_scales, arm.sphere_radii)


def test_a_higher_level_leaves_less_of_every_object(shown):
    def volume():
        import trimesh

        node = shown.nodes["/objects/4"]
        return trimesh.Trimesh(node.vertices, node.faces).volume

    middling = volume()
    shown.show_level(0.9)
    assert volume() < middling
    shown.show_level(0.5)
    assert volume() == pytest.approx(middling)


def test_boxes_hide_what_they_name_also_when_it_is_drawn_again(shown):
    shown.controls["objects"].value = False
    shown.show_level(0.6)
    assert not shown.nodes["/objects/4"].visible
    shown.show_entropy(10.0)  # more than there can be
    assert "/entropy/cloud" not in shown.nodes
    shown.show_entropy(0.1)
    assert shown.nodes["/entropy/cloud"].visible


def test_entropy_is_drawn_where_it_is(small_map):
    volume = EntropyVolume(small_map, 0.02)
    points, _ = volume.cloud(0.4)
    assert len(points)
    assert (small_map.entropy(points.astype(np.float64)) > 0.4 - 1e-5).all()
    assert (small_map.support(points.astype(np.float64)) > 0).all()
    mesh = volume.slice(0.05)
    assert np.abs(mesh.vertices[:, 2] - 0.05).max() <= 0.01 + 1e-9
    colors = mesh.visual.vertex_colors[:, :3].astype(float)
    known = (colors != 200).any(axis=1)  # grey where the map repeats its prior
    support = small_map.support(np.asarray(mesh.vertices))
    assert support[known].min() > support[~known].max()
    entropy = small_map.entropy(np.asarray(mesh.vertices))
    assert np.corrcoef(colors[known].sum(axis=1), entropy[known])[0, 1] > 0.9


def test_solids_move_with_their_links(shown, arm):
    from scipy.spatial.transform import Rotation

    q = np.array([0.3, -0.7, 1.1])
    shown.place_robot(q)
    solids = {(link, number): mesh for link, number, mesh in link_meshes({}, arm.geometry)}
    assert {link for link, _ in solids} == set(arm.geometry)
    for (link, number), mesh in solids.items():
        node, T = shown.nodes[f"/robot/solids/{link}/{number}"], arm.link_poses(q)[link]
        np.testing.assert_allclose(node.vertices, mesh.vertices, atol=1e-6)
        corner = np.array([0.1, 0.2, 0.3])
        turned = Rotation.from_quat(node.wxyz, scalar_first=True).apply(corner)
        np.testing.assert_allclose(turned + node.position, T[:3, :3] @ corner + T[:3, 3], atol=1e-6)


def test_meshes_are_shown_where_their_links_are(small_map, tmp_path):
    import trimesh

    from vprism_plan.viz.viewer import Viewer

    corners = trimesh.creation.box((0.1, 0.2, 0.3))
    corners.export(tmp_path / "part.stl")
    (tmp_path / "robot.urdf").write_text("""<robot name="one"><link name="base"/><link name="arm">
      <collision><origin xyz="0 0 0.5"/><geometry><mesh filename="part.stl"/></geometry></collision>
      </link><joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
      <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint></robot>""")
    robot = vp.Robot.from_urdf(tmp_path / "robot.urdf")
    viewer = Viewer(small_map, robot, resolution=0.03, port=0)
    try:
        (node,) = (n for path, n in viewer.nodes.items() if path.startswith("/robot/solids/"))
        assert node is viewer.nodes["/robot/solids/arm/mesh0"]
        low, high = node.vertices.min(axis=0), node.vertices.max(axis=0)
        np.testing.assert_allclose([low, high], [[-0.05, -0.1, 0.35], [0.05, 0.1, 0.65]], atol=1e-6)
        viewer.place_robot(np.array([np.pi / 2]))
        np.testing.assert_allclose(node.wxyz, [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-6)
        np.testing.assert_allclose(node.position, 0.0, atol=1e-6)
    finally:
        viewer.stop()


def test_joints_move_by_hand_without_a_trajectory(small_map, arm):
    from vprism_plan.viz.viewer import Viewer

    viewer = Viewer(small_map, arm, resolution=0.03, port=0)
    try:
        assert set(arm.joint_names) <= set(viewer.controls)
        before = viewer.nodes["/robot/spheres"].batched_positions.copy()
        viewer.place_robot(arm.neutral + 0.5)
        assert np.abs(viewer.nodes["/robot/spheres"].batched_positions - before).max() > 0.1
    finally:
        viewer.stop()


def test_a_trajectory_needs_its_robot(small_map, trajectory):
    from vprism_plan.viz.viewer import Viewer

    with pytest.raises(ConfigError, match="no robot"):
        Viewer(small_map, None, trajectory, port=0)


def test_without_viser_the_message_names_the_extra(monkeypatch, tmp_path, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    from vprism_plan.viz.viewer import require_viser

    with pytest.raises(MissingDependencyError, match=r"vprism_plan\[viewer\]"):
        require_viser()
    assert main(["view", str(tmp_path)]) == 2
    assert "vprism_plan[viewer]" in capsys.readouterr().err


def test_the_command_serves_a_plan_until_it_is_interrupted(
    small_map, arm, trajectory, repository, tmp_path, monkeypatch, capsys
):
    from vprism_plan.planning import write_trajectory
    from vprism_plan.viz.viewer import Viewer

    small_map.save(tmp_path / "map.safetensors")
    write_trajectory(tmp_path / "trajectory.json", arm, trajectory, frame_id="world")
    report = {"base_pose": arm.base_pose.tolist()}
    (tmp_path / "report.json").write_text(json.dumps(report))
    stood = []

    def interrupt(self):
        stood.append(self.robot.base_pose)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "wait", interrupt)
    urdf = repository / "urdf" / "planar3.urdf"
    arguments = ["view", tmp_path, "--robot", urdf, "--port", "0", "--json"]
    assert main([str(a) for a in arguments]) == 0
    said = json.loads(capsys.readouterr().out)
    assert "/robot/path" in said["nodes"]
    np.testing.assert_array_equal(stood[0], arm.base_pose)
    other = ["view", tmp_path, "--robot", repository / "urdf" / "ur5e.urdf", "--port", "0"]
    assert main([str(a) for a in other]) == 2
    assert "planned for the joints" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["empty folder", "a view", "nothing"])
def test_what_is_no_map_and_no_plan_is_bad_input(what, tmp_path, capsys):
    path = tmp_path
    if what == "a view":
        path = tmp_path / "view.npz"
        path.write_bytes(b"")
    elif what == "nothing":
        path = tmp_path / "absent.safetensors"
    assert main(["view", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line
