# SPDX-License-Identifier: BSD-3-Clause
"""FCL's second opinion against signed distances of the solids, point by point."""

import functools
import itertools
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from oracles.world_oracles import random_map
from scipy.spatial.transform import Rotation

import vprism_plan as vp
from vprism_plan.collision.mesh import fcl
from vprism_plan.errors import ConfigError, MissingDependencyError, RobotError
from vprism_plan.perception import Plane
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.world.config import Box, Cylinder, HalfSpace, KnownMesh, Sphere

REACH = 0.1  # metres: gaps beyond it are not measured
DENSE = 0.003  # metres: no point of a sampled surface is farther from a sample

FLYER = """<robot name="flyer">
  <link name="stand"><collision><origin xyz="0 0 0.45"/><geometry><box size="0.1 0.1 0.1"/>
    </geometry></collision></link>
  <link name="lx"/><link name="ly"/><link name="lz"/><link name="rx"/><link name="ry"/>
  <link name="body">
    <collision><origin xyz="0.02 0 0" rpy="0.3 0.2 0"/><geometry><box size="0.05 0.03 0.08"/>
      </geometry></collision>
    <collision><origin xyz="0 0.06 0" rpy="0.5 0 0.4"/><geometry>
      <cylinder radius="0.02" length="0.09"/></geometry></collision>
  </link>
  <link name="arm">
    <collision><origin xyz="0.05 0 0"/><geometry><sphere radius="0.03"/></geometry></collision>
    <collision><origin xyz="0.1 0 0" rpy="0 1.5 0"/><geometry>
      <cylinder radius="0.012" length="0.1"/></geometry></collision>
  </link>
  {joints}
</robot>"""
JOINT = """<joint name="{n}" type="{kind}"><parent link="{p}"/><child link="{c}"/>{o}
  <axis xyz="{a}"/><limit lower="-{l}" upper="{l}" velocity="1" effort="1"/></joint>"""
CHAIN = [
    ("x", "prismatic", "stand", "lx", "1 0 0", 0.5),
    ("y", "prismatic", "lx", "ly", "0 1 0", 0.5),
    ("z", "prismatic", "ly", "lz", "0 0 1", 0.5),
    ("a", "revolute", "lz", "rx", "1 0 0", 3),
    ("b", "revolute", "rx", "ry", "0 1 0", 3),
    ("c", "revolute", "ry", "body", "0 0 1", 3),
    ("d", "revolute", "body", "arm", "0 1 0", 2),
]
SRDF = """<robot name="flyer"><group name="hand"><link name="arm"/></group></robot>"""


@pytest.fixture(scope="module")
def flyer(tmp_path_factory):
    """Box, cylinders and a sphere that go anywhere; its stand does not move."""
    path = tmp_path_factory.mktemp("flyer") / "flyer.urdf"
    joints = "\n".join(
        JOINT.format(n=n, kind=k, p=p, c=c, a=a, l=lim, o='<origin xyz="0 0.1 0"/>' * (n == "d"))
        for n, k, p, c, a, lim in CHAIN
    )
    path.write_text(FLYER.format(joints=joints))
    path.with_suffix(".srdf").write_text(SRDF)
    return vp.Robot.from_urdf(path, joints=[joint[0] for joint in CHAIN])


def bounded(map_, **options):
    lower, upper = map_.support_bounds()
    return vp.World(map_, vp.WorldConfig(bounds=(lower - 0.05, upper + 0.05), **options))


def make(world, robot, **options):
    """Meshes coarser than the default: sooner made, and as good for what is tested here."""
    allowed = options.pop("allowed_contacts", {})
    config = vp.CheckerConfig(allowed_contacts=allowed, margin=options.pop("margin", 0.0))
    return vp.MeshChecker(world, robot, config, resolution=0.008, **options)


