# SPDX-License-Identifier: BSD-3-Clause
"""The spheres hold the solids: on the shipped robots, and for any tiled solid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.kinematics_oracle import random_pose, transform

from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot, enclosing_spheres
from vprism_plan.robots.geometry import PrimitiveGeometry

sizes = st.floats(0.002, 0.8)


def surface(solid: PrimitiveGeometry, spacing: float) -> np.ndarray:
    """Points on a solid's surface, corners, edges and rims included, link frame."""
    if solid.kind == "sphere":
        n = int(4 * np.pi * solid.size[0] ** 2 / spacing**2) + 50
        i = np.arange(n) + 0.5
        polar, turn = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
        rows = [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)]
        local = solid.size[0] * np.stack(rows, axis=1)
    elif solid.kind == "box":
        axes = [
            np.linspace(-e / 2, e / 2, max(2, int(np.ceil(e / spacing)) + 1)) for e in solid.size
        ]
        faces = []
        for k in range(3):
            for end in (0, -1):
                grid = [axis[[end]] if j == k else axis for j, axis in enumerate(axes)]
                faces.append(np.stack(np.meshgrid(*grid, indexing="ij"), -1).reshape(-1, 3))
        local = np.vstack(faces)
    else:
        radius, length = solid.size
        turn = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius / spacing) + 12, endpoint=False)
        ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        heights = np.linspace(-length / 2, length / 2, max(2, int(np.ceil(length / spacing)) + 1))
        radii = np.linspace(0, radius, max(2, int(np.ceil(radius / spacing)) + 1))
        rows = [np.column_stack([radius * ring, np.full(len(ring), h)]) for h in heights]
        for end in (heights[0], heights[-1]):
            rows += [np.column_stack([r * ring, np.full(len(ring), end)]) for r in radii]
        local = np.vstack(rows)
    return local @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]


def interior(solid: PrimitiveGeometry, n: int, rng: np.random.Generator) -> np.ndarray:
    reach = solid.bounding_radius()
    points = solid.T_link[:3, 3] + rng.uniform(-reach, reach, size=(n, 3))
    return points[solid.signed_distance(points) <= 0]


