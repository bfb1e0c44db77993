# SPDX-License-Identifier: BSD-3-Clause
"""Meshes of a URDF: found wherever packages are, read in metres, and held by spheres."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot
from vprism_plan.robots.geometry import find_mesh
from vprism_plan.robots.report import enclosed, sphere_gap
from vprism_plan.robots.sphere_fit import SphereFit

URDF = """<robot name="meshed"><link name="base"/><link name="tip"><collision>
  <origin xyz="0.1 0 0.2" rpy="0.3 -0.4 1.1"/>
  <geometry><mesh filename="{name}" {scale}/></geometry></collision></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def wedge() -> trimesh.Trimesh:
    """Nothing alike on either side, so that a wrong axis, order or sign shows."""
    return trimesh.Trimesh(
        [[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0], [0, 0, 0.05], [0.2, 0.02, 0.03]],
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 4], [2, 3, 4], [3, 1, 4]],
    )


def urdf(folder, name, scale="", file="r.urdf"):
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(URDF.format(name=name, scale=f'scale="{scale}"' if scale else ""))
    return path


def in_link(points, scale=(1, 1, 1)):
    R = Rotation.from_euler("xyz", [0.3, -0.4, 1.1]).as_matrix()
    return (np.asarray(points) * scale) @ R.T + [0.1, 0.0, 0.2]


QUICK = SphereFit(max_spheres=3)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "dae"])
@pytest.mark.parametrize("scale", [(1, 1, 1), (0.5, -1.0, 2.0)])
def test_every_format_with_origin_and_scale_is_held(tmp_path, suffix, scale):
    wedge().export(tmp_path / f"w.{suffix}")
    path = urdf(tmp_path, f"w.{suffix}", " ".join(map(str, scale)))
    robot = Robot.from_urdf(path, fit=QUICK, matrix_samples=10)
    (mesh,) = (file.mesh() for file in robot.meshes["tip"])
    corners = in_link(wedge().vertices, scale)
    found = np.asarray(mesh.vertices)
    for corner in corners:
        assert np.linalg.norm(found - corner, axis=1).min() < 1e-6
    assert len(found) == 5
    assert mesh.volume > 0.0  # mirrored or not, the outside is outside
    expected = in_link(np.asarray(wedge().triangles).reshape(-1, 3), scale).reshape(-1, 3, 3)
    samples = trimesh.triangles.to_kwargs(expected)
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(**samples), 5000, seed=0)
    assert sphere_gap(points, robot.link_spheres["tip"]).max() <= 1e-6
    assert enclosed(np.asarray(mesh.triangles), robot.link_spheres["tip"])
    assert robot.sphere_sources == {"tip": "fitted"}
    assert robot.report().enclosed


def test_collada_states_its_unit(tmp_path):
    big = wedge()
    big.apply_scale(1000.0)
    big.export(tmp_path / "w.dae")
    text = (tmp_path / "w.dae").read_text()
    assert "<unit" not in text
    unit = '<unit name="millimeter" meter="0.001"/></asset>'
    (tmp_path / "w.dae").write_text(text.replace("</asset>", unit, 1))
    robot = Robot.from_urdf(urdf(tmp_path, "w.dae"), fit=QUICK)
    mesh = robot.meshes["tip"][0].mesh()
    np.testing.assert_allclose(
        np.sort(mesh.edges_unique_length), np.sort(wedge().edges_unique_length), rtol=1e-5
    )


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "elsewhere" / "arm_description" / "meshes"
    folder.mkdir(parents=True)
    wedge().export(folder / "w.stl")
    return folder.parent


NAME = "package://arm_description/meshes/w.stl"


def test_packages_are_found_where_ros_and_people_keep_them(package, tmp_path, monkeypatch):
    lonely = urdf(tmp_path / "a" / "b", NAME)
    target = package / "meshes" / "w.stl"
    assert find_mesh(NAME, lonely, None)[0] is None
    for dirs in (package.parent, [tmp_path, package.parent], package, {"arm_description": package}):
        assert find_mesh(NAME, lonely, dirs)[0] == target
    assert find_mesh(NAME, urdf(package / "urdf", NAME), None)[0] == target
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{package.parent}")
    assert find_mesh(NAME, lonely, None)[0] == target
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    share = tmp_path / "install" / "share"
    share.mkdir(parents=True)
    package.rename(share / "arm_description")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert find_mesh(NAME, lonely, None)[0] == share / "arm_description" / "meshes" / "w.stl"


