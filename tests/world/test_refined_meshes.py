# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces found by halving cells are those of the whole grid, and the field holds them."""

import logging

import numpy as np
import pytest
from oracles.world_oracles import KernelMap, random_map
from scipy.spatial import cKDTree

from vprism_plan.errors import ConfigError
from vprism_plan.world import extract_meshes
from vprism_plan.world.levelset import lattice_refinement, trace_level_set
from vprism_plan.world.meshes import extract_refined_meshes

LEVELS = [0.5, 0.2, 0.8]


@pytest.mark.parametrize("seed", range(4))
def test_halving_gives_the_surface_of_the_whole_grid(seed):
    map_, level, spacing = random_map(seed, objects=1 + seed % 2), LEVELS[seed % 3], 0.0055
    dense = extract_meshes(map_, level, spacing)
    refined = extract_refined_meshes(map_, level, spacing)
    assert set(refined) == set(dense)
    for object_id, mesh in refined.items():
        whole = dense[object_id]
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(whole.volume, rel=2e-3)
        for a, b in ((mesh, whole), (whole, mesh)):
            away, _ = cKDTree(a.vertices).query(b.vertices)
            assert away.max() < spacing


def test_a_fitted_map_gives_the_same_surfaces(fitted_map):
    dense = extract_meshes(fitted_map, 0.5, 0.005)
    refined = extract_refined_meshes(fitted_map, 0.5, 0.005)
    assert set(refined) == set(dense)
    for object_id, mesh in refined.items():
        assert mesh.volume == pytest.approx(dense[object_id].volume, rel=1e-3)


def covered(cells, points, spacing):
    """Whether the cells of a level set's cover hold each point."""
    index = np.floor(points / spacing).astype(np.int64)
    inside = np.zeros(len(points), dtype=bool)
    for part in cells.cells:
        corners = {tuple(corner) for corner in part.index}
        owners = index // part.size * part.size
        inside |= np.array([tuple(owner) in corners for owner in owners])
    return inside


@pytest.mark.parametrize("seed", range(4))
def test_no_triangle_leaves_the_cover_of_the_level_set(seed):
    """So a mesh on the field's lattice cannot touch what the field calls free."""
    map_, level, resolution = random_map(seed, objects=2), LEVELS[seed % 3], 0.01
    spacing = resolution / lattice_refinement(resolution, map_)
    cover = trace_level_set(map_, spacing, level)
    for mesh in extract_refined_meshes(map_, level, spacing).values():
        assert covered(cover, np.asarray(mesh.triangles_center), spacing).all()


def test_an_object_that_reaches_the_level_nowhere_is_left_out(caplog):
    map_ = random_map(3, objects=2)
    map_.weights[:, 2] = -5.0
    with caplog.at_level(logging.WARNING):
        meshes = extract_refined_meshes(map_, 0.5, 0.005)
    assert set(meshes) == {1}
    assert "object 2" in caplog.text


def test_a_surface_at_the_edge_of_the_support_is_closed():
    """A first grid that barely holds the object leaves its outermost nodes empty."""
    map_ = KernelMap(np.zeros((1, 3)), np.array([[-6.0, 6.0]]), np.array([3.0, 0.0]))
    for halvings in range(4):
        assert extract_refined_meshes(map_, 0.5, 0.004, halvings)[1].is_watertight


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"level": 0.0}, "level"),
        ({"spacing": float("nan")}, "spacing"),
        ({"spacing": 2e-4}, "coarser"),
        ({"halvings": -1}, "halvings"),
    ],
)
def test_what_is_out_of_range_is_named(changes, match):
    arguments = {"level": 0.5, "spacing": 0.005, "halvings": None} | changes
    if match == "coarser":
        arguments["halvings"] = 0
    with pytest.raises(ConfigError, match=match):
        extract_refined_meshes(random_map(0), **arguments)
