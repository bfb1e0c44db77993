"""Settings compared on tuning scenes: the reference gains nothing, held-out scenes are refused."""

from dataclasses import replace

import pytest

from experiments.tables.tuning import compare
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig

COARSE = replace(
    MapConfig(), gamma=1000.0, hinge_spacing=0.06, hinge_reach=None, iterations=2,
    object_resolution=0.02, front_resolution=0.01, prior_logit_variance=10.0,
)  # fmt: skip


def test_the_first_setting_is_the_reference_and_answers_are_kept(tmp_path):
    settings = {"coarse": COARSE, "blind": replace(COARSE, prior_occupancy=0.01)}
    rows = compare(settings, "analytic", [0], tmp_path, jobs=1, progress=False)
    assert [row.name for row in rows] == ["coarse", "blind"]
    assert [g.value for g in rows[0].gains] == [0.0, 0.0, 0.0, 0.0]
    assert rows[1].gains[0].value == pytest.approx(rows[1].iou - rows[0].iou)
    assert 0.0 < rows[0].iou < 1.0
    kept = {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*.json")}
    assert len(kept) == 2
    assert (
        compare(settings, "analytic", [0], tmp_path, jobs=1, progress=False)[1].iou == rows[1].iou
    )
    assert kept == {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*.json")}


@pytest.mark.parametrize(
    ("kind", "seeds", "words"),
    [("random", [0], "'random' is not for tuning"), ("ycb", [1000], "seeds \\[1000\\]")],
)
def test_scenes_of_the_tables_are_not_tuned_on(tmp_path, kind, seeds, words):
    with pytest.raises(ConfigError, match=words):
        compare({"coarse": COARSE}, kind, seeds, tmp_path)
