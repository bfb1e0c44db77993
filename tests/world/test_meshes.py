# SPDX-License-Identifier: BSD-3-Clause
import logging

import numpy as np
import pytest
from oracles.world_oracles import KernelMap, random_map

from vprism_plan.errors import ConfigError
from vprism_plan.world import extract_meshes, extract_union_mesh


def _closed(mesh) -> bool:
    return mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


def test_surfaces_are_closed_and_lie_on_the_level(any_map):
    meshes = extract_meshes(any_map, resolution=0.008)
    assert meshes
    assert set(meshes) <= set(any_map.object_ids)
    for object_id, mesh in meshes.items():
        assert _closed(mesh)
        k = any_map.object_ids.index(object_id) + 1
        value = _inside(any_map, k, np.asarray(mesh.vertices, dtype=np.float64))
        assert np.median(np.abs(value)) < 0.04


def _inside(map_, k, points):
    """Above 0 where P(occupied) is above one half and object k the likeliest."""
    p = map_.predict_proba(points)
    others = np.delete(p, (0, k), axis=1).max(axis=1, initial=0.0)
    return np.minimum(p[:, 1:].sum(axis=1) - 0.5, p[:, k] - others)


def test_surfaces_of_a_guess_lie_on_the_level_to_half_a_step(demo_map):
    """Where probabilities jump within a step their median says little: but at edges, half a
    step inwards it is the object, and as far outwards it is not."""
    for object_id, mesh in extract_meshes(demo_map, resolution=0.008).items():
        k = demo_map.object_ids.index(object_id) + 1
        corners, half = np.asarray(mesh.vertices, dtype=np.float64), 0.004 * mesh.vertex_normals
        assert np.mean(_inside(demo_map, k, corners - half) > 0.0) > 0.9
        assert np.mean(_inside(demo_map, k, corners + half) < 0.0) > 0.9


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("resolution", [0.01, 0.017])
def test_random_maps_give_closed_surfaces(seed, resolution):
    map_ = random_map(seed, objects=2)
    meshes = extract_meshes(map_, level=[0.5, 0.2, 0.8][seed % 3], resolution=resolution)
    assert all(_closed(mesh) for mesh in meshes.values())


def test_objects_do_not_overlap_and_fill_the_union():
    # Two blobs that touch.
    rng = np.random.default_rng(0)
    hinges = np.concatenate(
        [rng.normal((0, 0, 0), 0.01, (6, 3)), rng.normal((0.05, 0, 0), 0.01, (6, 3))]
    )
    weights = np.zeros((12, 3))
    weights[:, 0] = -4.0
    weights[:6, 1] = weights[6:, 2] = 4.0
    map_ = KernelMap(hinges, weights, np.array([3.0, 0.0, 0.0]))
    meshes = extract_meshes(map_, resolution=0.005)
    union = extract_union_mesh(map_, resolution=0.005)
    assert union is not None
    assert _closed(union)
    total = sum(mesh.volume for mesh in meshes.values())
    assert total == pytest.approx(union.volume, rel=0.08)
    points = rng.uniform(union.bounds[0], union.bounds[1], (3000, 3))
    inside = map_.occupancy(points) >= 0.5
    assert (union.contains(points) == inside).mean() > 0.97


def test_values_on_the_level_at_nodes_leave_no_holes():
    """Symmetric maps put P = level exactly on nodes; slivers there used to open the mesh."""
    map_ = KernelMap(
        np.array([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0]]),
        np.array([[-3.0, 3.0], [-3.0, 3.0]]),
        np.array([3.0, 0.0]),
    )
    radius = 0.03
    level = float(map_.occupancy(np.array([[0.0, 0.0, radius]]))[0])
    mesh = extract_meshes(map_, level=level, resolution=0.01)[1]
    assert _closed(mesh)


def test_absent_object_is_left_out_with_a_warning(caplog):
    map_ = random_map(3, objects=2)
    map_.weights[:, 2] = -5.0
    with caplog.at_level(logging.WARNING):
        meshes = extract_meshes(map_)
    assert set(meshes) == {1}
    assert "object 2" in caplog.text


def test_nothing_at_all_is_none():
    map_ = KernelMap(np.zeros((1, 3)), np.array([[0.0, 0.0]]), np.array([9.0, 0.0]))
    assert extract_union_mesh(map_) is None
    assert extract_meshes(map_) == {}


@pytest.mark.parametrize("level", [0.0, 1.0, -1.0, float("nan")])
def test_level_is_checked(level):
    with pytest.raises(ConfigError, match="level"):
        extract_meshes(random_map(0), level=level)


@pytest.mark.parametrize("resolution", [0.0, float("nan"), 2.0, 2e-4])
def test_resolution_is_checked(resolution):
    with pytest.raises(ConfigError, match="resolution"):
        extract_union_mesh(random_map(0), resolution=resolution)
