# SPDX-License-Identifier: BSD-3-Clause
"""The lattice of hinge points leaves little trace in the risk of a path."""

import pytest

from vprism_plan.evaluation.lattice import ball_scene, shift_lattice
from vprism_plan.mapping import MapConfig


@pytest.mark.parametrize(
    ("config", "touching", "passing"),
    [(MapConfig(), 0.45, 0.1), (MapConfig.fine(), 0.1, 0.05)],
    ids=["default", "fine"],
)
def test_half_a_cell_moves_no_risk_by_more_than_the_stated_tolerance(config, touching, passing):
    """The worst of twelve balls, for paths 5 mm and more behind it and for one that touches."""
    scene, ends = ball_scene(9)
    change = shift_lattice(scene, ends, config, n_worlds=1024).change
    assert change[0] <= touching
    assert change[1:].max() <= passing
