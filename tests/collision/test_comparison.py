# SPDX-License-Identifier: BSD-3-Clause
"""Where field and meshes disagree: a constructed case of every kind, and one that never is."""

from types import SimpleNamespace

import numpy as np
import pytest
from oracles.world_oracles import KernelMap, random_map

import vprism_plan as vp
from vprism_plan.collision import compare
from vprism_plan.collision.mesh.comparison import (
    CAUSES,
    Cause,
    Comparison,
    PathFinding,
    PathOpinion,
    causes_between,
)
from vprism_plan.collision.reports import Contact
from vprism_plan.errors import RobotError
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box
from vprism_plan.world.config import HalfSpace, Sphere

SLIDER = """<robot name="slider">
  <link name="world"/><link name="x"/><link name="y"/>
  <link name="tool"><collision><geometry><box size="{edge} {edge} {edge}"/></geometry></collision>
  </link>{joints}
</robot>"""
SLIDE = """<joint name="{n}" type="prismatic"><parent link="{p}"/><child link="{c}"/>
  <axis xyz="{a}"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>"""
# One blob, and nothing that a camera saw or missed.
BLOB = KernelMap(
    np.zeros((1, 3)), np.array([[-6.0, 6.0]]), np.array([3.0, 0.0]), kernel_length=0.03
)


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    """A function that makes a cube (edge, metres) in a sphere (radius) that moves freely."""
    folder = tmp_path_factory.mktemp("slider")

    def make(edge, radius):
        chain = [
            ("x", "world", "x", "1 0 0"),
            ("y", "x", "y", "0 1 0"),
            ("z", "y", "tool", "0 0 1"),
        ]
        joints = "\n".join(SLIDE.format(n=n, p=p, c=c, a=a) for n, p, c, a in chain)
        path = folder / f"{edge}.urdf"
        path.write_text(SLIDER.format(edge=edge, joints=joints))
        spheres = {"tool": [{"center": [0.0, 0.0, 0.0], "radius": radius}]}
        return vp.Robot.from_urdf(path, spheres=spheres)

    return make


def bounded(map_, **options):
    lower, upper = map_.support_bounds()
    options = {"occluded": "free", **options}
    return vp.World(map_, vp.WorldConfig(bounds=(lower - 0.1, upper + 0.1), **options))


@pytest.fixture(scope="module")
def blob():
    return bounded(BLOB, known=(Sphere("pot", 0.04, (0.0, 0.25, 0.0)),))


@pytest.fixture(scope="module")
def edge_of_blob(blob):
    """Where the x axis leaves the level set, metres."""
    x = np.linspace(0.0, 0.1, 100_001)
    points = np.column_stack([x, 0.0 * x, 0.0 * x])
    return float(x[BLOB.occupancy(points) >= 0.5].max())


