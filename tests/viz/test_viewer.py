# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's scene holds the map and the robot, follows its controls, and ends."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.errors import ConfigError, MissingDependencyError
from vprism_plan.simulation import Box, Camera, Scene, render
from vprism_plan.viz.robot_plot import link_meshes
from vprism_plan.viz.viewer import entropy_cloud

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
    base[0, 3], base[2, 3] = -0.5, -0.03
    return vp.Robot.from_urdf(repository / "urdf" / "planar3.urdf", base_pose=base)


@pytest.fixture(scope="module")
def trajectory(arm):
    from vprism_plan.planning import time_parameterize

    return time_parameterize(arm, np.array([[0.9, -0.4, 0.1], [-0.3, 0.4, 0.3]]))


@pytest.fixture(scope="module")
def checker(small_map, arm):
    return vp.CollisionChecker(vp.World(small_map), arm)


@pytest.fixture(scope="module")
def look(checker, trajectory):
    """Which of three views would help a plan that was refused."""
    from vprism_plan.planning import PlanReport, PlanResult

    middle, path = np.array([-0.05, 0.0, 0.03]), trajectory.positions[[0, -1]]
    views = [Camera.orbit(middle, 0.8, turn, 0.7).T_world_camera for turn in (0.3, 2.0, 4.0)]
    refused = PlanResult(None, "too_risky", PlanReport("rrt", 0, 1.0), approximate_path=path)
    return vp.next_view(checker, path[0], path[1], views, result=refused)


@pytest.fixture
def shown(small_map, arm, trajectory):
    from vprism_plan.viz.viewer import Viewer

    viewer = Viewer(small_map, arm, trajectory, resolution=0.02, port=0)
    yield viewer
    viewer.stop()


@pytest.fixture
def story(small_map, checker, look):
    from vprism_plan.viz.viewer import Viewer

    viewer = Viewer(small_map, checker=checker, look=look, resolution=0.02, port=0)
    yield viewer
    viewer.stop()


def test_the_scene_holds_views_map_and_robot(shown, arm, small_map):
    expected = {"/objects/4", "/objects/7", "/points/0/seen", "/cameras/0", "/entropy/cloud",
                "/robot/spheres", "/robot/path"}  # fmt: skip
    solids = link_meshes({}, arm.geometry)
    expected |= {f"/robot/solids/{link}/{number}" for link, number, _ in solids}
    assert set(shown.nodes) == expected
    points, labels = small_map.views[0].points()
    seen = shown.nodes["/points/0/seen"]
    np.testing.assert_allclose(seen.points, points[labels > 0], atol=1e-3)
    assert len(np.unique(seen.colors, axis=0)) == 2


def test_every_view_is_shown_by_its_own_box_also_one_that_saw_no_object(small_map):
    from vprism_plan.viz.viewer import Viewer

    first, down = small_map.views[0], np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = 1.0, 1.0, 0.5  # over the bare table
    bare = np.full(first.shape, 0.5), np.zeros(first.shape, np.int32)
    away = vp.Observation(*bare, first.intrinsics, down)
    viewer = Viewer(small_map.update(away), resolution=0.03, port=0)
    try:
        assert "/points/1/seen" not in viewer.nodes
        seen = viewer.nodes["/points/0/seen"]
        viewer.controls["view 1"].value = True
        assert seen.visible
        viewer.controls["view 0"].value = False
        assert not seen.visible
        np.testing.assert_allclose(viewer.nodes["/cameras/1"].position, down[:3, 3])
    finally:
        viewer.stop()


def test_the_path_is_coloured_by_its_risk_and_the_best_view_stands_where_it_is(story, look, arm):
    risk = story.risk.per_waypoint
    assert risk.min() == 0.0
    assert risk.max() > 0.5
    pieces = story.nodes["/robot/path"]
    assert len(pieces.points) == len(risk) - 1
    red = pieces.colors[:, 0, 0].astype(float) - pieces.colors[:, 0, 2]
    assert red[risk[:-1] == risk.max()].min() > red[risk[:-1] == 0.0].max()
    np.testing.assert_allclose(story.trajectory.positions[-1], look.plan.approximate_path[-1])
    assert look.best is not None
    frustum = story.nodes["/next/view"]
    np.testing.assert_allclose(frustum.position, look.views[look.best][:3, 3], atol=1e-6)
    assert len(story.nodes["/next/others"].points) == len(look.views)


_LABEL = "[...document.querySelectorAll('label')].find(l => l.innerText === 'objects')"
_TIME = "[...document.querySelectorAll('[role=slider]')].at(-1)"
_RISK = "[...document.querySelectorAll('p')].find(p => p.innerText.includes(' here: '))"
_END = "new KeyboardEvent('keydown', {key: 'End', bubbles: true})"