@pytest.fixture(scope="module")
def known():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (0.4, 0.2, 0.9)).as_matrix()
    pose[:3, 3] = [0.25, 0.0, 0.2]
    tilted = pose.copy()
    tilted[:3, 3] = [0.0, 0.3, 0.1]
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh.apply_translation([-0.25, 0.1, 0.15])
    return (
        Box("crate", (0.06, 0.1, 0.04), pose),
        Sphere("ball", 0.05, (0.0, -0.25, 0.2)),
        Cylinder("can", 0.03, 0.1, tilted),
        KnownMesh("pot", mesh),
        HalfSpace("wall", (1.0, 0.2, 0.0), -0.35),
    )


@pytest.fixture(scope="module")
def world(known):
    map_ = random_map(5, plane=Plane((0.0, 0.0, 1.0), 0.0))
    return bounded(map_, known=known, occluded="free")


@pytest.fixture(scope="module")
def checker(world, flyer):
    return make(world, flyer, step=0.02)


@dataclass
class Truth:
    """Signed distances by formula, from every solid to points all over every surface."""

    world: object
    robot: object
    surfaces: dict
    links: tuple = ("body", "arm")

    @classmethod
    def of(cls, checker):
        meshes = {f"object:{i}": mesh for i, mesh in checker.surfaces.meshes.items()}
        for item in checker.world.config.known:
            if isinstance(item, KnownMesh):
                meshes[f"known:{item.name}"] = item.mesh
            elif not isinstance(item, HalfSpace):
                meshes[f"known:{item.name}"] = surface_of(item)
        points = {
            name: trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, DENSE)[0]
            for name, mesh in meshes.items()
        }
        return cls(checker.world, checker.robot, points)

    def solids(self, q):
        poses = self.robot.link_poses(q)
        return [(poses[n], s, n) for n in self.links for s in self.robot.geometry[n]]

    def gap(self, q):
        """Signed distance from the moving solids to the world; negative also if swallowed."""
        best = np.inf
        for T, solid, _ in self.solids(q):
            center = T[:3, :3] @ solid.T_link[:3, 3] + T[:3, 3]
            for name, points in self.surfaces.items():
                near = np.linalg.norm(points - center, axis=1) < solid.bounding_radius() + REACH
                if near.any():
                    local = (points[near] - T[:3, 3]) @ T[:3, :3]
                    best = min(best, solid.signed_distance(local).min())
                if self._inside(name, center):
                    best = min(best, -DENSE)
            outer = outline_of(T, solid)
            for plane in self.world.planes:
                best = min(best, (outer @ plane[:3] - plane[3]).min() - solid.padding)
        return best

    def _inside(self, name, center):
        kind, label = name.split(":")
        if kind == "object":
            p = self.world.map.predict_proba(center[None])[0]
            own = self.world.map.object_ids.index(int(label)) + 1
            return p[1:].sum() >= 0.5 and 1 + int(np.argmax(p[1:])) == own
        item = next(k for k in self.world.config.known if k.name == label)
        if isinstance(item, KnownMesh):
            return bool(item.mesh.contains(center[None])[0])
        return item.signed_distance(center[None])[0] < 0.0


def surface_of(item):
    if isinstance(item, Sphere):
        return trimesh.creation.icosphere(4, item.radius).apply_translation(item.center)
    if isinstance(item, Box):
        return trimesh.creation.box(item.size, transform=item.T_world)
    return trimesh.creation.cylinder(item.radius, item.length, 64, transform=item.T_world)


@functools.cache
def outline(kind, size):
    """Points all over a primitive's surface, at most about 4 mm apart, in its own frame."""
    if kind == "sphere":
        return np.asarray(trimesh.creation.icosphere(4, size[0]).vertices)
    if kind == "box":
        box = trimesh.creation.box(size)
        return trimesh.remesh.subdivide_to_size(box.vertices, box.faces, 0.004)[0]
    radius, length = size
    turn = np.linspace(0.0, 2.0 * np.pi, 64)
    heights = np.linspace(-0.5, 0.5, 30) * length
    caps = [(r, z) for r in np.linspace(0.0, radius, 8) for z in heights[[0, -1]]]
    rings = np.array([*caps, *((radius, z) for z in heights)])
    x, y = np.outer(rings[:, 0], np.cos(turn)), np.outer(rings[:, 0], np.sin(turn))
    return np.stack([x, y, np.broadcast_to(rings[:, 1:], x.shape)], axis=-1).reshape(-1, 3)