def gap(spheres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distance of points to the union of spheres, negative inside."""
    distance = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=-1)
    return (distance - spheres[:, 3]).min(axis=1)


def spheres_of(robot: Robot, link: str) -> np.ndarray:
    """The link's spheres in the link frame: at the zero pose, taken back to the link."""
    from test_kinematics import place_spheres

    q = robot.neutral
    mine = robot.sphere_links == robot.link_names.index(link)
    T = np.linalg.inv(robot.link_poses(q)[link])
    centers = place_spheres(robot.arrays, q[None])[0][mine] @ T[:3, :3].T + T[:3, 3]
    return np.column_stack([centers, robot.sphere_radii[mine]])


def uncovered_cells(
    solids: tuple[PrimitiveGeometry, ...], spheres: np.ndarray, finest: float
) -> np.ndarray:
    """Centres of cells of edge `finest` that cannot be shown to be covered.

    Both distances are 1-Lipschitz, so one value at the centre of a cell decides for
    the whole cell; undecided cells are cut in eight. None left: every point of the
    solids is inside a sphere, between samples too.
    """
    reach = np.array([solid.bounding_radius() for solid in solids])[:, None]
    middle = np.array([solid.T_link[:3, 3] for solid in solids])
    edge = 0.016
    axes = [
        np.arange(a, b + edge, edge)
        for a, b in zip((middle - reach).min(0), (middle + reach).max(0), strict=True)
    ]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    while True:
        radius = 0.5 * edge * np.sqrt(3)
        inside = np.min([solid.signed_distance(cells) for solid in solids], axis=0) <= radius
        cells = cells[inside]
        parts = np.array_split(cells, len(cells) // 20000 + 1)
        cells = np.vstack([part[gap(spheres, part) > -radius] for part in parts])
        if len(cells) == 0 or edge <= finest:
            return cells
        edge /= 2
        cells = (cells[:, None] + 0.5 * edge * corners).reshape(-1, 3)


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_spheres_of_shipped_robots_hold_every_solid(robots, name):
    robot = robots[name]
    assert set(robot.geometry) == set(robot.link_names)
    for link, solids in robot.geometry.items():
        spheres = spheres_of(robot, link)
        points = np.vstack([surface(solid, 0.003) for solid in solids])
        assert gap(spheres, points).max() <= 0.0, link
        assert len(uncovered_cells(solids, spheres, 0.00025)) == 0, link


def test_the_proof_of_enclosure_sees_a_small_gap(robots):
    solids = robots["panda"].geometry["panda_link7"]
    spheres = spheres_of(robots["panda"], "panda_link7")
    spheres[:, 3] -= 0.002
    assert len(uncovered_cells(solids, spheres, 0.0005)) > 0


@pytest.mark.parametrize(
    ("name", "mean", "most"), [("panda", 0.012, 0.043), ("ur5e", 0.014, 0.039)]
)
def test_spheres_of_shipped_robots_stay_close_to_the_solids(robots, name, mean, most):
    """How far the spheres stand out of the solids: what planning in clutter loses."""
    robot = robots[name]
    out = []
    for link, solids in robot.geometry.items():
        spheres = spheres_of(robot, link)
        balls = [PrimitiveGeometry("sphere", (r,), transform(np.eye(3), c)) for *c, r in spheres]
        points = np.vstack([surface(ball, 0.006) for ball in balls])
        points = points[gap(spheres, points) > -1e-9]
        out.append(np.min([solid.signed_distance(points) for solid in solids], axis=0))
    excess = np.concatenate(out)
    assert excess.mean() < mean
    assert excess.max() < most


@given(
    kind=st.sampled_from(["box", "cylinder", "sphere"]),
    size=st.tuples(sizes, sizes, sizes),
    seed=st.integers(0, 2**32 - 1),
)
def test_tiles_hold_any_solid(kind, size, seed):
    rng = np.random.default_rng(seed)
    size = size[: {"box": 3, "cylinder": 2, "sphere": 1}[kind]]
    solid = PrimitiveGeometry(kind, size, random_pose(rng))
    spheres = enclosing_spheres(solid)
    points = np.vstack([surface(solid, max(size) / 40), interior(solid, 500, rng)])
    assert gap(spheres, points).max() <= 1e-12
    assert len(spheres) <= 64


@pytest.mark.parametrize(
    ("kind", "size", "limit"),
    [
        ("box", (0.3, 0.05, 0.04), 0.02),
        ("cylinder", (0.05, 0.4), 0.032),
        ("cylinder", (0.1, 0.05), 0.032),
    ],
)
def test_tiles_of_arm_sized_solids_protrude_little(kind, size, limit):
    solid = PrimitiveGeometry(kind, size, np.eye(4))
    for row in enclosing_spheres(solid):
        ball = PrimitiveGeometry("sphere", (row[3],), transform(np.eye(3), row[:3]))
        assert solid.signed_distance(surface(ball, 0.01)).max() < limit


@given(
    kind=st.sampled_from(["box", "cylinder", "sphere"]),
    size=st.tuples(sizes, sizes, sizes),
    seed=st.integers(0, 2**32 - 1),
)
def test_signed_distance_is_zero_on_the_surface_and_lipschitz(kind, size, seed):
    rng = np.random.default_rng(seed)
    size = size[: {"box": 3, "cylinder": 2, "sphere": 1}[kind]]
    solid = PrimitiveGeometry(kind, size, random_pose(rng))
    np.testing.assert_allclose(solid.signed_distance(surface(solid, max(size) / 20)), 0, atol=1e-12)
    a, b = solid.T_link[:3, 3] + rng.normal(size=(2, 200, 3)) * max(size)
    change = np.abs(solid.signed_distance(a) - solid.signed_distance(b))
    assert (change <= np.linalg.norm(a - b, axis=1) + 1e-12).all()
    assert solid.signed_distance(a).max() > -solid.bounding_radius()


def test_urdf_shapes_become_spheres_without_a_sphere_file(urdf_folder, tmp_path):
    """No sphere file beside it: boxes and cylinders are tiled, and still enclosed."""
    copy = tmp_path / "arm.urdf"
    copy.write_text((urdf_folder / "planar3.urdf").read_text())
    robot = Robot.from_urdf(copy)
    for link, solids in robot.geometry.items():
        spheres = spheres_of(robot, link)
        for solid in solids:
            assert gap(spheres, surface(solid, 0.003)).max() <= 1e-12


def test_meshes_without_spheres_are_refused(tmp_path):
    path = tmp_path / "mesh.urdf"
    path.write_text(
        '<robot name="m"><link name="a"/><link name="hull"><collision><geometry>'
        '<mesh filename="package://x/hull.stl"/></geometry></collision></link>'
        '<joint name="j" type="continuous"><parent link="a"/><child link="hull"/></joint></robot>'
    )
    with pytest.raises(
        RobotError, match=r"link 'hull' has the mesh .*hull.stl.*no such file.* or spheres="
    ):
        Robot.from_urdf(path)
    robot = Robot.from_urdf(path, spheres={"hull": [{"center": [0, 0, 0], "radius": 0.1}]})
    assert robot.link_names == ("hull",)
    assert robot.geometry == {}
