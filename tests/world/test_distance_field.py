# SPDX-License-Identifier: BSD-3-Clause
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.world_oracles import brute_force_distance
from scipy.spatial import cKDTree

from vprism_plan.errors import WorldError
from vprism_plan.world.distance import (
    DistanceField,
    Lattice,
    NodeDistances,
    bounds_on,
    checked_points,
    distance_to_lattice,
    finish,
    round_down,
)
from vprism_plan.world.grid import Grid


def _random_lattice(seed: int, density: float, factor: int) -> tuple[Lattice, Grid]:
    rng = np.random.default_rng(seed)
    labels = rng.integers(1, 5, rng.integers(1, 14, 3)).astype(np.uint8)
    labels[rng.random(labels.shape) > density] = 0
    corner = rng.integers(-10, 10, 3)
    shape = tuple(int(n) for n in rng.integers(2, 9, 3))
    return Lattice(labels, corner, factor), Grid(0.1, rng.integers(-3, 3, 3), shape)


@settings(max_examples=150)
@given(
    st.integers(0, 2**31), st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]), st.sampled_from([1, 2, 4])
)
def test_transform_equals_brute_force_on_unequal_lattices(seed, density, factor):
    lattice, grid = _random_lattice(seed, density, factor)
    distance, label = distance_to_lattice(lattice, grid)
    targets = np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3) + grid.first
    in_lattice = targets * factor - lattice.corner
    expected = brute_force_distance(lattice.labels, in_lattice) * 0.1 / factor
    flat = distance.reshape(-1).astype(np.float64)
    assert (flat <= expected).all()
    np.testing.assert_allclose(flat, expected, rtol=1e-6)
    for target, d, mark in zip(in_lattice, expected, label.reshape(-1), strict=True):
        if np.isinf(d):
            assert mark == 0
        else:
            own = brute_force_distance(lattice.labels == mark, target[None])[0] * 0.1 / factor
            assert own == pytest.approx(d)


def _field(
    seed: int, density: float = 0.02, solid: bool = False
) -> tuple[DistanceField, np.ndarray, float]:
    """Field of random cells, the lower corners of the cells, and their edge."""
    rng = np.random.default_rng(seed)
    cells = rng.random((20, 16, 24)) < density
    cells[5, 5, 5] = True
    nodes = np.zeros(np.array(cells.shape) + 1, dtype=np.uint8)
    for corner in np.ndindex(2, 2, 2):
        nodes[tuple(slice(c, c + n) for c, n in zip(corner, cells.shape, strict=True))] |= cells
    grid = Grid(0.02, np.array([-2, 3, 0]), (15, 13, 17))
    first = grid.first * 2 + 2
    distance, _ = distance_to_lattice(Lattice(nodes, first, 2), grid)
    if solid:
        index = np.indices(grid.shape)
        edge = [np.minimum(i, n - 1 - i) for i, n in zip(index, grid.shape, strict=True)]
        distance = np.minimum(distance, round_down(0.02 * np.minimum.reduce(edge).astype(float)))
    part = NodeDistances(distance, np.zeros(grid.shape, dtype=np.int16))
    return finish(part, grid, ("thing",), solid), 0.01 * (np.argwhere(cells) + first), 0.01


def _to_cells(points: np.ndarray, corners: np.ndarray, edge: float) -> np.ndarray:
    out = np.empty(len(points))
    for i, p in enumerate(points):
        gap = np.maximum(np.maximum(corners - p, p - corners - edge), 0.0)
        out[i] = np.sqrt((gap**2).sum(axis=1)).min()
    return out


@pytest.mark.parametrize("seed", range(6))
def test_bound_never_exceeds_the_distance_and_is_close(seed):
    field, corners, edge = _field(seed, density=[0.0, 0.001, 0.005, 0.02, 0.1, 0.4][seed])
    rng = np.random.default_rng(seed)
    points = rng.uniform(field.origin - 0.15, field.upper + 0.15, (4000, 3))
    truth = _to_cells(points, corners, edge)
    bound = field.lower_bound(points)
    assert (bound <= truth).all()
    inside = ((points >= field.origin) & (points <= field.upper)).all(axis=1)
    far = inside & (truth > 3 * field.spacing)
    loss = (truth - bound)[far] / field.spacing
    assert loss.size == 0 or loss.max() < 0.75
    # Within touching distance the cell's corners leave at most twice their distance.
    assert ((truth - np.maximum(bound, 0.0))[inside] <= 1.75 * field.spacing).all()