def outline_of(T, solid):
    """World points on a solid's surface."""
    pose = T @ solid.T_link
    return outline(solid.kind, tuple(solid.size)) @ pose[:3, :3].T + pose[:3, 3]


def near_things(rng, n):
    """Configurations of the flyer among the obstacles."""
    Q = rng.uniform(-1.0, 1.0, (n, 7)) * [0.3, 0.3, 0.2, 3, 3, 3, 2]
    Q[:, 2] += 0.15
    return Q


def self_free(robot, q):
    """Far from the stand, which is only tested against the other links."""
    return all(
        np.linalg.norm(robot.link_poses(q)[name][:3, 3] - [0, 0, 0.45]) > 0.3
        for name in ("body", "arm")
    )


@pytest.mark.parametrize("padding", [0.0, 0.015])
def test_verdicts_and_distances_are_those_of_the_formulas(world, flyer, padding):
    """Padded solids are grown all around: what comes nearer than the padding touches."""
    flyer = flyer.with_padding(padding) if padding else flyer
    checker = make(world, flyer)
    truth = Truth.of(checker)
    rng = np.random.default_rng(0)
    hits = misses = 0
    for q in near_things(rng, 80):
        gap, distance = truth.gap(q), checker.clearance(q)
        if abs(gap) < 2 * DENSE:
            continue
        if gap < 0:
            assert not checker.is_valid(q)
            assert distance <= 0.0
            assert max(contact.depth for contact in checker.contacts(q)) > 0.0
            hits += 1
        else:
            if min(gap, distance) < REACH:
                assert gap - DENSE < distance < gap + 1e-5
            if self_free(flyer, q):
                assert checker.is_valid(q)
                assert checker.contacts(q) == ()
                misses += 1
    assert hits > 15
    assert misses > 5


@pytest.mark.parametrize("links", ["geometry", "spheres"])
def test_the_three_answers_agree_with_one_another(world, flyer, links):
    checker = make(world, flyer, links=links, allowed_contacts={"hand": {1}})
    rng = np.random.default_rng(1)
    names = {*world.plane_names, *world.sources, *flyer.link_names}
    for q in near_things(rng, 90):
        contacts = checker.contacts(q)
        assert checker.is_valid(q) == (not contacts)
        of_world = [c for c in contacts if c.kind not in {"self", "joint_limit"}]
        assert (checker.clearance(q) <= 0.0) == bool(of_world)
        depths = [contact.depth for contact in contacts]
        assert depths == sorted(depths, reverse=True)
        assert len({(c.link, c.body) for c in contacts}) == len(contacts)
        for contact in contacts:
            assert contact.depth >= 0.0
            assert contact.link in flyer.link_names
            assert contact.body in names
            assert np.linalg.norm(contact.normal) == pytest.approx(1.0)
            assert (contact.sphere >= 0) == (links == "spheres")
            assert (contact.link, contact.body) != ("arm", "object:1")
            assert (contact.probability is not None) == (contact.kind == "object")
            assert contact.required == 0.0


def test_spheres_are_judged_exactly(world, ball_robot):
    """Depth and distance of a ball: distance of its centre by trimesh, less its radius."""
    from trimesh.proximity import closest_point

    radius = 0.02
    checker = make(world, ball_robot(radius), links="spheres")
    rng = np.random.default_rng(2)
    Q = rng.uniform(*world.map.support_bounds(), (80, 3))
    Q = Q[Q[:, 2] > 0.03]
    for q in Q:
        best = min(float((world.planes[:, :3] @ q - world.planes[:, 3]).min()) - radius, np.inf)
        for item in world.config.known:
            if not isinstance(item, HalfSpace | KnownMesh):
                best = min(best, float(item.signed_distance(q[None])[0]) - radius)
        pot = next(k.mesh for k in world.config.known if isinstance(k, KnownMesh))
        owner = checker.surfaces.object_at(q[None])[0]
        for i, mesh in {**checker.surfaces.meshes, None: pot}.items():
            _, (way,), _ = closest_point(mesh, q[None])
            held = pot.contains(q[None])[0] if i is None else owner == i
            best = min(best, (-way if held else way) - radius)
        assert checker.clearance(q) == pytest.approx(best, abs=5e-6)
        for contact in checker.contacts(q):
            assert contact.sphere == 0
            if contact.depth == pytest.approx(-best, abs=5e-6):
                break
        else:
            assert best > 0.0


