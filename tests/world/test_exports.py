# SPDX-License-Identifier: BSD-3-Clause
"""What is an obstacle here is one in every file, read by the library that owns the format."""

import fcl
import numpy as np
import pytest
import trimesh
import yaml
from oracles.perception_oracles import Scene, intrinsics, look_at
from oracles.small_scenes import at

import vprism_plan as vp
from vprism_plan.errors import ConfigError, MissingDependencyError
from vprism_plan.world import Box, Cylinder, HalfSpace, KnownMesh, Sphere
from vprism_plan.world.exports import SUFFIXES, Cells

KNOWN = (
    Box("crate", (0.1, 0.12, 0.2), at(-0.15, 0.2, 0.1)),
    Sphere("ball", 0.05, (0.2, 0.2, 0.3)),
    Cylinder("pole", 0.02, 0.5, at(0.2, -0.2, 0.25)),
    KnownMesh("pot", trimesh.creation.icosphere(radius=0.06).apply_translation((-0.2, -0.2, 0.1))),
    HalfSpace("wall", (0.6, 0.8, 0.0), -0.35),
)
ROOM = ((-0.35, -0.35, -0.03), (0.45, 0.35, 0.4))


def view(labelled=True) -> vp.Observation:
    """A box and a ball on a table, a rod between them; the box is no object if not `labelled`."""
    boxes = [
        (np.array([-0.05, -0.04, 0.0]), np.array([0.03, 0.05, 0.12])),
        (np.array([0.0, 0.1, 0.0]), np.array([0.006, 0.106, 0.3])),
    ]
    pose, K = look_at((-0.6, 0.0, 0.5), (0.0, 0.0, 0.05)), intrinsics()
    scene = Scene(
        spheres=[(np.array([0.1, -0.1, 0.04]), 0.04)], boxes=boxes, table=((-1, -1), (1, 1))
    )
    depth, labels = scene.render(pose, K)
    keep = np.unique(labels[labels > 0])[:: 1 if labelled else 2]
    return vp.Observation(depth, np.where(np.isin(labels, keep), labels, 0), K, pose)


def made(policy: str) -> vp.World:
    if policy == "known":
        return vp.World(known=KNOWN)
    options = {
        "posterior": {},
        "occupied": {"occluded": "occupied"},
        "free": {"occluded": "free"},
        "unobserved": {"unobserved": "occupied"},
        "seen support": {"support": "seen"},
        "known too": {"known": KNOWN, "level": 0.3},
    }[policy]
    map_ = vp.fit_map(view(policy != "occupied"), vp.MapConfig(hinge_spacing=0.04, iterations=4))
    return vp.World(map_, vp.WorldConfig(bounds=ROOM, **options))


SLOW = ("occupied", "free", "unobserved", "seen support", "known")
POLICIES = ["posterior", "known too", *(pytest.param(p, marks=pytest.mark.slow) for p in SLOW)]


@pytest.fixture(scope="module", params=POLICIES)
def world(request) -> vp.World:
    return made(request.param)


@pytest.fixture(scope="module")
def obstacles(world, ball_robot) -> np.ndarray:
    """Points (n, 3) in the box, on no face of a cell, that the checker refuses; what truth calls
    obstacles is among them."""
    rng = np.random.default_rng(0)
    low, high = world.field.origin + 1e-4, world.field.upper - 1e-4
    points = rng.uniform(low, high, (30_000, 3))
    for item in world.config.known:
        if not isinstance(item, HalfSpace):
            points = np.concatenate([points, rng.uniform(*item.box(), (2000, 3))])
    map_ = world.map
    points = np.concatenate([points, *(v.points()[0][::7] for v in map_.views)])
    steps = (points - world.field.origin) / world.field.spacing
    inner = (points > low) & (points < high) & (np.abs(steps - np.rint(steps)) > 1e-4)
    points = points[inner.all(axis=1)]
    surely = map_.occupancy(points) >= world.config.level
    for item in world.config.known:
        if isinstance(item, HalfSpace):
            surely |= points @ item.normal < item.offset
        elif isinstance(item, KnownMesh):
            surely |= item.mesh.contains(points)
        else:
            surely |= item.signed_distance(points) <= 0.0
    if map_.plane is not None and world.config.support != "seen":
        surely |= map_.plane.signed_distance(points) < 0.0
    status = world.status(points)
    if world.config.occluded == "occupied":
        surely |= status == 1
    if world.config.unobserved == "occupied":
        surely |= status == 2
    point = vp.CollisionChecker(world, ball_robot(1e-9), vp.CheckerConfig(max_risk=None))
    refused = point.clearance_batch(points) <= -1e-9
    assert refused[surely].all()
    assert surely.sum() > 100
    assert refused.mean() < 0.9 or world.config.unobserved == "occupied"
    return points[refused]


