# SPDX-License-Identifier: BSD-3-Clause
"""Points in balls, against asking each ball about each point."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vprism_plan.perception.camera import within_balls


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 60))
def test_points_in_balls_of_all_sizes(seed, count):
    rng = np.random.default_rng(seed)
    balls = np.column_stack([rng.uniform(-1, 1, (count, 3)), 10 ** rng.uniform(-3, 0, count)])
    balls[rng.random(count) < 0.1, 3] = -0.01
    points = rng.uniform(-1.5, 1.5, (400, 3))
    if count:  # within their reach, too
        near = balls[rng.integers(0, count, 200)]
        points[:200] = near[:, :3] + rng.normal(size=(200, 3)) * np.abs(near[:, 3:])
    points[rng.random(400) < 0.05] = np.nan
    away = np.linalg.norm(points[:, None] - balls[:, :3], axis=2)
    with np.errstate(invalid="ignore"):
        expected = (away <= balls[:, 3]).any(axis=1)
    np.testing.assert_array_equal(within_balls(points, balls), expected)


def test_a_ball_holds_its_middle_and_its_surface():
    balls = np.array([[1.0, 2.0, 3.0, 0.5], [0.0, 0.0, 0.0, 0.0]])
    points = np.array([[1.0, 2.0, 3.0], [1.5, 2.0, 3.0], [1.5001, 2.0, 3.0], [0.0, 0.0, 0.0]])
    assert within_balls(points, balls).tolist() == [True, True, False, True]