def test_what_is_wholly_inside_is_a_collision(world, ball_robot):
    """FCL sees no contact there: the map says what is inside."""
    map_ = world.map
    for i in map_.object_ids:
        mesh = make(world, ball_robot(0.001)).surfaces.meshes[i]
        inside = mesh.vertices.mean(axis=0)
        points = inside + np.random.default_rng(0).uniform(-0.02, 0.02, (200, 3))
        p = map_.predict_proba(points)
        deep = points[(p[:, 1:].sum(axis=1) > 0.9) & (np.argmax(p, axis=1) == i)][:20]
        assert len(deep)
        small = make(world, ball_robot(0.001))
        for q in deep:
            assert not small.is_valid(q)
            assert small.clearance(q) < 0.0
            contact = next(c for c in small.contacts(q) if c.body == f"object:{i}")
            assert contact.depth > 0.001
            assert contact.probability is not None
    pot = next(k.mesh for k in world.config.known if isinstance(k, KnownMesh))
    assert small.contacts(pot.centroid)[0].body == "known:pot"
    assert small.clearance(pot.centroid) < -0.045


def test_an_open_known_mesh_is_only_its_surface(ball_robot):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    mesh.update_faces(np.arange(len(mesh.faces)) > 3)
    world = bounded(random_map(0), known=(KnownMesh("bowl", mesh.apply_translation([0, 0, 1])),))
    checker = make(world, ball_robot(0.01))
    assert checker.is_valid([0.0, 0.0, 1.0])
    assert not checker.is_valid([0.0, 0.0, 0.9])


def test_planes_are_exact_for_every_solid(world, flyer):
    checker = make(world, flyer)
    rng = np.random.default_rng(3)
    for q in near_things(rng, 20):
        checker.placed.place(q)
        poses = flyer.link_poses(q)
        for plane in world.planes:
            gaps = checker.placed.plane_gaps(plane)
            for i, solid in enumerate(checker.solids):
                name = flyer.link_names[solid.link]
                shape = PrimitiveGeometry(solid.shape.kind, solid.shape.size, solid.T_link)
                points = outline_of(poses[name], shape)
                sampled = (points @ plane[:3]).min() - plane[3]
                assert sampled - 0.001 <= gaps[i] <= sampled + 1e-9
                lowest = checker.placed.lowest_points(plane[:3])[i]
                assert lowest @ plane[:3] - plane[3] == pytest.approx(gaps[i], abs=1e-12)


def test_self_collision_is_that_of_the_solids(world, flyer):
    """The stand and the arm; the body is next to the stand, so that pair is not tested."""
    checker = make(world, flyer)
    rng = np.random.default_rng(4)
    (stand,) = flyer.geometry["stand"]
    hits = 0
    for q in rng.uniform(-1, 1, (150, 7)) * [0.1, 0.1, 0.1, 3, 3, 3, 2] + [0, 0, 0.45, 0, 0, 0, 0]:
        poses = flyer.link_poses(q)
        points = np.concatenate([outline_of(poses["arm"], s) for s in flyer.geometry["arm"]])
        gap = stand.signed_distance(points).min()  # the stand's frame is the world's
        found = [c for c in checker.contacts(q) if c.kind == "self"]
        if abs(gap) > 0.004:
            assert [{c.link, c.body} for c in found] == [{"stand", "arm"}] * int(gap < 0)
            between = checker.link_distance(q, "arm", "stand")
            assert between < 0 if gap < 0 else between == pytest.approx(gap, abs=0.004)
            hits += gap < 0
    assert hits > 20