def test_a_browser_shows_all_of_it_and_its_slider_moves_the_robot(story, look, tmp_path):
    pytest.importorskip("PyQt6.QtWebEngineWidgets", exc_type=ImportError)
    from matplotlib.image import imread

    there = f" {story.risk.per_waypoint[-1]:.2f}"
    scripts = [
        f"{_LABEL} && document.querySelector('canvas') && document.body.innerText",
        f"document.getElementById({_LABEL}.htmlFor).click() || true",
        f"{_TIME}.focus(), {_TIME}.dispatchEvent({_END}), {_RISK}.innerText.endsWith('{there}')",
    ]
    program = [sys.executable, str(Path(__file__).with_name("browser.py")), story.url, tmp_path]
    done = subprocess.run(
        [*program, *scripts], capture_output=True, text=True, timeout=90, check=False
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["errors"] == []
    for text in ("view 0", "P(occupied)", story.risk.text(), look.text()):
        assert text in said["answers"][0]
    assert "P(collision) here: 0.00" in said["answers"][0]
    ends = story.robot.sphere_centers(look.plan.approximate_path[-1:])[0]
    np.testing.assert_allclose(story.nodes["/robot/spheres"].batched_positions, ends, atol=1e-6)
    whole, without, moved = (imread(tmp_path / f"{n}.png")[:, :900, :3] for n in range(3))
    assert len(np.unique((255 * whole).astype(np.uint8).reshape(-1, 3), axis=0)) > 500
    for one, other in ((whole, without), (without, moved)):  # the objects cover 0.2 %
        assert (np.abs(one - other).max(axis=2) > 0.1).mean() > 0.0005


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


def test_entropy_is_drawn_where_it_is(small_map, shown):
    points, nats = entropy_cloud(small_map, 0.02)
    np.testing.assert_allclose(nats, small_map.entropy(points))
    assert (small_map.support(points) > 0).all()
    shown.show_entropy(0.4)
    drawn = shown.nodes["/entropy/cloud"]
    np.testing.assert_allclose(drawn.points, points[nats >= 0.4], atol=1e-3)
    brightness = drawn.colors.astype(float).sum(axis=1)
    assert np.corrcoef(brightness, nats[nats >= 0.4])[0, 1] > 0.9


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


@pytest.mark.parametrize("goal", [(1.3, -0.2, 0.2), (-0.3, 0.8, 0.6)])
def test_the_command_serves_a_plan_until_it_is_interrupted(
    goal, small_map, repository, tmp_path, monkeypatch, capsys
):
    from vprism_plan.viz.viewer import Viewer

    small_map.save(tmp_path / "map.safetensors")
    urdf, plan = repository / "urdf" / "planar3.urdf", tmp_path / "plan"
    ends = ["--start", 0.9, -0.4, 0.1, "--goal", *goal, "--max-risk", 0.05]
    place = ["--base-xyz", -0.5, 0.0, 0.0, "--base-yaw", 0.0, "--output", plan]
    asked = ["plan", tmp_path / "map.safetensors", "--robot", urdf, *ends, *place, "--json"]
    refused = main([str(a) for a in asked])
    report = json.loads(capsys.readouterr().out)
    assert refused == (report["plan"]["status"] == "too_risky") == (goal[0] < 0.0)
    viewers = []

    def interrupt(self):
        viewers.append(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "wait", interrupt)
    arguments = ["view", plan, "--robot", urdf, "--port", "0", "--json"]
    assert main([str(a) for a in arguments]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"/robot/path", "/next/others"} <= set(said["nodes"])
    assert ("/next/view" in said["nodes"]) == refused
    (viewer,) = viewers
    np.testing.assert_array_equal(viewer.robot.base_pose, report["base_pose"])
    path = report["approximate_path"] if refused else report["path"]
    np.testing.assert_allclose(viewer.trajectory.positions[-1], path[-1])
    planned = report["plan"]["risk"]["probability"]
    assert viewer.risk.probability == pytest.approx(planned, abs=0.05)
    assert said["next_view"].startswith(f"P(collision) is {planned:.2f}; ")
    other = ["view", plan, "--robot", repository / "urdf" / "ur5e.urdf", "--port", "0"]
    if not refused:
        assert main([str(a) for a in other]) == 2
        assert "planned for the joints" in capsys.readouterr().err
    (plan / "report.json").write_text("{}")
    assert main([str(a) for a in arguments]) == 2
    assert "is not a report of `plan`" in capsys.readouterr().err


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
