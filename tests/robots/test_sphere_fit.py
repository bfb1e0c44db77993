# SPDX-License-Identifier: BSD-3-Clause
"""Fitted spheres hold whole surfaces and what they enclose, and say how far they stand out."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kinematics_oracle import random_pose

from vprism_plan.errors import RobotError
from vprism_plan.robots import fit_spheres, sphere_fit
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.report import enclosed, protrusion, sphere_gap
from vprism_plan.robots.sphere_fit import SphereFit


def plate_with_hole():
    return trimesh.creation.annulus(r_min=0.06, r_max=0.1, height=0.01)


def elbow():
    parts = [trimesh.creation.box((0.3, 0.05, 0.05)), trimesh.creation.box((0.05, 0.3, 0.05))]
    parts[1].apply_translation((0.14, 0.14, 0.0))
    return trimesh.util.concatenate(parts)


def open_shell():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.08)
    mesh.update_faces(np.arange(len(mesh.faces)) % 7 != 0)
    return mesh


def apart():
    other = trimesh.creation.icosphere(radius=0.03)
    other.apply_translation((0.3, 0.1, 0.0))
    return trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), other])


SHAPES = {
    "box": lambda: trimesh.creation.box((0.2, 0.1, 0.06)),
    "cylinder": lambda: trimesh.creation.cylinder(0.05, 0.3),
    "ball": lambda: trimesh.creation.icosphere(radius=0.1),
    "plate with a hole": plate_with_hole,
    "elbow": elbow,
    "open shell": open_shell,
    "two pieces": apart,
    "sheet": lambda: trimesh.Trimesh([[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0]], [[0, 1, 2]]),
    "needle": lambda: trimesh.creation.cylinder(0.002, 0.2),
}


@pytest.mark.parametrize("name", SHAPES)
def test_all_of_a_surface_is_held_and_so_is_its_inside(name):
    mesh = SHAPES[name]()
    mesh.apply_transform(random_pose(np.random.default_rng(3)))
    triangles = np.asarray(mesh.triangles)
    fit = SphereFit()
    spheres = fit_spheres(triangles, fit.allowed(triangles), fit.most(name, triangles))
    assert len(spheres) <= 2 * fit.most(name, triangles)
    assert enclosed(triangles, spheres)
    samples = mesh.sample(20_000, seed=0)
    assert sphere_gap(samples, spheres).max() <= 0.0
    if mesh.is_watertight:
        inside = trimesh.sample.volume_mesh(mesh, 5000)
        assert sphere_gap(inside, spheres).max() <= 0.0


@pytest.mark.parametrize(("name", "limit"), [("cylinder", 0.03), ("ball", 1e-3), ("elbow", 0.03)])
def test_spheres_stand_out_no_more_than_asked(name, limit):
    mesh = SHAPES[name]()
    triangles = np.asarray(mesh.triangles)
    spheres = fit_spheres(triangles, 0.03, 16)
    worst, mean = protrusion((), triangles, spheres)
    assert 0.0 <= mean <= worst <= limit
    # against exact distances, at points of our own
    unit = trimesh.creation.icosphere(subdivisions=3).vertices
    points = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    points = points[sphere_gap(points, spheres) > -1e-9]
    exact = -trimesh.proximity.signed_distance(mesh, points)
    assert abs(exact.max() - worst) < 2e-3
    finer = fit_spheres(triangles, 0.015, 24)
    assert protrusion((), triangles, finer)[0] <= worst + 1e-3
    assert len(finer) >= len(spheres)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), most=st.integers(1, 6))
def test_any_triangles_are_held_by_however_few(seed, most):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 0.5)
    triangles = scale * rng.normal(size=(int(rng.integers(1, 12)), 3, 3)) + rng.normal(size=3)
    spheres = fit_spheres(triangles, 0.02, most)
    assert enclosed(triangles, spheres)
    share = rng.dirichlet(np.ones(3), size=(len(triangles), 300))
    points = np.einsum("tnk,tkj->tnj", share, triangles).reshape(-1, 3)
    assert sphere_gap(points, spheres).max() <= 0.0


def test_equal_links_get_equal_spheres_and_callers_cannot_spoil_them():
    triangles = np.asarray(elbow().triangles)
    first = fit_spheres(triangles, 0.03, 8)
    kept = first.copy()
    first[:] = 0.0
    np.testing.assert_array_equal(fit_spheres(triangles.copy(), 0.03, 8), kept)


def test_the_proof_refuses_a_gap_of_a_hundredth_of_a_millimetre():
    box = PrimitiveGeometry("box", (0.1, 0.1, 0.1), np.eye(4)).triangles()
    around = np.array([[0.0, 0.0, 0.0, 0.05 * np.sqrt(3.0) + 1e-9]])
    assert enclosed(box, around)
    assert not enclosed(box, around - [0, 0, 0, 1e-5])
    # every corner is held, the middle of one face is not
    corners = np.unique(box.reshape(-1, 3), axis=0)
    assert not enclosed(box, np.column_stack([corners, np.full(8, 0.06)]))


def test_what_stands_for_a_solid_holds_it():
    rng = np.random.default_rng(0)
    for kind, size in (("cylinder", (0.05, 0.2)), ("sphere", (0.07,)), ("box", (0.1, 0.2, 0.3))):
        solid = PrimitiveGeometry(kind, size, random_pose(rng))
        triangles = solid.triangles()
        mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles))
        assert mesh.is_watertight
        assert mesh.volume > 0.0
        points, _ = trimesh.sample.sample_surface(mesh, 5000, seed=0)
        gap = solid.signed_distance(points)
        assert gap.min() >= -1e-12
        assert gap.max() <= 0.01 * max(size)


@pytest.mark.parametrize("bad", [{"tolerance": 0.0}, {"relative": np.nan}, {"max_spheres": 0}])
def test_a_fit_that_cannot_be_is_refused(bad):
    with pytest.raises(RobotError, match=next(iter(bad))):
        SphereFit(**bad)


def test_a_number_of_spheres_can_be_set_for_one_link():
    triangles = np.asarray(SHAPES["box"]().triangles)
    fit = SphereFit(max_spheres={"a": 3})
    assert fit.most("a", triangles) == 3
    assert fit.most("b", triangles) == SphereFit().most("b", triangles) == 12


# ------------------------------------------------------------------- kept from run to run
@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Where fitted spheres are kept, and how often some are fitted."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fitted = []
    real = sphere_fit._fitted
    monkeypatch.setattr(sphere_fit, "_fitted", lambda *a: (fitted.append(1), real(*a))[1])

    def fit(tolerance=0.01, most=4, size=0.1):
        """As in a new process."""
        sphere_fit._fit.cache_clear()
        triangles = np.array(trimesh.creation.box((size, size, size)).triangles)
        return fit_spheres(triangles, tolerance, most)

    yield tmp_path / "vprism_plan" / "spheres", fit, fitted
    sphere_fit._fit.cache_clear()


def test_fitted_spheres_are_kept_from_run_to_run(kept):
    folder, fit, fitted = kept
    first = fit()
    np.testing.assert_array_equal(fit(), first)
    assert len(fitted) == 1
    assert fit().flags.writeable
    for changed in ({"tolerance": 0.02}, {"most": 3}, {"size": 0.2}):
        fit(**changed)
    assert len(fitted) == 4
    assert len(list(folder.iterdir())) == 4


DAMAGES = (lambda b: b[:-9], lambda b: b[:40] + b"x" + b[41:], lambda _: b"")


@pytest.mark.parametrize("damage", DAMAGES, ids=["cut", "changed", "empty"])
def test_a_damaged_file_is_made_anew(kept, damage):
    folder, fit, fitted = kept
    first = fit()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    np.testing.assert_array_equal(fit(), first)
    assert len(fitted) == 2
    assert file.read_bytes() == whole


def test_without_a_folder_to_write_to_spheres_are_fitted(kept, tmp_path, monkeypatch):
    _, fit, _ = kept
    first = fit()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("vprism_plan._kernels.jit.own_temporary_folder", lambda: None)
    np.testing.assert_array_equal(fit(), first)
