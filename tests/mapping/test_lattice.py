# SPDX-License-Identifier: BSD-3-Clause
"""The lattice of hinge points leaves little trace in the risk of a path."""

import pytest

from experiments.lattice import ball_scene, shift_lattice
from vprism_plan.mapping import MapConfig


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "seed", "touching", "passing", "n_worlds"),
    [
        (MapConfig(), 9, 0.45, 0.05, 1024),
        (MapConfig(), 8, 0.45, 0.1, 2048),  # 0.093
        (MapConfig.fine(), 9, 0.1, 0.05, 1024),
    ],
    ids=["default", "default, worst when passing", "fine"],
)
def test_half_a_cell_moves_no_risk_by_more_than_the_stated_tolerance(
    config, seed, touching, passing, n_worlds
):
    """Paths 5 mm and more behind a ball, and one that touches. Of twelve balls seed 8 is the
    one whose passing paths move most with the default (`docs/results/lattice.md`)."""
    scene, ends = ball_scene(seed)
    change = shift_lattice(scene, ends, config, n_worlds=n_worlds).change
    assert change[0] <= touching
    assert change[1:].max() <= passing
