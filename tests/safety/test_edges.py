"""Accepted edges of a Panda in the bundled scene, sampled densely against the exact map."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

import vprism_plan as vp

FINE = 0.0025
STEP = 0.0005


@pytest.fixture(scope="module")
def level_set(demo_map) -> cKDTree:
    """Points of {P(occupied) >= 1/2} on a 2.5 mm lattice."""
    lower, upper = demo_map.support_bounds()
    axes = [np.arange(a, b, 4 * FINE) for a, b in zip(lower, upper, strict=True)]
    coarse = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    near = coarse[demo_map.occupancy_log_odds(coarse) > -6.0]
    offsets = (np.indices((4, 4, 4)).reshape(3, -1).T - 1.5) * FINE
    fine = (near[:, None] + offsets).reshape(-1, 3)
    occupied = fine[demo_map.occupancy_log_odds(fine) >= 0.0]
    assert len(occupied) > 10_000
    return cKDTree(occupied)


@pytest.fixture(scope="module")
def checker(demo_world, repository):
    base = np.eye(4)
    base[:3, 3] = [-0.1, -0.55, 0.0]
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)
    return vp.CollisionChecker(demo_world, robot)


def accepted_edges(checker, n):
    """Edges that `check_motion` accepts, short and long, many of them near obstacles."""
    rng = np.random.default_rng(3)
    robot = checker.robot
    edges = []
    while len(edges) < n:
        Q = rng.uniform(robot.lower, robot.upper, (4096, robot.dof))
        Q = Q[checker.is_valid_batch(Q)]
        near = Q[np.argsort(checker.clearance_batch(Q))[: len(Q) // 2]]
        for qa in near:
            qb = qa + rng.uniform(0.02, 0.4) * (rng.uniform(robot.lower, robot.upper) - qa)
            if checker.check_motion(qa, qb):
                edges.append((qa, qb, checker.check_motion_report(qa, qb)))
    return edges[:n]


def around(path, close):
    """Samples no farther than two steps from a fourth one that is close, one by one."""
    index = np.minimum(4 * np.flatnonzero(close), len(path) - 1)
    index = np.unique(np.clip(index[:, None] + np.arange(-2, 3), 0, len(path) - 1))
    return path[index]


@pytest.mark.slow
def test_two_thousand_accepted_edges_touch_nothing(checker, level_set):
    edges = accepted_edges(checker, 2000)
    robot = checker.robot
    moving = ~robot.arrays.link_fixed[robot.sphere_links]
    radii = robot.sphere_radii[moving]
    examined = 0
    for qa, qb, report in edges:
        assert report.tolerance <= checker.config.tolerance
        steps = max(2, int(np.ceil(report.motion_bound / STEP)) + 1)
        path = qa + np.linspace(0.0, 1.0, steps)[:, None] * (qb - qa)
        # Farther off, the field itself proves the configuration free (tested on its own), and
        # no sphere moves by more than two steps, a millimetre, from every fourth sample.
        fourth = np.concatenate([path[::4], path[-1:]])
        near = around(path, checker.clearance_batch(fourth) <= 0.004 + 2 * STEP)
        centers = robot.sphere_centers(torch.from_numpy(near)).numpy()[:, moving]
        # No sphere reaches a point that is farther than the largest of them: inf is as good.
        gaps = level_set.query(centers, distance_upper_bound=radii.max())[0] - radii
        assert (gaps > -report.tolerance - 1e-9).all()
        assert (centers[..., 2] - radii > -report.tolerance - 1e-6).all()
        examined += len(near)
        folded = around(path, checker.self_clearance_batch(fourth) <= 4 * STEP)
        assert (checker.self_clearance_batch(folded) > -report.tolerance - 1e-9).all()
    assert examined > 0
