# SPDX-License-Identifier: BSD-3-Clause
"""Entropy where nothing was seen: the figures against loops, the report from stubs."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.small_scenes import small_scene

from experiments.scene_truth import ELSEWHERE, OCCLUDED, OCCLUDED_OUTSIDE, VISIBLE
from experiments.tables import intersections, uncertainty
from experiments.tables import uncertainty_report as report
from vprism_plan._threads import worker_count
from vprism_plan.errors import ConfigError


@given(seed=st.integers(0, 10**6))
def test_the_area_under_the_curve_is_the_chance_of_the_larger_value(seed):
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 6, 20) / 5.0  # with ties
    positive = rng.random(20) < 0.4
    pairs = [
        1.0 if a > b else 0.5 if a == b else 0.0
        for a in values[positive]
        for b in values[~positive]
    ]
    expected = np.mean(pairs) if pairs else math.nan
    assert uncertainty.area_under_curve(values, positive) == pytest.approx(expected, nan_ok=True)


def test_one_side_alone_has_no_area():
    assert math.isnan(uncertainty.area_under_curve(np.ones(3), np.ones(3, bool)))
    assert math.isnan(uncertainty.area_under_curve(np.ones(3), np.zeros(3, bool)))


def test_figures_are_those_of_a_loop_over_points():
    rng = np.random.default_rng(0)
    proba = rng.dirichlet([0.4, 0.4, 0.4], 60)
    part = rng.integers(0, 5, 60).astype(np.uint8)
    truth = rng.integers(-1, 3, 60)
    found = uncertainty.figures_of(proba, part, truth)
    entropy = [-sum(p * math.log(p) for p in row if p > 0) for row in proba]

    def rows(*parts):
        return [i for i in range(60) if part[i] in parts]

    def area(chosen, positive):
        yes, no = [i for i in chosen if positive(i)], [i for i in chosen if not positive(i)]
        wins = sum((entropy[a] > entropy[b]) + 0.5 * (entropy[a] == entropy[b])
                   for a in yes for b in no)  # fmt: skip
        return wins / (len(yes) * len(no))

    def loss(chosen):
        return np.mean([-math.log(max(proba[i, truth[i]], 1e-6)) for i in chosen if truth[i] >= 0])

    near = rows(VISIBLE, OCCLUDED)
    judged = [i for i in near if truth[i] >= 0]
    every = [i for i in range(60) if part[i] != ELSEWHERE]
    expected = {
        "entropy_observed": np.mean([entropy[i] for i in rows(VISIBLE)]),
        "entropy_occluded": np.mean([entropy[i] for i in rows(OCCLUDED)]),
        "auc_occluded": area(near, lambda i: part[i] == OCCLUDED),
        "auc_everywhere": area(every, lambda i: part[i] in (OCCLUDED, OCCLUDED_OUTSIDE)),
        "auc_wrong": area(judged, lambda i: proba[i].argmax() != truth[i]),
        "log_loss_observed": loss(rows(VISIBLE)),
        "log_loss_occluded": loss(rows(OCCLUDED)),
    }
    assert found == pytest.approx(expected)
    assert list(found) == list(uncertainty.FIGURES)
    assert set(uncertainty.figures_of(proba, part)) < set(expected)


class Shadow:
    """Certain in front of x = 0, in doubt behind it; its objects overlap at x > 0.02."""

    object_ids = (2, 5)

    def predict_proba(self, points):
        doubt = 0.3 * (points[:, 0] > 0.0) + 0.3 * (points[:, 0] > 0.02)
        return np.column_stack([1.0 - doubt, doubt, doubt])


def save_quickly(figure, path):
    """Draw everything once, small and without arranging it."""
    figure.set_layout_engine("none")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=15)


@pytest.fixture
def stubs(monkeypatch):
    """The comparison with stubs in place of scenes and methods."""

    class Method:
        label, level = "stub", 0.5

        @staticmethod
        def fit(observation, seed):
            return Shadow()

    scene = small_scene()
    for module in (uncertainty, report, intersections):
        monkeypatch.setattr(module, "method", lambda key: Method)
    monkeypatch.setattr("experiments.generation.generate", lambda *a, **k: scene)
    monkeypatch.setattr(report, "save_figure", save_quickly)
    monkeypatch.setattr(intersections, "save_figure", save_quickly)
    monkeypatch.setattr(report, "_RESOLUTION", 0.01)
    monkeypatch.setattr(report, "_SCENES_SHOWN", 2)
    monkeypatch.setattr(intersections, "_FINE", 0.004)
    monkeypatch.setattr(intersections, "_CELL", 0.01)
    answer = {"figures": dict.fromkeys(uncertainty.FIGURES, 0.25), "commit": "abc"}
    answer["figures"]["auc_wrong"] = None  # no mistakes in that scene
    monkeypatch.setattr(uncertainty, "sweep", lambda task, cases, *a, **k: [answer] * len(cases))
    monkeypatch.setattr(uncertainty, "real_observations", lambda f: [("frame0", scene.observation)])
    return scene


def test_the_report_holds_every_set_and_frame(stubs, tmp_path):
    figures, files = uncertainty.run(
        ["analytic"], 2, 7, store=tmp_path / "s", output=tmp_path / "o", command="again"
    )
    names = ["uncertainty.png", "uncertainty-real.png", "uncertainty.json", "uncertainty.md"]
    assert [file.name for file in files] == names
    assert all(file.stat().st_size > 0 for file in files)
    assert json.loads(files[2].read_text()) == figures
    row = figures["sets"]["analytic"]["methods"]["vprism"]
    assert row["entropy_occluded"] == {"value": 0.25, "low": 0.25, "high": 0.25}
    assert row["auc_wrong"]["value"] is None
    real = figures["real"]["frame0"]["sgd"]
    assert real["entropy_occluded"] > real["entropy_observed"]  # shadows fall towards +x
    text = files[3].read_text()
    assert "again" in text
    assert "## analytic: 2 scenes" in text
    assert "| frame0 | stub |" in text


def test_frames_and_pictures_were_fitted_with_other_threads_than_answers(
    stubs, tmp_path, monkeypatch
):
    monkeypatch.setenv("VPRISM_PLAN_THREADS", "3")
    used = []
    fit = report.method("sgd").fit

    def counted(observation, seed):
        used.append(worker_count())
        return fit(observation, seed)

    monkeypatch.setattr(report.method("sgd"), "fit", staticmethod(counted))
    uncertainty.run(["analytic"], 1, 7, store=tmp_path / "s", output=tmp_path / "o")
    assert used == [1] * (5 + 2 * 2)  # five methods on one frame, two on two scenes
    assert worker_count() == 3


def test_a_slice_keeps_near_and_far_apart(monkeypatch):
    monkeypatch.setattr(report, "_RESOLUTION", 0.01)
    scene = small_scene()  # the camera looks along +x
    heat = report.heat_of("small", scene.observation, {"sgd": Shadow()}, scene)
    entropy = heat.entropy["sgd"]
    assert entropy.shape == heat.hidden.shape == heat.outline.shape
    assert entropy[0].max() == pytest.approx(0.0)  # near
    assert entropy[-1].min() > 0.1  # far
    middle = entropy.shape[1] // 2
    assert not heat.hidden[0, middle]
    # The box stands at +y, left of this camera.
    columns = np.linspace(*heat.extent[:2], entropy.shape[1])
    deep = np.unravel_index(heat.outline.argmin(), heat.outline.shape)
    assert abs(columns[deep[1]]) > 0.01


def test_intersections_are_counted_and_drawn(stubs, tmp_path):
    files = intersections.run(tmp_path, seeds=[1])
    assert [file.name for file in files] == [f"intersections.{e}" for e in ("png", "json", "md")]
    row = json.loads(files[1].read_text())["rows"][0]
    points = intersections.claimed_points(stubs)
    assert row["sigmoid"]["twice"] == (points[:, 0] > 0.02).sum()
    assert row["sigmoid"]["twice"] == row["sigmoid"]["claimed"]
    assert "(100.0 %)" in files[2].read_text()
    assert points[:, 2].min() > 0.0


def test_bad_questions_are_named(tmp_path):
    with pytest.raises(ConfigError, match="scenes is 0"):
        uncertainty.run(["analytic"], 0, store=tmp_path, output=tmp_path)
    with pytest.raises(ConfigError, match=r"frame\*-depth.png"):
        uncertainty.real_observations(tmp_path)