def octomap(path):
    import pyoctomap

    tree = pyoctomap.OcTree(1.0)
    if path.suffix == ".bt":
        assert tree.readBinary(str(path))
    else:
        tree = pyoctomap.OcTree.read(tree, str(path))

    def held(points):
        nodes = [tree.search(p) for p in points]
        return np.array([node is not None and tree.isNodeOccupied(node) for node in nodes])

    return held


def field(path):
    data = np.load(path)

    def held(points):
        index = tuple(np.rint((points - data["origin"]) / data["spacing"]).astype(int).T)
        assert (data["occupied"][index] == (data["esdf"][index] <= 0.0)).all()
        return data["occupied"][index]

    return held


def read_text_scene(path):
    """Collision objects by name, as MoveIt's `loadGeometryFromStream` takes the lines."""
    lines = iter(path.read_text().split("\n"))
    next(lines)
    found = {}
    while (line := next(lines)) != ".":
        name = line.removeprefix("* ")
        assert line.startswith("* ")
        assert name not in found
        assert (next(lines), next(lines)) == ("0 0 0", "0 0 0 1")
        found[name] = []
        for _ in range(int(next(lines))):
            assert next(lines) == "box"
            size, middle = ([float(v) for v in next(lines).split()] for _ in range(2))
            assert (next(lines), next(lines)) == ("0 0 0 1", "0 0 0 0")
            found[name].append((middle, size))
        assert next(lines) == "0"
    return found


def read_message(path):
    message = yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    assert message["is_diff"] is True
    found = {}
    for item in message["world"]["collision_objects"]:
        assert item["header"]["frame_id"] == "map"
        assert item["operation"] == 0
        found[item["id"]] = []
        for primitive, pose in zip(item["primitives"], item["primitive_poses"], strict=True):
            assert primitive["type"] == 1
            middle = [pose["position"][axis] for axis in "xyz"]
            found[item["id"]].append((middle, primitive["dimensions"]))
    return found


def scene(path):
    """As MoveIt asks: FCL, spheres against boxes."""
    objects = read_text_scene(path) if path.suffix == ".scene" else read_message(path)
    manager = fcl.DynamicAABBTreeCollisionManager()
    manager.registerObjects([
        fcl.CollisionObject(fcl.Box(*size), fcl.Transform(np.array(middle)))
        for boxes in objects.values() for middle, size in boxes
    ])  # fmt: skip
    manager.setup()

    def held(points, radii):
        out = []
        for point, radius in zip(points, radii, strict=True):
            data = fcl.CollisionData()
            ball = fcl.CollisionObject(fcl.Sphere(float(radius)), fcl.Transform(point))
            manager.collide(ball, data, fcl.defaultCollisionCallback)
            out.append(data.result.is_collision)
        return np.array(out)

    return held


def mesh(path):
    kept = {"split_objects": True} if path.suffix == ".obj" else {}
    solids = list(trimesh.load_scene(path, **kept).geometry.values())
    return lambda points: np.any([solid.contains(points) for solid in solids], axis=0)


def usd(path):
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    parts = []
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            assert prim.HasAPI(UsdPhysics.CollisionAPI)
            shape = UsdGeom.Mesh(prim)
            vertices = np.array(shape.GetPointsAttr().Get(), np.float64)
            faces = np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            parts.append(trimesh.Trimesh(vertices, faces, process=False))
    return lambda points: np.any([part.contains(points) for part in parts], axis=0)


READERS = {
    ".bt": octomap, ".ot": octomap, ".npz": field, ".obj": mesh, ".glb": mesh, ".stl": mesh,
    ".ply": mesh, ".usda": usd, ".usd": usd,
}  # fmt: skip
OWNERS = {".bt": "pyoctomap", ".ot": "pyoctomap", ".usda": "pxr", ".usd": "pxr"}


