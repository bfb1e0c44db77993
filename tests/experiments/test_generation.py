"""Generated scenes: at rest, apart from each other, seen truly, and the same every time."""

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from oracles.ray_oracle import brute_force, by_mujoco
from oracles.scene_digest import digest
from scipy.spatial import ConvexHull

from experiments.generation import generate, generator
from experiments.generation.dropping import rest_motion
from experiments.generation.shapes import Shape
from vprism_plan.errors import ConfigError

CASES = (("analytic", 3), ("random", 4), ("ycb", 5))


@pytest.fixture(scope="module")
def ycb(repository):
    folder = repository.parent / "shared" / "data" / "ycb"
    if not folder.is_dir():
        pytest.skip("the YCB meshes (../shared/data/ycb) are not on this machine")
    return folder


@pytest.fixture(scope="module", params=CASES, ids=[kind for kind, _ in CASES])
def scene(request):
    """A scene of six objects without noise, one per set."""
    kind, seed = request.param
    data = request.getfixturevalue("ycb") if kind == "ycb" else None
    return generate(kind, seed, n_objects=6, noise=False, data=data)


def deepest(points: np.ndarray, mesh: trimesh.Trimesh) -> float:
    """Return how deep the deepest of the points lies in a mesh (trimesh's own queries)."""
    near = points[((points > mesh.bounds[0]) & (points < mesh.bounds[1])).all(axis=1)]
    inside = near[mesh.contains(near)] if len(near) else near
    if len(inside) == 0:
        return 0.0
    return float(trimesh.proximity.closest_point(mesh, inside)[1].max())


def test_objects_do_not_overlap_by_more_than_two_millimetres(scene):
    meshes = list(scene.truth_meshes().values())
    for index, mesh in enumerate(meshes):
        points = np.concatenate(
            [mesh.vertices, trimesh.sample.sample_surface(mesh, 5000, seed=index)[0]]
        )
        assert points[:, 2].min() > -0.002
        for other in meshes[:index] + meshes[index + 1 :]:
            assert deepest(points, other) < 0.002


def test_objects_stay_where_they_are(scene):
    shapes = [
        Shape(b.name, b.vertices, b.faces, ConvexHull(b.vertices).vertices) for b in scene.objects
    ]
    moved, turned = rest_motion(shapes, np.array([b.pose for b in scene.objects]), 1.5)
    assert moved < 0.001
    assert turned < 0.02


def test_a_lifted_object_would_be_noticed(scene):
    shapes = [
        Shape(b.name, b.vertices, b.faces, ConvexHull(b.vertices).vertices) for b in scene.objects
    ]
    poses = np.array([b.pose for b in scene.objects])
    poses[0, 2, 3] += 0.2
    assert rest_motion(shapes, poses, 0.3)[0] > 0.05


def test_objects_are_household_sized_close_together_and_hide_each_other(scene):
    middles = np.array([b.pose[:3, 3] for b in scene.objects])
    assert np.linalg.norm(middles[:, :2], axis=1).max() <= 0.3
    hidden = []
    for label, body in zip(scene.object_ids, scene.objects, strict=True):
        largest = np.ptp(body.vertices, axis=0).max()
        assert 0.0599 <= largest <= 0.2201
        alone = type(scene)((body,), scene.camera, scene.observation).render(scene.camera)
        hidden.append(1 - (scene.observation.labels == label).sum() / (alone.labels > 0).sum())
    assert np.mean(hidden) > 0.05


def test_every_labelled_pixel_sees_its_object_first(scene):
    seen, camera = scene.observation, scene.camera
    meshes = list(scene.truth_meshes().values())
    rows, columns = np.nonzero(seen.labels > 0)
    assert len(rows) > 3000
    rays = camera.ray_directions()[rows, columns]
    owner, depth = by_mujoco(camera.center, rays, meshes)
    np.testing.assert_array_equal(owner + 1, seen.labels[rows, columns])
    assert np.abs(depth - seen.depth[rows, columns]).max() < 0.00006  # half a step of 0.1 mm
    some = np.random.default_rng(0).choice(len(rows), 100, replace=False)
    owner, depth = brute_force(camera.center, rays[some], meshes)
    np.testing.assert_array_equal(owner + 1, seen.labels[rows, columns][some])
    assert np.abs(depth - seen.depth[rows, columns][some]).max() < 0.00006