@pytest.mark.parametrize("seed", range(6))
def test_bounds_on_another_grid_never_exceed_the_distance_and_are_close(seed):
    field, corners, edge = _field(seed, density=[0.0, 0.001, 0.005, 0.02, 0.1, 0.4][seed])
    rng = np.random.default_rng(seed)
    grid = Grid(0.005, rng.integers(-30, 10, 3), tuple(rng.integers(2, 40, 3).tolist()))
    found = bounds_on(field, grid)
    points = grid.slab(0, grid.shape[0])
    bound, truth = found.distance.reshape(-1), _to_cells(points, corners, edge)
    assert (bound <= truth).all()
    asked = np.maximum(field.lower_bound(points), 0.0)
    # Three axes, each half way between nodes 4 apart: at most sqrt(3) 2 steps.
    assert (asked - bound).max() < 3.5 * grid.spacing
    assert (asked - bound)[asked > 0.1].max(initial=0.0) < 0.5 * grid.spacing


@pytest.mark.parametrize("seed", range(3))
def test_depth_inside_is_never_underestimated(seed):
    field, corners, edge = _field(seed, density=0.7)
    rng = np.random.default_rng(seed)
    lower, upper = corners.min(axis=0), corners.max(axis=0) + edge
    points = rng.uniform(lower, upper, (1500, 3))
    points = points[_to_cells(points, corners, edge) == 0.0]
    bound = field.lower_bound(points)
    assert (bound <= 0.0).all()
    # Distance to open space, from a dense sample of it: at least the true one.
    probes = rng.uniform(field.origin, field.upper, (30000, 3))
    probes = probes[_to_cells(probes, corners, edge) > 0.0]
    depth = cKDTree(probes).query(points)[0]
    sample_gap = 0.012
    assert (-bound >= depth - sample_gap).all()


def test_no_obstacle_is_far_finite_and_differentiable():
    grid = Grid(0.05, np.array([0, 0, 0]), (4, 5, 6))
    part = NodeDistances(
        np.full(grid.shape, np.inf, dtype=np.float32), np.full(grid.shape, -1, dtype=np.int16)
    )
    field = finish(part, grid, (), False)
    bound = field.lower_bound(np.array([[0.1, 0.1, 0.1], [9.0, 9.0, 9.0]]))
    assert np.isfinite(bound).all()
    assert (bound > 0.2).all()


def test_everything_solid_is_deep():
    grid = Grid(0.05, np.array([0, 0, 0]), (4, 5, 6))
    part = NodeDistances(
        np.zeros(grid.shape, dtype=np.float32), np.zeros(grid.shape, dtype=np.int16)
    )
    field = finish(part, grid, ("all",), True)
    assert (field.distance < -0.3).all()


def test_solid_outside_reaches_into_the_last_cells():
    field, corners, edge = _field(1, density=0.005, solid=True)
    rng = np.random.default_rng(0)
    points = rng.uniform(field.origin - 0.05, field.upper + 0.05, (4000, 3))
    faces = np.minimum(points - field.origin, field.upper - points).min(axis=1)
    bound = field.lower_bound(points)
    assert (bound <= np.minimum(faces, _to_cells(points, corners, edge))).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.array([[0.0, np.nan, 0.0]]), "finite"),
        (np.array([[np.inf, 0.0, 0.0]]), "finite"),
        (np.zeros((3, 2)), "shape"),
        (np.zeros(3), "shape"),
    ],
)
def test_unusable_points_are_refused(points, message):
    with pytest.raises(WorldError, match=message):
        checked_points(points)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_interpolation_is_trilinear_and_exact_at_nodes(dtype):
    from scipy.interpolate import RegularGridInterpolator

    field, _, _ = _field(2)
    axes = [
        o + field.spacing * np.arange(n)
        for o, n in zip(field.origin, field.distance.shape, strict=True)
    ]
    slow = RegularGridInterpolator(axes, field.distance.astype(np.float64))
    points = np.random.default_rng(0).uniform(field.origin, field.upper, (2, 300, 3))
    points[0, :2] = field.origin, field.upper
    fast = field.distance_at(torch.tensor(points, dtype=dtype))
    assert fast.shape == (2, 300)
    assert fast.dtype == dtype
    np.testing.assert_allclose(
        fast.numpy(), slow(points), atol=1e-5 if dtype == torch.float32 else 1e-7
    )


@pytest.mark.parametrize("solid", [False, True])
def test_interpolation_gradients(solid):
    field, _, _ = _field(2, solid=solid)
    rng = np.random.default_rng(1)
    inside = rng.uniform(field.origin, field.upper, (20, 3))
    outside = field.upper + rng.uniform(0.01, 0.2, (20, 3))
    points = torch.tensor(np.concatenate([inside, outside]), requires_grad=True)
    assert torch.autograd.gradcheck(field.distance_at, (points,), eps=1e-7, atol=1e-4)
    assert torch.isfinite(torch.autograd.grad(field.distance_at(points).sum(), points)[0]).all()


def test_round_down_never_rounds_up():
    values = np.random.default_rng(0).normal(size=10000)
    assert (round_down(values).astype(np.float64) <= values).all()
    np.testing.assert_allclose(round_down(values), values, rtol=2e-7)
