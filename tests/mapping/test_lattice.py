# SPDX-License-Identifier: BSD-3-Clause
"""The lattice of hinge points leaves little trace in the risk of a path."""

import pytest

from vprism_plan.evaluation.lattice import ball_scene, shift_lattice
from vprism_plan.mapping import MapConfig


@pytest.mark.parametrize(
    ("config", "tolerance"),
    [(MapConfig(), 0.2), (MapConfig.fine(), 0.08)],
    ids=["default", "fine"],
)
def test_half_a_cell_moves_no_risk_by_more_than_the_stated_tolerance(config, tolerance):
    scene, ends = ball_scene(1)
    shift = shift_lattice(scene, ends, config, n_worlds=1024)
    assert shift.largest <= tolerance
