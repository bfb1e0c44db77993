# SPDX-License-Identifier: BSD-3-Clause
"""Reconstructions against true scenes: known overlaps and distances, slow loops, losses."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import calibration_oracle
from oracles import reconstruction_oracle as oracle

from experiments import reconstruction as rec
from experiments import scene_truth as st_module
from experiments.scene_truth import NodeUnion, SceneTruth
from vprism_plan.errors import ConfigError
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box, sphere


def pose(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


class Known:
    """A reconstruction that says of each object what a function of the points says."""

    def __init__(self, **objects):
        self.object_ids = tuple(int(name[1:]) for name in objects)
        self.functions = list(objects.values())

    def predict_proba(self, points):
        each = np.stack([f(np.asarray(points)) for f in self.functions], axis=1)
        return np.column_stack([np.prod(1.0 - each, axis=1), each])


def solid(shape, steepness=None):
    """P(object) of a solid: 1 inside, or falling over a length."""
    if steepness is None:
        return lambda points: (shape.signed_distance(points) <= 0.0).astype(float)
    return lambda points: 1.0 / (1.0 + np.exp(shape.signed_distance(points) / steepness))


CAMERA = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.8, 0.3, 0.7, width=160, height=120,
    intrinsics=np.array([[152.0, 0.0, 79.5], [0.0, 152.0, 59.5], [0.0, 0.0, 1.0]]))  # fmt: skip
# Faces on multiples of 1.5 cm, between the grid points.
BOX = Box((0.03, 0.03, 0.045), pose=pose(0.0, 0.0, 0.045))
BALL = sphere(0.05, pose(0.15, 0.02, 0.05))


@pytest.fixture(scope="module")
def scene():
    """A box, a ball, a box that no pixel shows, and clutter."""
    hidden = Box((0.008, 0.008, 0.008), pose=pose(-0.06, -0.015, 0.008))
    clutter = Box((0.02, 0.02, 0.02), pose=pose(0.0, 0.15, 0.02))
    return Scene((BOX, BALL, hidden, clutter), (1, 4, 7, 0), CAMERA, seed=3)


@pytest.fixture(scope="module")
def truth(scene):
    return SceneTruth.of(scene)


def test_the_truth_itself_is_perfect(scene, truth):
    assert truth.object_ids == (1, 4)
    assert truth.hidden == (7,)
    scores = rec.evaluate_reconstruction(
        scene, Known(o1=solid(BOX), o4=solid(BALL, 0.003)), truth=truth
    )
    assert [o.iou for o in scores.objects] == [1.0, 1.0]
    assert (scores.hidden, scores.lost) == (1, 0)
    # Two samples of one surface, and a corner or two that marching cubes cut.
    assert scores.objects[1].chamfer < 0.0025
    pixels = [int((scene.observation.labels == k).sum()) for k in (1, 4)]
    assert [o.pixels for o in scores.objects] == pixels


@pytest.mark.parametrize(("shift", "iou"), [((0.03, 0, 0), 1 / 3), ((0, 0.015, 0.015), 15 / 33)])
def test_two_boxes_overlap_as_their_volumes(shift, iou, scene, truth):
    moved = Box(BOX.half_extents, pose=pose(*(np.array([0.0, 0.0, 0.045]) + shift)))
    scores = rec.evaluate_reconstruction(scene, Known(o1=solid(moved)), truth=truth)
    assert scores.objects[0].iou == pytest.approx(iou, abs=1e-12)


@pytest.mark.parametrize("continuous", [True, False])
def test_spheres_are_as_far_apart_as_their_radii_both_ways(continuous, scene, truth):
    larger = sphere(0.06, pose(0.15, 0.02, 0.05))
    scores = rec.evaluate_reconstruction(
        scene, Known(o4=solid(larger, 0.005)), truth=truth, continuous=continuous
    )
    assert scores.objects[1].chamfer == pytest.approx(0.02, abs=0.0007)


@pytest.mark.parametrize("phase", [0.0, 0.5])
def test_voxels_are_not_shifted_wherever_they_begin(phase, scene, truth):
    """A box of whole voxels of 1 cm on either of two lattices, asked per voxel."""
    low, high = np.array([2.0, -4.0, 1.0]) - phase, np.array([7.0, 2.0, 8.0]) - phase

    def voxels(points):
        index = np.floor(points / 0.01 + phase)  # faces at 0.01 * (i - phase)
        return ((index >= low + phase) & (index < high + phase)).all(axis=1).astype(float)

    nodes = NodeUnion.around(truth.centers[:1], rec.VOXEL_SPACING, rec.VOXEL_SHIFT)
    values = np.zeros(nodes.inside.shape, dtype=np.float32)
    values[nodes.inside] = voxels(nodes.points())
    origin = nodes.spacing * (nodes.first[0] + nodes.shift)
    mesh = rec.level_surface(values, 0.5, origin, nodes.spacing)
    assert mesh.bounds == pytest.approx(0.01 * np.stack([low, high]), abs=1e-6)


def test_what_is_not_reconstructed_is_lost(scene, truth):
    nothing = Known(o1=lambda points: np.full(len(points), 0.49))
    scores = rec.evaluate_reconstruction(scene, nothing, truth=truth)
    assert scores.lost == 2
    assert [o.iou for o in scores.objects] == [0.0, 0.0]
    assert math.isnan(scores.mean_chamfer)
    found = rec.evaluate_reconstruction(scene, nothing, 0.4, truth=truth)
    assert (found.lost, found.objects[1].lost) == (1, True)


def test_every_figure_is_that_of_a_loop_over_points(scene, truth):
    soft = Known(o1=solid(BOX, 0.01), o4=solid(sphere(0.045, pose(0.16, 0.03, 0.05)), 0.006))
    scores = rec.evaluate_reconstruction(scene, soft, 0.3, truth=truth)
    points = truth.grid.points()
    proba, true = soft.predict_proba(points), scene.object_of(points)
    assert (truth.ids == true).all()
    index = {tuple(np.round(point, 9)): i for i, point in enumerate(points)}
    near = {}
    for cube, k in enumerate(truth.object_ids):
        low, high = np.asarray(scene.truth_meshes()[k].bounds)
        center = 0.5 * (low + high)
        own = [
            index[tuple(np.round(p, 9))]
            for p in oracle.grid_of(center, st_module.SPACING, st_module.REACH, 0.5)
        ]
        near[k] = set(own)
        assert set(np.flatnonzero(truth.grid.members(cube)).tolist()) == near[k]
        expected = oracle.iou_counts(
            own, lambda i, c=cube: proba[i, 1 + c], lambda i: true[i], k, 0.3
        )
        score = scores.objects[cube]
        assert (score.intersection, score.union) == expected
    assert set.union(*near.values()) == set(range(len(points)))
    for part in range(4):
        own = np.flatnonzero(truth.part == part)
        table = scores.parts[part]
        assert table.n == len(own)
        if not len(own):
            continue
        p, y = (1.0 - proba[own, 0]).tolist(), (true[own] != 0).tolist()
        assert table.brier == pytest.approx(calibration_oracle.brier(p, y), abs=1e-9)
        assert table.ece == pytest.approx(calibration_oracle.ece(p, y, 10), abs=1e-9)
        mean = sum(oracle.entropy(row) for row in proba[own].tolist()) / len(own)
        assert scores.mean_entropy(part) == pytest.approx(mean)
    assert min(scores.parts[k].n for k in (0, 1, 2)) > 0


def test_what_is_known_is_decided_point_by_point(scene, truth):
    seen, points = scene.observation, truth.grid.points()
    hinges = st_module.reference_hinges(seen)
    rng = np.random.default_rng(0)
    for i in rng.choice(len(points), 300, replace=False):
        point, part = points[i], int(truth.part[i])
        mass = oracle.kernel_mass(point.tolist(), hinges.tolist(), 1000.0, 1e-5)
        assert mass == pytest.approx(float(st_module.kernel_mass(points[i : i + 1], hinges)[0]))
        pixel = seen.intrinsics @ (np.linalg.inv(seen.pose) @ [*point, 1.0])[:3]
        u, v = np.round(pixel[:2] / pixel[2]).astype(int)
        looked_at = 0 <= u < 160 and 0 <= v < 120
        if not (1 <= u < 159 and 1 <= v < 119) and looked_at:
            continue
        if point[2] < 0 or not looked_at:
            assert part == st_module.ELSEWHERE
            continue
        assert part in ((0, 1) if mass >= 0.5 else (2, 3))
        window = np.s_[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        behind = pixel[2] - seen.depth[window]
        if behind.max() < 0.0:  # before every return around its pixel
            assert part in (0, 2)
        if behind.min() > 0.02 and (seen.labels[window] > 0).all():
            assert part in (1, 3)


def test_chamfer_is_that_of_all_pairs():
    rng = np.random.default_rng(1)
    a, b = rng.random((40, 3)), rng.random((25, 3))
    assert rec.cloud_distance(a, b) == pytest.approx(oracle.chamfer(a.tolist(), b.tolist()))
    assert rec.cloud_distance(a, a) == 0.0


def test_surface_points_lie_on_the_surface_evenly_and_repeat():
    mesh = BOX.mesh()
    points = st_module.surface_points(mesh, [1, 2])
    assert (points == st_module.surface_points(mesh, [1, 2])).all()
    assert np.abs(BOX.signed_distance(points)).max() < 1e-9
    on_top = (points[:, 2] > 0.09 - 1e-9).mean()
    assert on_top == pytest.approx(36.0 / (2 * 36.0 + 4 * 54.0), abs=0.015)


@settings(max_examples=20)
@given(
    # No grid point lies on the side of a cube, where rounding would decide.
    st.lists(st.tuples(*[st.integers(-300, 300)] * 3), min_size=1, max_size=3),
    st.sampled_from([(0.1, 0.0), (0.07, 0.5)]),
)  # fmt: skip
def test_the_union_of_grids_holds_every_node_once(centers, lattice):
    centers = 0.001 * np.array(centers) + 0.00037
    union = NodeUnion.around(centers, *lattice)
    points = union.points()
    assert len({tuple(p) for p in np.round(points, 6)}) == len(points)
    for cube, center in enumerate(centers):
        own = points[union.members(cube)]
        expected = oracle.grid_of(center, lattice[0], st_module.REACH, lattice[1])
        assert len(own) == len(expected)
        assert np.allclose(own, expected)


def test_the_same_again_and_back_from_json_and_added_up(scene, truth):
    some = Known(o1=solid(BOX, 0.01))
    one = rec.evaluate_reconstruction(scene, some, truth=truth)
    again = rec.evaluate_reconstruction(scene, some)
    text = json.dumps(one.to_dict(), allow_nan=False)
    assert text == json.dumps(again.to_dict())
    back = rec.ReconstructionScores.from_dict(json.loads(text))
    assert json.dumps(back.to_dict()) == text
    both = rec.ReconstructionScores.merged([one, back])
    assert len(both.objects) == 4
    assert (both.hidden, both.lost) == (2, 2)
    assert both.mean_iou == pytest.approx(one.mean_iou)
    assert [t.n for t in both.parts] == [2 * t.n for t in one.parts]
    assert both.mean_entropy(0, 1) == pytest.approx(one.mean_entropy(0, 1))


def test_what_cannot_be_judged_is_refused(scene, truth):
    with pytest.raises(ConfigError, match="level"):
        rec.evaluate_reconstruction(scene, Known(o1=solid(BOX)), 1.5, truth=truth)
    with pytest.raises(ConfigError, match=r"objects \[7\]"):
        rec.evaluate_reconstruction(scene, Known(o7=solid(BOX)), truth=truth)
    with pytest.raises(ConfigError, match="at least one"):
        rec.ReconstructionScores.merged([])