def test_other_names_are_relative_to_the_urdf_or_absolute(package, tmp_path):
    path = urdf(package / "urdf", NAME)
    target = (package / "meshes" / "w.stl").resolve()
    for name in (
        "../meshes/w.stl",
        f"file://{target}",
        str(target),
        "model://arm_description/meshes/w.stl",
    ):
        assert find_mesh(name, path, None)[0].resolve() == target
    # a checkout under another name
    assert find_mesh("package://other_name/meshes/w.stl", path, None)[0].resolve() == target
    assert find_mesh("http://host/w.stl", path, None)[0] is None


def test_with_spheres_meshes_need_not_be_there(tmp_path):
    spheres = {"tip": [{"center": [0, 0, 0], "radius": 0.1}]}
    robot = Robot.from_urdf(urdf(tmp_path, "package://gone/w.stl"), spheres=spheres)
    report = robot.report()
    assert report.enclosed is None
    assert report.links[0].missing == ("package://gone/w.stl",)
    assert "mesh missing" in report.text()


def test_spheres_that_do_not_hold_a_mesh_are_told_so(tmp_path):
    wedge().export(tmp_path / "w.stl")
    spheres = {"tip": [{"center": [0.1, 0, 0.2], "radius": 0.05}]}
    report = Robot.from_urdf(urdf(tmp_path, "w.stl"), spheres=spheres).report()
    assert report.enclosed is False
    (link,) = report.links
    # the corner that is farthest is a corner, so the sampling sees it exactly
    away = np.linalg.norm(wedge().vertices, axis=1).max() - 0.05
    assert link.bare == pytest.approx(away, abs=1e-6)
    assert 0.0 < link.coverage < 0.5
    assert "no, " in report.text()