def upright(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = [x, y, z]
    return pose


@pytest.fixture(scope="module")
def seen():
    """A labelled box with a 4 mm bar that the map smooths away, and a box without a label."""
    box = Box((0.04, 0.04, 0.05), pose=upright(0.0, 0.0, 0.05))
    bar = Box((0.002, 0.15, 0.002), pose=upright(0.0, 0.1, 0.13))
    clutter = Box((0.03, 0.03, 0.03), pose=upright(0.0, -0.25, 0.03))
    camera = Camera.orbit(np.array([0.0, 0.0, 0.08]), 0.8, np.pi, 0.6)
    scene = Scene((box, bar, clutter), (1, 1, 0), camera, None, 3)
    # A wide kernel forgets what is thin; the default's narrow one holds most of the bar.
    return scene, vp.fit_map(scene.observation, vp.MapConfig.fine(), prior=None)


def only(checker, meshes, q):
    """The one disagreement on q, and which kinds its causes have."""
    comparison = compare(checker, meshes, np.atleast_2d(q))
    (found,) = comparison.disagreements
    assert found.index == 0
    return found, {cause.kind for cause in found.causes}


# --- the field refuses, meshes accept ---------------------------------------------------


@pytest.mark.parametrize("body", ["object:1", "known:pot"])
def test_conservative_spheres(blob, slider, edge_of_blob, body):
    robot = slider(0.02, 0.03)
    checker, meshes = vp.CollisionChecker(blob, robot), vp.MeshChecker(blob, robot)
    q = [edge_of_blob + 0.02, 0.0, 0.0] if body == "object:1" else [0.06, 0.25, 0.0]
    found, kinds = only(checker, meshes, q)
    assert found.mesh_valid
    assert kinds == {"conservative spheres"}
    assert found.causes[0].body == body
    assert found.causes[0].amount == pytest.approx(0.01, abs=5e-4)  # what the cube has left
    # With its spheres as links, FCL refuses it, too.
    spheres = vp.MeshChecker(blob, robot, links="spheres")
    assert not spheres.is_valid(q)
    assert compare(checker, spheres, [q]).both_refused == 1


@pytest.mark.parametrize("body", ["object:1", "known:pot"])
def test_margin(blob, ball_robot, edge_of_blob, body):
    robot = ball_robot(0.02)
    checker = vp.CollisionChecker(blob, robot, vp.CheckerConfig(margin=0.04))
    q = [edge_of_blob + 0.05, 0.0, 0.0] if body == "object:1" else [0.09, 0.25, 0.0]
    found, kinds = only(checker, vp.MeshChecker(blob, robot), q)
    assert kinds == {"margin"}
    assert found.causes[0].body == body
    assert found.causes[0].amount == pytest.approx(0.03, abs=2e-3)


def test_margin_to_a_plane(ball_robot):
    world = bounded(random_map(0), known=(HalfSpace("wall", (1, 0, 0), -0.5),))
    robot = ball_robot(0.02)
    checker = vp.CollisionChecker(world, robot, vp.CheckerConfig(margin=0.05))
    found, kinds = only(checker, vp.MeshChecker(world, robot), [-0.45, 0.0, 0.3])
    assert kinds == {"margin"}
    assert found.causes[0].amount == pytest.approx(0.03)


def test_voxel_inflation(blob, ball_robot, edge_of_blob):
    robot = ball_robot(0.02)
    checker, meshes = vp.CollisionChecker(blob, robot), vp.MeshChecker(blob, robot)
    directions = np.random.default_rng(0).normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    Q = directions * (edge_of_blob + 0.02 + 0.002)
    comparison = compare(checker, meshes, Q)
    assert comparison.disagreements
    assert comparison.counts() == {"voxel inflation": len(comparison.disagreements)}
    for found in comparison.disagreements:
        assert 0.0 < found.causes[0].amount < 1.5 * blob.config.resolution


def test_occluded(seen, ball_robot):
    _, map_ = seen
    config = vp.WorldConfig(occluded="occupied")
    world, robot = vp.World(map_, config), ball_robot(0.01)
    behind = np.array([0.1, 0.0, 0.06])
    assert world.status(behind[None])[0] == 1
    checker = vp.CollisionChecker(world, robot)
    found, kinds = only(checker, vp.MeshChecker(world, robot, seen=False), behind)
    assert kinds == {"occluded"}
    assert found.mesh_valid
    assert "no camera saw" in found.causes[0].text()
    assert compare(checker, vp.MeshChecker(world, robot), [behind]).both_refused == 1


def test_background_and_thin_parts(seen, ball_robot):
    scene, map_ = seen
    world, robot = vp.World(map_, vp.WorldConfig(occluded="free")), ball_robot(0.004)
    checker = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=None))
    meshes = vp.MeshChecker(world, robot, seen=False)
    points, _ = scene.observation.points()
    _, bar, clutter = scene.solids
    on_clutter = points[(np.abs(clutter.signed_distance(points)) < 1e-3) & (points[:, 2] > 0.04)]
    comparison = compare(checker, meshes, on_clutter[::120])
    assert comparison.counts() == {"background": len(on_clutter[::120])}
    on_bar = points[(np.abs(bar.signed_distance(points)) < 1e-3) & (points[:, 1] > 0.12)]
    missed = on_bar[map_.occupancy(on_bar) < 0.2][::20]
    comparison = compare(checker, meshes, missed)
    assert "thin seen part" in comparison.counts()
    assert set(comparison.counts()) <= {"thin seen part", "voxel inflation"}
    assert not comparison.mesh_refuses
    # By the images, FCL's checker refuses all of them as well.
    seen_points = np.concatenate([on_clutter[::120], missed])
    assert compare(checker, vp.MeshChecker(world, robot), seen_points).both_refused == len(
        seen_points
    )