def test_spheres_are_where_the_checker_has_them(world, flyer):
    field = vp.CollisionChecker(world, flyer)
    checker = make(world, flyer, links="spheres")
    for q in near_things(np.random.default_rng(5), 20):
        checker.placed.place(q)
        order = [solid.sphere for solid in checker.solids]
        np.testing.assert_allclose(
            checker.placed.centers, field.sphere_clearances(q)[0][order], atol=1e-12
        )


def test_what_no_joint_moves_stands_on_the_world(flyer):
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 0.45]
    world = bounded(random_map(0), known=(Box("plinth", (0.2, 0.2, 0.2), pose),), occluded="free")
    checker = make(world, flyer)
    q = np.array([0.4, 0.4, 0.4, 0, 0, 0, 0])
    assert checker.is_valid(q)
    assert checker.clearance(q) > 0.05


def test_joint_limits_are_named(checker, flyer):
    q = np.array([0.4, 0.4, 0.45, 0, 0, 0, 0.0])
    q[0] = 0.6
    assert not checker.is_valid(q)
    (contact,) = [c for c in checker.contacts(q) if c.kind == "joint_limit"]
    assert contact.link == "x"
    assert contact.depth == pytest.approx(0.1)
    assert "outside its limits" in contact.text()


def test_contact_rules_name_links_groups_and_objects(world, flyer):
    free = make(world, flyer)
    ruled = make(world, flyer, allowed_contacts={"hand": {1}, "body": [2]})
    assert ruled.allows("arm", "object:1")
    assert not ruled.allows("arm", "object:2")
    assert not ruled.allows("arm", "known:crate")
    seen = set()
    for q in near_things(np.random.default_rng(6), 150):
        before = {(c.link, c.body) for c in free.contacts(q)}
        after = {(c.link, c.body) for c in ruled.contacts(q)}
        assert after == before - {("arm", "object:1"), ("body", "object:2")}
        seen |= before - after
    assert seen == {("arm", "object:1"), ("body", "object:2")}


def test_rules_of_a_checker_are_taken_over(world, flyer):
    config = vp.CheckerConfig(allowed_contacts={"hand": {1}})
    checker = vp.MeshChecker.like(vp.CollisionChecker(world, flyer, config), links="spheres")
    assert checker.allows("arm", "object:1")
    assert checker.links == "spheres"


# --- meshes of links ------------------------------------------------------------------


def test_a_link_mesh_of_a_box_answers_as_the_box(world, flyer):
    """Outside: the same distance. Crossing, swallowed and swallowing: all are collisions."""
    solids = flyer.geometry["body"]
    shapes = [outline_mesh(solid) for solid in solids]
    meshed = make(world, flyer, link_meshes={"body": trimesh.util.concatenate(shapes)})
    plain = make(world, flyer)
    assert sum(solid.shape.hollow for solid in meshed.solids) == 2
    same = 0
    for q in near_things(np.random.default_rng(7), 100):
        a, b = plain.clearance(q), meshed.clearance(q)
        if abs(a) > 1e-3 or abs(b) > 1e-3:
            assert (a > 0) == (b > 0)
            if a > 0:
                assert a == pytest.approx(b, abs=5e-4)
            same += 1
    assert same > 30


def outline_mesh(solid):
    make = trimesh.creation.box if solid.kind == "box" else trimesh.creation.cylinder
    mesh = make(solid.size) if solid.kind == "box" else make(*solid.size, sections=128)
    return mesh.apply_transform(solid.T_link)


def test_a_hollow_link_that_swallows_an_obstacle_is_a_collision(ball_robot):
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    world = bounded(random_map(0), known=(Sphere("pea", 0.01, (0.0, 0.0, 1.0)),))
    checker = make(world, ball_robot(0.3), link_meshes={"ball": shell})
    around_pea, around_all = [0.0, 0.0, 1.0], [0.0, 0.0, 0.06]
    assert not checker.is_valid(around_pea)
    assert checker.contacts(around_pea)[0].body == "known:pea"
    assert {c.kind for c in checker.contacts(around_all)} == {"object"}
    assert checker.clearance(around_all) < 0.0
    assert checker.is_valid([1.0, 1.0, 1.0])
    open_shell = shell.copy()
    open_shell.update_faces(np.arange(len(shell.faces)) > 2)
    hollow = make(world, ball_robot(0.3), link_meshes={"ball": open_shell})
    assert hollow.is_valid(around_pea)


