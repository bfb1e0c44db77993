"""Meshes: where they come from, how they are cleaned, and what is refused."""

from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from experiments.generation import generate, shapes, source, sources
from experiments.generation.shapes import file_precision, read_shape, shape_of
from experiments.generation.sources import YCB_VARIABLE
from vprism_plan.errors import ConfigError, MissingDependencyError


@given(arrays(np.float64, (5, 3), elements=st.floats(-0.3, 0.3)))
def test_rounding_to_file_precision_happens_once(vertices):
    once = file_precision(vertices)
    assert file_precision(once).tobytes() == once.tobytes()
    assert np.abs(once - vertices).max() < 1e-7


@pytest.mark.parametrize("kind", ["analytic", "random", "random-train"])
def test_draws_are_of_household_size_and_centred(kind):
    origin = source(kind)
    rng = np.random.default_rng(0)
    shapes = [origin.draw(rng) for _ in range(12)]
    for shape in shapes:
        assert 0.0599 <= shape.extents.max() <= 0.2201
        middle = 0.5 * (shape.vertices.min(axis=0) + shape.vertices.max(axis=0))
        assert np.abs(middle).max() < 1e-6
        assert 0.1 <= shape.fill <= 1.0 + 1e-6
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        assert mesh.volume > 0
        assert mesh.is_watertight
        # The hull's corners are all that physics needs.
        hull = trimesh.convex.convex_hull(shape.vertices[shape.hull])
        assert hull.volume == pytest.approx(mesh.convex_hull.volume, rel=1e-6)
    assert len({shape.extents.max() for shape in shapes}) == len(shapes)


def test_evaluation_and_training_share_no_object_and_leave_the_last_300_alone():
    numbers = {
        kind: {int(path.stem) for path in source(kind).files} for kind in ("random", "random-train")
    }
    assert numbers["random"] == set(range(400, 700))
    assert numbers["random-train"] == set(range(400)) - {168}
    assert all(path.is_file() for path in source("random").files)


def test_the_random_object_that_is_left_out_is_unusable():
    folder = source("random").files[0].parent.parent
    with pytest.raises(ConfigError, match="not finite"):
        read_shape(folder / "168" / "168.obj")


def test_pieces_that_touch_become_one_surface():
    left = trimesh.creation.box(extents=(1, 1, 1))
    right = trimesh.creation.box(extents=(1, 1, 1))
    right.apply_translation((1.0, 0.0, 0.0))
    shape = shape_of(trimesh.util.concatenate([left, right]), "pair")
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.area == pytest.approx(10.0, rel=0.005)  # not 12: the shared faces are gone
    assert mesh.volume == pytest.approx(2.0, rel=0.005)


def test_an_open_mesh_keeps_its_triangles_and_an_inverted_one_is_turned():
    box = trimesh.creation.box()
    lidless = trimesh.Trimesh(box.vertices, box.faces[:-2], process=False)
    assert len(shape_of(lidless, "lidless").faces) == 10
    box.invert()
    assert trimesh.Trimesh(*_arrays(shape_of(box, "box"))).volume == pytest.approx(1.0)


def _arrays(shape):
    return shape.vertices, shape.faces


def test_useless_meshes_are_refused():
    with pytest.raises(ConfigError, match="has no triangles"):
        shape_of(trimesh.PointCloud(np.zeros((3, 3))), "cloud")
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    with pytest.raises(ConfigError, match="flat"):
        shape_of(flat, "flat")
    bad = trimesh.creation.box()
    corners = bad.vertices.copy()
    corners[0, 0] = np.nan
    with pytest.raises(ConfigError, match="not finite"):
        shape_of(trimesh.Trimesh(corners, bad.faces, process=False), "bad")


def test_folders_without_meshes_are_named(tmp_path):
    with pytest.raises(ConfigError, match="is not a folder"):
        source("folder", tmp_path / "absent")
    (tmp_path / "readme.txt").write_text("nothing here")
    with pytest.raises(ConfigError, match="holds no mesh"):
        source("folder", tmp_path)


@pytest.mark.parametrize(
    "content", [b"", b"ply\nformat ascii 1.0\nelement vertex 3\n", b"\x00" * 9]
)
def test_an_unreadable_mesh_is_named(tmp_path, content):
    (tmp_path / "broken.ply").write_bytes(content)
    with pytest.raises(ConfigError, match=r"broken\.ply"):
        source("folder", tmp_path).draw(np.random.default_rng(0))


def test_a_folder_of_wires_is_refused(tmp_path):
    trimesh.creation.box(extents=(1.0, 1.0, 0.01)).export(tmp_path / "sheet.ply")
    with pytest.raises(ConfigError, match="none of 100 draws"):
        source("folder", tmp_path).draw(np.random.default_rng(0))


def test_any_folder_makes_scenes_also_of_open_meshes_in_other_units(tmp_path):
    box = trimesh.creation.box(extents=(300.0, 200.0, 150.0))  # in millimetres, without a lid
    trimesh.Trimesh(box.vertices, box.faces[:-2]).export(tmp_path / "lidless.stl")
    (tmp_path / "sub").mkdir()
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "sub" / "ball.obj")
    scene = generate("folder", 1, n_objects=3, data=tmp_path)
    assert {body.name for body in scene.objects} == {"lidless", "ball"}
    middles = np.array([body.pose[:3, 3] for body in scene.objects])
    np.testing.assert_array_equal(scene.object_of(middles), scene.object_ids)


def test_ycb_is_looked_for_where_it_may_be(tmp_path, monkeypatch):
    monkeypatch.setenv(YCB_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match=r"nowhere is not a folder"):
        source("ycb")
    trimesh.creation.box(extents=(0.1, 0.1, 0.1)).export(tmp_path / "Cube.ply")
    monkeypatch.setenv(YCB_VARIABLE, str(tmp_path))
    extents = {source("ycb").draw(np.random.default_rng(k)).extents.max() for k in range(5)}
    assert 0.0799 < min(extents) < max(extents) < 0.1201
    monkeypatch.delenv(YCB_VARIABLE)
    monkeypatch.setattr(sources, "__file__", str(tmp_path / "a" / "b" / "c" / "sources.py"))
    with pytest.raises(ConfigError, match="VPRISM_PLAN_YCB"):
        source("ycb")


def test_random_objects_without_pybullet_name_the_extra(monkeypatch):
    monkeypatch.setattr(sources, "find_spec", lambda name: None)
    assert find_spec("pybullet_data") is not None
    with pytest.raises(MissingDependencyError, match=r"vprism_plan\[experiments\]"):
        source("random")


def test_pieces_without_manifold3d_name_it(monkeypatch):
    monkeypatch.setattr(shapes, "find_spec", lambda name: None)
    left, right = trimesh.creation.box(), trimesh.creation.box()
    right.apply_translation((0.5, 0.5, 0.5))
    with pytest.raises(MissingDependencyError, match="pip install manifold3d"):
        shape_of(left + right, "pair")
