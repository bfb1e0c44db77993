# SPDX-License-Identifier: BSD-3-Clause
"""Maps against true scenes: what is counted where, and that it repeats exactly."""

import json

import numpy as np
import pytest
from oracles import calibration_oracle as oracle

from experiments import calibration as cal
from experiments import path_calibration as paths
from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.simulation.scenes import random_scene
from vprism_plan.world import PosteriorWorlds, World, WorldConfig

COARSE = MapConfig(hinge_spacing=0.06, iterations=3, below_plane_samples=500)


@pytest.fixture(scope="module")
def scene():
    return random_scene(2, 11)


@pytest.fixture(scope="module")
def fitted(scene):
    return fit_map(scene.observation, COARSE, seed=0)


@pytest.fixture(scope="module")
def voxels(scene, fitted):
    return cal.evaluate_voxels(scene, fitted, spacing=0.02)


def test_every_figure_is_that_of_a_loop_over_points(scene, fitted, voxels):
    points = cal.evaluation_points(scene, 0.02)
    part = cal.knowledge(fitted, points)
    occupied = fitted.occupancy(points)
    inside = scene.signed_distance(points) <= 0
    for k in range(3):
        own = np.flatnonzero(part == k)
        table = voxels.parts[k]
        assert table.n == len(own)
        if len(own) == 0:
            continue
        p, y = occupied[own].tolist(), inside[own].tolist()
        assert table.brier == pytest.approx(oracle.brier(p, y), abs=1e-9)
        assert table.ece == pytest.approx(oracle.ece(p, y, 10), abs=1e-9)
    assert min(voxels.parts[0].n, voxels.parts[1].n) > 0
    hidden = [i for i in range(len(points)) if inside[i] and part[i] in (cal.SUPPORTED, 2)]
    assert voxels.true == len(hidden)
    assert voxels.found == sum(occupied[i] >= 0.5 for i in hidden)
    assert voxels.found_supported <= voxels.true_supported <= voxels.true
    found, proba = [], fitted.predict_proba(points)
    for row in proba:
        k = int(row[1:].argmax())
        found.append(fitted.object_ids[k] if 1.0 - row[0] >= 0.5 else 0)
    true = scene.object_of(points).tolist()
    expected = [oracle.iou(found, true, k) for k in fitted.object_ids]
    assert voxels.ious == pytest.approx(expected)


def test_the_split_is_the_one_a_world_makes(scene, fitted):
    points = cal.evaluation_points(scene, 0.04)
    box = (tuple(points.min(axis=0) - 0.05), tuple(points.max(axis=0) + 0.05))
    status = World(fitted, WorldConfig(bounds=box, resolution=0.02)).status(points)
    part = cal.knowledge(fitted, points)
    supported = fitted.support(points) >= 0.5
    above = fitted.plane.signed_distance(points) >= 0
    assert ((part == cal.VISIBLE) == ((status == 0) & above)).all()
    assert ((part == cal.SUPPORTED) == ((status == 1) & supported & above)).all()
    assert ((part == cal.UNSUPPORTED) == ((status == 1) & ~supported & above)).all()


def test_the_same_seed_gives_the_same_figures(voxels):
    first = cal.calibrate_voxels(2006, COARSE, spacing=0.03)
    assert cal.calibrate_voxels(2006, COARSE, spacing=0.03) == first
    both = cal.VoxelCalibration.merged([first, voxels])
    assert both.true == first.true + voxels.true
    assert both.ious == first.ious + voxels.ious
    assert cal.VoxelCalibration.from_dict(json.loads(json.dumps(both.to_dict()))) == both


def test_scenes_vary_and_some_hide_an_object():
    scenes = [cal.calibration_scene(seed) for seed in range(2006, 2009)]
    assert len({len(s.solids) for s in scenes}) > 2
    hidden = cal.calibration_scene(2003)  # 2003 = 5 modulo 6
    assert set(hidden.object_ids) - set(np.unique(hidden.observation.labels)) == {2}


def test_sweeps_are_where_they_are_said_to_be(scene):
    ends = paths.random_sweeps(scene, 50, 3)
    np.testing.assert_array_equal(ends, paths.random_sweeps(scene, 50, 3))
    assert (ends != paths.random_sweeps(scene, 50, 4)).any()
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert (length <= 0.4 + 1e-9).all()
    assert (ends[:, :, 2] > paths.RADIUS).all()


def test_swept_voxels_are_those_of_a_ball_moved_in_small_steps():
    rng = np.random.default_rng(1)
    start, end = rng.uniform(-0.08, 0.08, (2, 3))
    found = {tuple(row) for row in paths.swept_voxels(start, end, 0.03, 0.02)}
    assert found
    for index in np.ndindex(11, 11, 11):
        voxel = tuple(i - 5 for i in index)
        centre = tuple(0.02 * i for i in voxel)
        touched = oracle.sweep_is_touched(centre, tuple(start), tuple(end), 0.03)
        gap = paths._distance_to_segment(np.array([centre]), start, end)[0] - 0.03
        if abs(gap) > 1e-4:
            assert (voxel in found) == touched


def test_paths_are_counted_as_the_draws_and_the_solids_say(scene, fitted):
    result = paths.evaluate_paths(scene, fitted, 6, seed=5, n_worlds=64)
    assert paths.evaluate_paths(scene, fitted, 6, seed=5, n_worlds=64) == result
    assert paths.PathCalibration.from_dict(json.loads(json.dumps(result.to_dict()))) == result
    worlds = PosteriorWorlds(fitted, 64, 5, reach=0.06)
    for case, (start, end) in zip(result.cases, paths.random_sweeps(scene, 6, 5), strict=True):
        index = paths.swept_voxels(start, end, paths.RADIUS, worlds.resolution)
        inside = (worlds.owners(index) > 0).any(axis=0)
        assert case.inside == inside.sum()
        assert case.hits >= case.inside  # errs to "touches"
        near = min(
            scene.signed_distance((start + t * (end - start))[None])[0]
            for t in np.linspace(0, 1, 300)
        )
        assert case.distance == pytest.approx(near - paths.RADIUS, abs=1e-3)
    judged = [case for case in result.cases if not case.unsupported]
    y = [case.distance < 0 for case in judged]
    p = [case.hits / 64 for case in judged]
    assert result.reliability().ece == pytest.approx(oracle.ece(p, y, 10))
    p = [case.inside / 64 for case in judged]
    assert result.reliability(inside=True).brier == pytest.approx(oracle.brier(p, y))


def test_paths_called_safe_are_counted_by_their_upper_bound():
    def case(hits, distance, unsupported=False):
        return paths.PathCase(hits, hits, 512, distance, unsupported)

    # With 512 worlds an upper bound below 1 percent takes no hits at all (0.72 percent).
    cases = (case(0, 0.1), case(0, -0.01), case(1, -0.1), case(0, -0.1, True), case(400, -0.1))
    result = paths.PathCalibration(cases)
    assert result.called_safe(0.01) == (2, 1)
    assert result.called_safe(0.012) == (3, 2)
    assert result.called_safe(0.001) == (0, 0)
    assert len(result.judged) == 4