def test_links_with_meshes_that_were_not_read_fall_back_to_spheres(world, tmp_path):
    text = (
        '<robot name="r"><link name="base"/><link name="tip"><collision><geometry>'
        '<box size="0.01 0.01 0.01"/></geometry></collision><collision><geometry>'
        '<mesh filename="tip.stl"/></geometry></collision></link>'
        '<joint name="j" type="prismatic"><parent link="base"/><child link="tip"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (tmp_path / "r.urdf").write_text(text)
    spheres = {"tip": [{"center": [0, 0, 0], "radius": 0.05}]}
    robot = vp.Robot.from_urdf(tmp_path / "r.urdf", spheres=spheres)
    checker = make(world, robot)
    assert [solid.shape.kind for solid in checker.solids] == ["sphere"]


# --- motions --------------------------------------------------------------------------


def test_no_point_moves_more_than_the_step_between_two_configurations(checker, flyer):
    rng = np.random.default_rng(8)
    outlines = {
        name: np.concatenate([outline_of(np.eye(4), solid)[::7] for solid in flyer.geometry[name]])
        for name in ("body", "arm")
    }
    for _ in range(4):
        qa, qb = near_things(rng, 2)
        places = []
        for t in checker._fractions(qa, qb):
            poses = flyer.link_poses(qa + t * (qb - qa))
            places.append(
                np.concatenate(
                    [x @ poses[n][:3, :3].T + poses[n][:3, 3] for n, x in outlines.items()]
                )
            )
        moved = np.linalg.norm(np.diff(np.array(places), axis=0), axis=2)
        assert moved.max() <= 0.02
        assert moved.max() > 0.002  # a bound, but not a useless one


def test_motions_and_paths_are_judged_by_their_configurations(checker):
    rng = np.random.default_rng(9)
    Q = near_things(rng, 30)
    free = [q for q in Q if checker.is_valid(q)][:5]
    assert len(free) == 5
    verdicts = []
    for qa, qb in itertools.pairwise(free):
        steps = [qa + t * (qb - qa) for t in checker._fractions(qa, qb)]
        verdicts.append(all(checker.is_valid(q) for q in steps))
        assert checker.check_motion(qa, qb) == verdicts[-1]
    opinion = checker.check_path(np.array(free))
    assert opinion.valid == all(verdicts)
    assert [f.edge for f in opinion.findings] == [i for i, ok in enumerate(verdicts) if not ok]
    assert opinion.findings  # else this test would test little
    for found in opinion.findings:
        assert found.contacts == checker.contacts(found.configuration)
        assert not checker.is_valid(found.configuration)
        qa, qb = free[found.edge], free[found.edge + 1]
        np.testing.assert_allclose(qa + found.fraction * (qb - qa), found.configuration)
    assert "disagrees" in opinion.text()
    assert opinion.to_dict()["findings"][0]["contacts"]
    alone = checker.check_path(free[:1])
    assert alone.valid
    assert "agrees" in alone.text()


# --- unusable input -------------------------------------------------------------------


@pytest.mark.parametrize("method", ["is_valid", "clearance", "contacts", "explain"])
def test_wrong_shapes_are_errors(checker, method):
    with pytest.raises(RobotError, match="shape"):
        getattr(checker, method)([0.0, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_a_number_is_never_free_and_says_so(checker, bad):
    q = np.array([bad, 0, 0, 0, 0, 0, 0])
    assert not checker.is_valid(q)
    assert not checker.is_valid_batch(q[None])[0]
    assert not checker.check_motion(q, np.zeros(7))
    assert not checker.check_motion(np.zeros(7), q)
    assert [c.kind for c in checker.contacts(q)] == ["not_finite"]
    assert "give a finite value" in checker.explain(q).text()
    with pytest.raises(RobotError, match="not finite"):
        checker.clearance(q)


def test_motions_of_nonsense_are_errors(checker):
    q = np.zeros(7)
    with pytest.raises(RobotError, match="not finite"):
        checker.check_path([q, q * np.nan])
    with pytest.raises(RobotError, match="shape"):
        checker.check_path(q)
    with pytest.raises(RobotError, match="no link 'foot'"):
        checker.link_distance(q, "foot", "object:1")


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"step": 0.0}, ConfigError, "step"),
        ({"step": float("nan")}, ConfigError, "step"),
        ({"allowed_contacts": {"foot": {1}}}, RobotError, "foot"),
        ({"allowed_contacts": {"hand": {7}}}, ConfigError, "object 7"),
        ({"link_meshes": {"foot": trimesh.creation.box()}}, RobotError, "foot"),
        ({"link_meshes": {"arm": trimesh.Trimesh()}}, RobotError, "0 triangles"),
        (
            {"link_meshes": {"arm": trimesh.creation.box()}, "links": "spheres"},
            ConfigError,
            "link_meshes",
        ),
    ],
)
def test_options_that_fit_nothing_are_named(world, flyer, options, error, match):
    with pytest.raises(error, match=match):
        make(world, flyer, **options)