def test_every_other_pixel_sees_the_table(scene):
    seen, camera = scene.observation, scene.camera
    rows, columns = np.nonzero((seen.labels == 0) & (seen.depth > 0))
    rays = camera.ray_directions()[rows, columns]
    _, depth = by_mujoco(camera.center, rays, list(scene.truth_meshes().values()))
    table = -camera.center[2] / rays[:, 2]
    assert (depth >= table - 1e-6).all()
    assert np.abs(seen.depth[rows, columns] - table).max() < 0.00006


def test_what_the_camera_sees_lies_on_the_true_surface(scene):
    points, labels = scene.observation.points()
    some = np.random.default_rng(1).choice(len(points), 3000, replace=False)
    assert np.abs(scene.signed_distance(points[some], table=True)).max() < 0.0001
    on_object = labels[some] > 0
    inward = points[some][on_object] + 0.001 * (
        points[some][on_object] - scene.camera.center
    ) / np.linalg.norm(points[some][on_object] - scene.camera.center, axis=1, keepdims=True)
    inside = scene.object_of(inward)
    # Past an outline or through an edge, a millimetre may lead out again.
    assert (inside == labels[some][on_object]).mean() > 0.95
    assert scene.table.signed_distance(points[labels == 0]).max() < 0.0001


def test_same_seed_same_bits_also_in_another_process(repository):
    code = (
        "from oracles.scene_digest import digest;"
        "from experiments.generation import generate;"
        "print(digest(generate('random-train', 8, n_objects=4)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=repository,
        env={**os.environ, "PYTHONPATH": "tests"},
    )
    here = generate("random-train", 8, n_objects=4)
    assert done.stdout.strip() == digest(here)
    assert digest(generate("random-train", 9, n_objects=4)) != digest(here)


def test_noise_changes_the_depth_and_nothing_else():
    clean = generate("analytic", 1, n_objects=2, noise=False)
    noisy = generate("analytic", 1, n_objects=2)
    assert noisy.noise is not None
    assert clean.name == noisy.name == "analytic-2-1"
    for a, b in zip(clean.objects, noisy.objects, strict=True):
        assert a.pose.tobytes() == b.pose.tobytes()
    np.testing.assert_array_equal(clean.observation.labels, noisy.observation.labels)
    both = (clean.observation.depth > 0) & (noisy.observation.depth > 0)
    error = np.abs(clean.observation.depth - noisy.observation.depth)[both]
    assert 0.0002 < np.median(error) < 0.005


def test_the_seed_draws_the_number_of_objects(monkeypatch):
    monkeypatch.setattr(
        generator, "drop", lambda shapes, _: np.tile(np.eye(4), (len(shapes), 1, 1))
    )
    monkeypatch.setattr(generator, "observe", lambda *_: None)
    counts = {len(generate("analytic", seed).objects) for seed in range(8)}
    assert counts <= set(range(3, 11))
    assert len(counts) >= 4


def test_a_pickled_scene_answers_alike(scene):
    points = np.random.default_rng(2).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.2], (500, 3))
    before = scene.signed_distance(points)
    again = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(again.signed_distance(points), before)
    assert digest(again) == digest(scene)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"kind": "shapenet", "seed": 0}, "'shapenet' is unknown; valid: analytic"),
        ({"kind": "analytic", "seed": -1}, "seed is -1"),
        ({"kind": "analytic", "seed": 0, "n_objects": 0}, "n_objects is 0; it must be 1 to 10"),
        ({"kind": "analytic", "seed": 0, "n_objects": 11}, "n_objects is 11"),
        ({"kind": "folder", "seed": 0}, "needs the folder"),
    ],
)
def test_wrong_arguments_are_named(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        generate(**kwargs)


def test_drops_that_never_rest_end_with_an_error(monkeypatch):
    monkeypatch.setattr(generator, "drop", lambda shapes, rng: None)
    monkeypatch.setattr(generator, "_ATTEMPTS", 3)
    with pytest.raises(ConfigError, match="did not come to rest within 30 cm"):
        generate("analytic", 0, n_objects=1)
