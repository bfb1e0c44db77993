"""Flying pixels must not become objects in the air, and real surfaces must stay."""

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.mapping.training_data import stray_points
from vprism_plan.simulation.scenes import demo_scene


def surface_and_strays(rng):
    """A plate seen at a millimetre's spacing, and a line of points behind its edge."""
    plate = np.stack(np.meshgrid(np.arange(0, 0.1, 0.001), np.arange(0, 0.1, 0.001)), -1)
    plate = np.column_stack([plate.reshape(-1, 2), np.zeros(10_000)])
    strays = np.column_stack([0.1 + rng.uniform(0.04, 0.4, 30), rng.uniform(0, 0.1, 30)])
    return plate, np.column_stack([strays, rng.uniform(0.05, 0.2, 30)])


def test_points_in_the_air_are_stray_and_surfaces_are_not():
    plate, strays = surface_and_strays(np.random.default_rng(0))
    found = stray_points(np.concatenate([plate, strays]), 0.03)
    assert not found[: len(plate)].any()
    assert found[len(plate) :].all()


def test_a_thin_handle_is_kept():
    plate, _ = surface_and_strays(np.random.default_rng(0))
    handle = np.stack(np.meshgrid(np.arange(0.1, 0.2, 0.001), np.arange(0.05, 0.055, 0.001)), -1)
    handle = np.column_stack([handle.reshape(-1, 2), np.zeros(handle.size // 2)])
    assert not stray_points(np.concatenate([plate, handle]), 0.03).any()


def test_share_zero_keeps_everything_and_coarse_images_are_not_emptied():
    plate, strays = surface_and_strays(np.random.default_rng(1))
    assert not stray_points(np.concatenate([plate, strays]), 0.0).any()
    assert not stray_points(plate[::97], 0.03).any()
    assert stray_points(np.zeros((0, 3)), 0.03).shape == (0,)


@pytest.mark.slow
def test_objects_behind_flying_pixels_come_out_in_one_piece():
    scene = demo_scene()
    meshes = vp.extract_meshes(vp.fit_map(scene.observation))
    assert set(meshes) == set(scene.observation.object_ids)
    for mesh in meshes.values():
        assert mesh.body_count == 1