def test_without_fcl_the_package_to_install_is_named(world, flyer, monkeypatch):
    fcl.fcl.cache_clear()
    monkeypatch.setitem(sys.modules, "fcl", None)
    with pytest.raises(MissingDependencyError, match="pip install python-fcl"):
        make(world, flyer)
    monkeypatch.undo()
    fcl.fcl.cache_clear()
    assert fcl.fcl()


def test_attached_objects_are_solids_like_any_other(world, flyer):
    carrying = flyer.attach("cup", "arm", spheres=[(0.25, 0.0, 0.0, 0.03)], touch_links=("body",))
    checker = make(world, carrying)
    plain = make(world, flyer)
    touched = set()
    for q in near_things(np.random.default_rng(10), 80):
        contacts = checker.contacts(q)
        assert tuple(c for c in contacts if "cup" not in {c.link, c.body}) == plain.contacts(q)
        touched |= {c.kind for c in contacts if c.link == "cup"}
    assert {"object", "known", "support"} <= touched


TWO = (("1", "a", "x"), ("2", "x", "m"), ("3", "m", "b"))


def test_a_self_collision_buffer_counts_for_meshes_too(world, tmp_path):
    """Two balls that slide apart: with buffers of 1 and 2 cm they are refused 3 cm sooner."""
    shape = '<collision><geometry><sphere radius="0.03"/></geometry></collision>'
    away = (
        '<collision><origin xyz="0 0 5"/><geometry><sphere radius="0.01"/></geometry></collision>'
    )
    links = {"a": shape, "x": "", "m": away, "b": shape}
    joints = (
        JOINT.format(n=n, p=p, c=c, kind="prismatic", a="1 0 0", l=1, o="") for n, p, c in TWO
    )
    path = tmp_path / "two.urdf"
    path.write_text(
        '<robot name="two">'
        + "".join(f'<link name="{name}">{own}</link>' for name, own in links.items())
        + "".join(joints)
        + "</robot>"
    )
    row = {"center": [0, 0, 0], "radius": 0.03}
    spheres = {"a": [row], "b": [row], "m": [{"center": [0, 0, 5], "radius": 0.01}]}
    kept = {"collision_spheres": spheres, "self_padding": {"a": 0.01, "b": 0.02}}
    base = np.eye(4)
    base[:3, 3] = 0.0, 0.0, 2.0
    srdf = tmp_path / "none.srdf"
    srdf.write_text('<robot name="two"/>')
    for content, needed in ((spheres, 0.06), (kept, 0.09)):
        robot = vp.Robot.from_urdf(path, srdf, content, base)
        for judge in (make(world, robot), vp.CollisionChecker(world, robot)):
            for way in (needed - 1e-4, needed + 1e-4):
                q = np.array([way, 0.0, 0.0])
                assert judge.is_valid(q) == (way > needed)
                gap = float(judge.self_clearance_batch(q[None])[0])
                assert gap == pytest.approx(way - needed, abs=1e-9)
                assert bool(judge.contacts(q)) == (way < needed)
