# SPDX-License-Identifier: BSD-3-Clause
"""What public results promise as values: they compare without failing."""

import dataclasses
import importlib

import numpy as np
import pytest

from vprism_plan.collision import RiskEstimate
from vprism_plan.planning import PlanReport, PlanResult

FOLDERS = ("perception", "mapping", "world", "robots", "collision", "planning", "trajopt")


@pytest.mark.parametrize("folder", FOLDERS)
def test_what_holds_arrays_is_not_compared_by_value(folder):
    """`==` of arrays is an array, which is neither true nor false."""
    public = vars(importlib.import_module(f"vprism_plan.{folder}"))
    for name, kind in public.items():
        if name.startswith("_") or not dataclasses.is_dataclass(kind):
            continue
        types = {f.name: str(f.type) for f in dataclasses.fields(kind) if f.compare}
        arrays = [
            field
            for field, type_ in types.items()
            if ("ndarray" in type_ or "Tensor" in type_) and "Callable" not in type_
        ]
        assert not (kind.__dataclass_params__.eq and arrays), (name, arrays)


def test_estimates_and_plans_compare_and_hash():
    def estimate():
        return RiskEstimate(
            probability=0.5,
            lower=0.4,
            upper=0.6,
            confidence=0.95,
            n_worlds=64,
            seed=0,
            per_waypoint=np.array([0.5, 0.5]),
            certain=False,
            spacing=0.01,
            configurations=2,
            trace=tuple,
            volume=dict,
        )

    def planned():
        report = PlanReport(planner="RRT", seed=0, time_limit=1.0)
        return PlanResult(path=np.zeros((2, 3)), status="exact", report=report)

    for make in (estimate, planned):
        one, other = make(), make()
        assert one != other
        assert [one, other].index(other) == 1
        assert len({one, other, one}) == 2