def test_what_a_camera_saw_is_held_against_any_map(seen, ball_robot):
    """The images have a say of their own: a field that lost a thing is told so."""
    scene, map_ = seen
    world, robot = vp.World(map_, vp.WorldConfig(occluded="occupied")), ball_robot(0.004)
    meshes, lost = vp.MeshChecker(world, robot), Free(world, robot)
    points, _ = scene.observation.points()
    _, bar, clutter = scene.solids
    for solid, body in ((bar, "object:1"), (clutter, "background")):
        there = points[(np.abs(solid.signed_distance(points)) < 1e-3) & (points[:, 2] > 0.05)]
        (found,) = compare(lost, meshes, there[:1]).mesh_refuses
        cause = next(c for c in found.causes if c.body == body)
        assert cause.kind == "seen by a camera"
        assert "missed what a camera saw" in cause.text()
    behind = [0.1, 0.0, 0.06]
    _, kinds = only(lost, meshes, behind)
    assert kinds == {"missed by the field"}
    (contact,) = meshes.contacts(behind)
    assert contact.body == "occluded"
    assert "no camera saw this space" in contact.text()


def test_unobserved(ball_robot):
    world, robot = bounded(BLOB, unobserved="occupied"), ball_robot(0.01)
    meshes = vp.MeshChecker(world, robot, seen=False)
    _, kinds = only(vp.CollisionChecker(world, robot), meshes, [0.12, 0.12, 0.12])
    assert kinds == {"unobserved"}
    (contact,) = vp.MeshChecker(world, robot).contacts([0.12, 0.12, 0.12])
    assert contact.body == "unobserved"


def test_too_small_for_the_mesh(ball_robot):
    """A blob of 3 mm between the nodes of a coarse mesh; the field's octree finds it."""
    speck = KernelMap(
        np.full((1, 3), 0.005), np.array([[-6.0, 6.0]]), np.array([11.7, 0.0]), kernel_length=0.02
    )
    world, robot = bounded(speck), ball_robot(0.02)
    meshes = vp.MeshChecker(world, robot, resolution=0.01)
    assert meshes.surfaces.meshes == {}
    found, kinds = only(vp.CollisionChecker(world, robot), meshes, [0.03, 0.005, 0.005])
    assert kinds == {"too small for the mesh"}
    assert found.causes[0].body == "object:1"


@pytest.mark.parametrize("who", ["field", "mesh"])
def test_contact_rules(blob, ball_robot, edge_of_blob, who):
    robot, rules = ball_robot(0.02), {"ball": {1}}
    config = vp.CheckerConfig(allowed_contacts=rules if who == "field" else {})
    other = vp.CheckerConfig(allowed_contacts={} if who == "field" else rules)
    meshes = vp.MeshChecker(blob, robot, other)
    q = [edge_of_blob + 0.01, 0.0, 0.0]
    found, kinds = only(vp.CollisionChecker(blob, robot, config), meshes, q)
    assert kinds == {"contact rules"}
    assert found.field_valid == (who == "field")


# --- meshes refuse, the field accepts ---------------------------------------------------


@pytest.mark.parametrize("body", ["object:1", "known:pot"])
def test_solids_outside_spheres(blob, slider, edge_of_blob, body):
    robot = slider(0.06, 0.01)
    q = [edge_of_blob + 0.025, 0.0, 0.0] if body == "object:1" else [0.065, 0.25, 0.0]
    found, kinds = only(vp.CollisionChecker(blob, robot), vp.MeshChecker(blob, robot), q)
    assert found.field_valid
    assert kinds == {"solids outside spheres"}
    assert found.causes[0].body == body