@pytest.mark.parametrize("suffix", READERS)
def test_no_obstacle_is_free_in_the_file(suffix, world, obstacles, tmp_path):
    if suffix in OWNERS:
        pytest.importorskip(OWNERS[suffix])
    held = READERS[suffix](world.export(tmp_path / f"world{suffix}"))
    points = obstacles[:: max(1, len(obstacles) // 1500)]
    assert held(points).all()
    cells = Cells.of(world)
    far = cells.centers(np.argwhere(cells.distance > 0.03))
    assert not held(far[:: max(1, len(far) // 1000)]).any()


@pytest.mark.parametrize("suffix", [".scene", ".yaml"])
def test_a_ball_that_touches_an_obstacle_collides_in_the_scene(
    suffix, world, obstacles, ball_robot, tmp_path
):
    rng = np.random.default_rng(1)
    held = scene(world.export(tmp_path / f"world{suffix}", frame_id="map"))
    points = obstacles[:: max(1, len(obstacles) // 600)]
    radii = rng.uniform(0.0, 0.05, len(points))
    away = rng.normal(size=points.shape)
    away *= (rng.uniform(0, 1, len(points)) * radii / np.linalg.norm(away, axis=1))[:, None]
    centers = points + away
    assert held(centers, np.maximum(radii, 1e-6)).all()
    checker = vp.CollisionChecker(world, ball_robot(0.05), vp.CheckerConfig(max_risk=None))
    assert not checker.is_valid_batch(centers).any()


def test_every_object_has_its_name(tmp_path):
    world = made("known too")
    names = set(read_text_scene(world.export(tmp_path / "a.scene")))
    assert names == set(read_message(world.export(tmp_path / "a.yml", frame_id="map")))
    objects = {f"object:{i}" for i in world.map.object_ids}
    solids = {f"known:{item.name}" for item in KNOWN}
    assert objects | solids | {"support surface"} <= names <= {*world.sources, *world.plane_names}
    model = trimesh.load_scene(world.export(tmp_path / "a.glb"))
    assert {name.replace(":", "_").replace(" ", "_") for name in names} == set(model.geometry)


def test_cells_are_tight_and_boxes_fill_them():
    world = vp.World(known=[KNOWN[0], KNOWN[1]])
    cells = Cells.of(world)
    truth = np.minimum(
        *(k.signed_distance(cells.centers(np.argwhere(cells.occupied))) for k in KNOWN[:2])
    )
    assert truth.max() < 2.0 * world.config.resolution
    slack = world.field.lower_bound(cells.centers(np.argwhere(~cells.occupied)))
    assert ((slack - cells.distance[~cells.occupied]) < 2.0 * world.config.resolution).all()
    for _, own in cells.bodies():
        low, high = cells.boxes(own)
        again = np.zeros_like(own, int)
        for a, b in zip(
            *(np.rint((e - cells.origin) / cells.spacing).astype(int) for e in (low, high)),
            strict=True,
        ):
            again[a[0] : b[0], a[1] : b[1], a[2] : b[2]] += 1
        assert (again == own).all()
        assert cells.surface(own).volume == pytest.approx(own.sum() * cells.spacing**3)


def test_an_octomap_has_the_maps_probabilities(tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap")
    world = made("posterior")
    tree = pyoctomap.OcTree.read(pyoctomap.OcTree(1.0), str(world.export(tmp_path / "a.ot")))
    cells = Cells.of(world)
    index = np.argwhere(cells.distance > 0.01)[::97]
    points = cells.centers(index)
    points = points[world.map.judges(points, world.config.min_support)]
    p = world.map.occupancy(points).clip(0.1192, 0.971)
    found = np.array([tree.search(q).getOccupancy() for q in points])
    assert np.abs(found - p).max() < 0.02
    # What nobody saw and no policy makes an obstacle is unknown.
    index = cells.centers(np.argwhere(cells.distance > 0.02))
    unseen = index[(world.status(index) == 2) & ~world.map.judges(index, world.config.min_support)]
    assert len(unseen) > 100
    assert all(tree.search(q) is None for q in unseen[::50])


def test_what_cannot_be_written_says_so(tmp_path, monkeypatch):
    world = vp.World(known=[])
    with pytest.raises(ConfigError, match=r"'a\.dae'.*\.scene"):
        world.export(tmp_path / "a.dae")
    with pytest.raises(ConfigError, match="nothing is an obstacle"):
        world.export(tmp_path / "a.stl")
    for suffix in SUFFIXES.split(", "):
        if suffix in (".bt", ".ot", ".usd", ".usda", ".usdc"):
            monkeypatch.setitem(__import__("sys").modules, "pxr", None)
            monkeypatch.setitem(__import__("sys").modules, "pyoctomap", None)
            with pytest.raises(MissingDependencyError, match=r"vprism_plan\[export\]"):
                world.export(tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())