def test_a_follower_narrows_what_it_follows(write):
    text = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
      <joint name="drive" type="{kind}"><parent link="a"/><child link="b"/>
        <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
      <joint name="f" type="revolute"><parent link="b"/><child link="c"/>
        <mimic joint="drive" multiplier="-2" offset="0.5"/>
        <limit lower="-0.5" upper="1.5" velocity="1" effort="1"/></joint>
      <joint name="g" type="revolute"><parent link="c"/><child link="d"/><mimic joint="f"/>
        <limit lower="{low}" upper="9" velocity="1" effort="1"/></joint></robot>"""
    ball = [{"center": [0, 0, 0], "radius": 0.1}]
    for kind in ("revolute", "continuous"):
        robot = Robot.from_urdf(write(text.format(kind=kind, low=0.0)), spheres={"d": ball})
        # f = 0.5 - 2 q in [-0.5, 1.5] and g = f in [0, 9]: q in [-0.5, 0.25]
        np.testing.assert_allclose([robot.lower[0], robot.upper[0]], [-0.5, 0.25], atol=1e-12)
        assert not robot.continuous[0]
    with pytest.raises(RobotError, match=r"'g' .* mimics 'drive' .* for no value .* correct the"):
        Robot.from_urdf(write(text.format(kind="revolute", low=8.0)), spheres={"d": ball})


def link(geometry, origin=""):
    return f'<link name="tip"><collision>{origin}<geometry>{geometry}</geometry></collision></link>'


MESH = '<mesh filename="{}"/>'
BALL, FLAT = '<sphere radius="1"/>', '<mesh filename="gone.stl" scale="1 0 1"/>'
BAD = {
    "missing mesh": (link(MESH.format("gone.stl")), r"link 'tip' .*'gone.stl'.*package_dirs="),
    "missing package": (link(MESH.format("package://p/g.stl")), r"link 'tip'.*package://p/g.stl.*package_dirs="),
    "web mesh": (link(MESH.format("http://host/g.stl")), r"link 'tip' .*no such file"),
    "broken mesh": (link(MESH.format("broken.stl")), r"link 'tip': .*broken.stl' "),
    "mesh of no triangles": (link(MESH.format("empty.obj")), r"link 'tip': .*empty.obj'"),
    "mesh of no size": (link(MESH.format("point.obj")), r"link 'tip', .*point.obj'.* 0 m long"),
    "mesh in millimetres": (link(MESH.format("big.obj")), r"big.obj'.* scale=\"0.001"),
    "scale of 0": (link(FLAT), r"link 'tip' .*scale .*; write"),
    "NaN origin": (link(BALL, '<origin xyz="0 nan 0"/>'), r"link 'tip' .*; write finite"),
    "no geometry at all": ('<link name="tip"/>', r"no link has collision geometry; add"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_geometry_names_the_element_and_the_remedy(tmp_path, case):
    (tmp_path / "broken.stl").write_text("solid nothing here")
    (tmp_path / "empty.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (tmp_path / "point.obj").write_text("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n")
    (tmp_path / "big.obj").write_text("v 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3\n")
    body, message = BAD[case]
    path = tmp_path / "r.urdf"
    path.write_text(
        f'<robot name="r"><link name="base"/>{body}<joint name="j" type="revolute">'
        '<parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(path)


def test_a_pair_that_comes_near_in_a_corner_only_is_not_called_never(write):
    """Two arms that reach each other for a small share of configurations only."""
    from vprism_plan.robots.pairs import pair_gaps

    rod = (
        '<collision><origin xyz="0.3 0 0"/><geometry><sphere radius="0.02"/></geometry></collision>'
    )
    parts = ['<robot name="two"><link name="base"/>']
    for side, x in (("l", -0.33), ("r", 0.33)):
        parts += [f'<link name="{side}1"/><link name="{side}2">{rod}</link>']
        for k, (parent, axis) in enumerate([("base", "0 0 1"), (f"{side}1", "0 1 0")], 1):
            parts.append(
                f'<joint name="{side}j{k}" type="continuous"><parent link="{parent}"/>'
                f'<child link="{side}{k}"/><origin xyz="{x if k == 1 else 0} 0 0"/>'
                f'<axis xyz="{axis}"/></joint>'
            )
    robot = Robot.from_urdf(write("".join(parts) + "</robot>"), matrix_samples=50)
    assert frozenset(("l2", "r2")) not in robot.disabled_pairs
    far = Robot.from_urdf(write("".join(parts).replace("0.33", "0.46") + "</robot>"))
    assert far.disabled_pairs[frozenset(("l2", "r2"))] == "Never"
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, size=(500, 4))
    gaps = pair_gaps(far.arrays, q, np.array([[0, 1]]))
    assert gaps.min() > 0.05


def test_pair_gaps_agree_with_a_plain_count(robots):
    from test_kinematics import place_spheres

    from vprism_plan.robots.pairs import pair_gaps

    robot = robots["panda"]
    q = np.random.default_rng(2).uniform(robot.lower, robot.upper, size=(20, robot.dof))
    pairs = robot.collision_pairs
    gaps = pair_gaps(robot.arrays, q, pairs)
    centers = place_spheres(robot.arrays, q)
    for k, (a, b) in enumerate(pairs):
        mine, other = robot.sphere_links == a, robot.sphere_links == b
        apart = np.linalg.norm(centers[:, mine][:, :, None] - centers[:, other][:, None], axis=3)
        exact = (apart - robot.sphere_radii[mine][:, None] - robot.sphere_radii[other]).min((1, 2))
        near = gaps[:, k] <= 0.05
        np.testing.assert_allclose(gaps[near, k], exact[near], atol=1e-12)
        assert (gaps[~near, k] <= exact[~near] + 1e-12).all()


def test_the_second_opinion_takes_the_meshes_themselves(tmp_path):
    from vprism_plan.collision.mesh.solids import robot_solids

    wedge().export(tmp_path / "w.stl")
    robot = Robot.from_urdf(urdf(tmp_path, "w.stl"), fit=QUICK)
    (solid,) = robot_solids(robot, "geometry", None)
    assert solid.shape.kind == "mesh"
    assert solid.closed  # its inside counts
    np.testing.assert_allclose(
        np.ptp(solid.vertices, axis=0), np.ptp(in_link(wedge().vertices), axis=0), atol=1e-6
    )
    # Padding is a distance to keep, and takes no mesh away.
    (padded,) = robot_solids(robot.with_padding(0.01), "geometry", None)
    assert padded.shape.kind == "mesh"