def test_coarse_meshes_reach_beyond_the_level_set(ball_robot):
    """Why the default mesh has the field's lattice: a coarser one refuses what is free."""
    world, robot = bounded(random_map(0)), ball_robot(0.0005)
    checker = vp.CollisionChecker(world, robot)
    coarse = vp.MeshChecker(world, robot, resolution=0.045)
    fine = vp.MeshChecker(world, robot)
    Q = np.concatenate([mesh.triangles_center for mesh in coarse.surfaces.meshes.values()])
    comparison = compare(checker, coarse, Q)
    beyond = comparison.mesh_refuses
    assert beyond
    assert {cause.kind for found in beyond for cause in found.causes} == {"coarse mesh"}
    assert not compare(checker, fine, Q).mesh_refuses


class Free:
    """A checker that calls everything free."""

    def __init__(self, world, robot, **config):
        self.world, self.robot = world, robot
        self.config = SimpleNamespace(
            **{"margin": 0.0, "max_risk": None, "allowed_contacts": {}, **config}
        )

    def is_valid(self, q):
        return True

    def explain(self, q):
        return SimpleNamespace(valid=True, contacts=())


@pytest.mark.parametrize(
    ("depth", "config", "kind"),
    [
        (5e-6, {}, "rounding"),
        (5e-3, {}, "missed by the field"),
        (5e-3, {"max_risk": 0.5}, "posterior risk"),
        (5e-3, {"max_risk": 0.05}, "missed by the field"),  # the level set judges, too
    ],
)
def test_what_a_field_should_never_accept(blob, ball_robot, depth, config, kind):
    robot = ball_robot(0.02)
    meshes = vp.MeshChecker(blob, robot)
    (mesh,) = meshes.surfaces.meshes.values()
    _, kinds = only(Free(blob, robot, **config), meshes, mesh.triangles_center[0] + 0.0)
    assert kinds == {"missed by the field" if kind == "rounding" else kind}
    start, normal = mesh.triangles_center[7], mesh.face_normals[7]
    found, kinds = only(Free(blob, robot, **config), meshes, start + (0.02 - depth) * normal)
    assert kinds == {kind}
    assert found.causes[0].amount == pytest.approx(depth, abs=1e-4 if depth > 1e-4 else 5e-6)


def test_limits_and_nonsense_have_no_excuse(blob, ball_robot):
    robot = ball_robot(0.02)
    _, kinds = only(Free(blob, robot), vp.MeshChecker(blob, robot), [5.0, 0.0, 0.0])
    assert kinds == {"unexplained"}
    with pytest.raises(RobotError, match="shape"):
        compare(Free(blob, robot), vp.MeshChecker(blob, robot), [0.0, 0.0, 0.0])
    with pytest.raises(RobotError, match="not finite"):
        compare(Free(blob, robot), vp.MeshChecker(blob, robot), [[0.0, 0.0, np.nan]])


def test_a_risk_that_refuses_is_named(blob, ball_robot):
    robot = ball_robot(0.02)
    risk = Contact("risk", "ball", "object:1", 0.1, probability=0.3)
    checker = Free(blob, robot)
    checker.explain = lambda q: SimpleNamespace(valid=False, contacts=(risk,))
    (cause,) = causes_between(checker, vp.MeshChecker(blob, robot), np.array([1.0, 1.0, 1.0]))
    assert cause.kind == "posterior risk"


def test_what_both_refuse_is_the_tolerance_of_an_edge(blob, ball_robot, edge_of_blob):
    """Of a path: the edge was accepted to within its tolerance, the configuration is refused."""
    robot = ball_robot(0.02)
    checker, meshes = vp.CollisionChecker(blob, robot), vp.MeshChecker(blob, robot, step=0.001)
    path = np.array([[edge_of_blob + 0.019, y, 0.0] for y in (-0.2, 0.2)])
    opinion = meshes.review(checker, path)
    assert not opinion.valid
    (found,) = opinion.findings
    assert {cause.kind for cause in found.causes} == {"edge tolerance"}
    assert found.edge == 0
    assert 0.45 < found.fraction < 0.5
    for word in ("edge 0", "ball", "object:1", "edge tolerance", "1 mm apart"):
        assert word in opinion.text()
    assert meshes.review(checker, path + np.array([0.05, 0.0, 0.0])).valid


def test_both_free_or_both_refused_is_no_disagreement(blob, ball_robot):
    robot = ball_robot(0.02)
    checker, meshes = vp.CollisionChecker(blob, robot), vp.MeshChecker(blob, robot)
    comparison = compare(checker, meshes, [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]])
    assert comparison == Comparison(2, 1, ())
    assert causes_between(checker, meshes, np.array([1.0, 1.0, 1.0])) == ()
    assert "2 free and 1 refused" in comparison.text()


def test_every_kind_can_be_spoken():
    for kind in CAUSES:
        assert kind in Cause(kind, "ball", "object:1", 0.01).text()
    opinion = PathOpinion(False, 0.005, 3, (PathFinding(1, 0.25, (0.0,), ()),))
    assert "edge 1 at 0.250" in opinion.text()


# --- never ----------------------------------------------------------------------------


def at_the_surface(meshes, radius, rng, n):
    """Centres whose ball just touches, or just misses, a mesh; some on the field's nodes."""
    points = []
    for mesh in meshes.surfaces.meshes.values():
        faces = rng.integers(0, len(mesh.faces), n)
        weights = rng.dirichlet((0.5, 0.5, 0.5), n)  # many near edges and corners
        on_it = np.einsum("ni,nij->nj", weights, mesh.triangles[faces])
        points.append(on_it + rng.uniform(radius - 1e-3, radius + 1e-3, (n, 1))
                      * mesh.face_normals[faces])  # fmt: skip
    points = np.concatenate(points)
    step = meshes.world.config.resolution
    nodes = np.round(points[: len(points) // 2] / step) * step
    return np.concatenate([points, nodes])


@pytest.mark.parametrize("seed", range(3))
def test_spheres_that_touch_a_mesh_are_never_free_for_the_field(seed, ball_robot):
    """At the surface, in every hollow, at the nodes where the field is tightest."""
    map_ = random_map(seed, objects=1 + seed % 2)
    world = bounded(map_, level=[0.5, 0.3, 0.7][seed])
    rng = np.random.default_rng(seed)
    for radius in (0.0015, 0.02):
        robot = ball_robot(radius)
        checker = vp.CollisionChecker(world, robot)
        meshes = vp.MeshChecker(world, robot)
        Q = at_the_surface(meshes, radius, rng, 150)
        touching = ~np.array([meshes.is_valid(q) for q in Q])
        assert touching.sum() > 60
        assert not np.any(checker.is_valid_batch(Q) & touching)
        assert set(compare(checker, meshes, Q[::20]).counts()) <= {"voxel inflation"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat_world", "demo_world"])
def test_a_panda_in_the_demo_scene(kind, request, repository):
    """Solids within enclosing spheres: what the field accepts, no surface contradicts."""
    base = np.eye(4)
    base[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    base[:3, 3] = [0.05, -0.6, 0.0]
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)
    map_ = request.getfixturevalue(kind).map
    world = vp.World(map_, vp.WorldConfig(occluded="free"))
    checker = vp.CollisionChecker(world, robot)
    rng = np.random.default_rng(0)
    Q = rng.uniform(robot.lower, robot.upper, (30_000, robot.dof))
    Q = Q[checker.self_clearance_batch(Q) > 0]
    clearance = checker.clearance_batch(Q)
    near = Q[[*np.argsort(np.abs(clearance))[:80], *np.argsort(np.abs(clearance + 0.02))[:40]]]
    # Seen points less than 4 mm off a guess's level set are obstacles by the images alone.
    seen = map_.prior is None
    solids = vp.MeshChecker(world, robot, seen=seen)
    spheres = vp.MeshChecker(world, robot, links="spheres", seen=seen)
    for meshes in (solids, spheres):
        touching = ~np.array([meshes.is_valid(q) for q in near])
        assert touching.sum() > 10
        assert not np.any(checker.is_valid_batch(near) & touching)
    causes = {c.kind for d in compare(checker, solids, near[:60]).disagreements for c in d.causes}
    assert "conservative spheres" in causes
    assert "unexplained" not in causes
