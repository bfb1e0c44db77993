# SPDX-License-Identifier: BSD-3-Clause
"""Tables of stub methods on tiny scenes: what is computed, kept, reported and refused."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from experiments import generation, reconstruction, scene_truth
from experiments.__main__ import main
from experiments.baselines import METHODS
from experiments.protocols import Method
from experiments.tables import intervals, pictures, scoring
from experiments.tables import reconstruction as tables
from experiments.tables.results import summary
from experiments.tables.sweep import SweepInputError
from vprism_plan.errors import ConfigError, MapError
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box

CAMERA = Camera.orbit(np.array([0.0, 0.0, 0.04]), 0.7, 0.3, 0.7, width=80, height=60,
    intrinsics=np.array([[70.0, 0.0, 39.5], [0.0, 70.0, 29.5], [0.0, 0.0, 1.0]]))  # fmt: skip
STUBS = {"voxel": (0.03, False), "vprism-paper": (0.015, True), "vprism": (0.0, True)}


class Boxes:
    """Each object is the box of its points, grown by a length."""

    def __init__(self, seen, grow):
        self.object_ids = seen.object_ids
        points, labels = seen.points()
        self.corners = [
            (points[labels == k].min(axis=0) - grow, points[labels == k].max(axis=0) + grow)
            for k in self.object_ids
        ]

    def predict_proba(self, points):
        each = [((points >= low) & (points <= high)).all(axis=1) for low, high in self.corners]
        held = 0.1 + 0.8 * np.stack(each, axis=1) / np.maximum(np.sum(each, axis=0), 1)[:, None]
        held[:, 1:] -= 0.1
        return np.column_stack([1.0 - held.sum(axis=1), held])


@pytest.fixture
def stubs(monkeypatch):
    """Small scenes instead of dropped meshes, boxes instead of methods; names what was fitted."""
    fitted = []

    def generate(kind, seed, *, data=None, **_):
        rng = np.random.default_rng([len(kind), seed])
        boxes = []
        for x in (-0.05, 0.06):
            half = rng.uniform(0.02, 0.04, 3)
            pose = np.eye(4)
            pose[:3, 3] = x, rng.uniform(-0.02, 0.02), half[2]
            boxes.append(Box(tuple(half), pose=pose))
        return Scene(tuple(boxes), (1, 2), CAMERA, None, seed, f"{kind}-{seed}")

    def method(key, grow, continuous):
        def fit(seen, seed):
            fitted.append((key, seed))
            return Boxes(seen, grow)

        return Method(key, METHODS[key].label, fit, continuous=continuous)

    monkeypatch.setattr(generation, "generate", generate)
    for key, (grow, continuous) in STUBS.items():
        monkeypatch.setitem(METHODS, key, method(key, grow, continuous))
    for module, name, value in (
        (scene_truth, "SPACING", 0.03), (scene_truth, "CLOUD", 300), (intervals, "RESAMPLES", 199),
        (reconstruction, "MESH_SPACING", 0.02), (reconstruction, "VOXEL_SPACING", 0.02),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    scoring._prepared.cache_clear()
    yield fitted
    scoring._prepared.cache_clear()


@pytest.fixture
def unpainted(monkeypatch):
    """Reports without pictures, which take longest."""
    monkeypatch.setattr(pictures, "figures", lambda *_: {})


def run(folder, key="baselines", **how):
    given = {
        "kinds": ("analytic",), "scenes": 3, "first_seed": 5, "jobs": 1, "progress": False,
        "methods": tuple(STUBS), "store": folder / "store", "output": folder / "out",
        "command": "python -m experiments baselines",
    }  # fmt: skip
    return tables.run(key, **{**given, **how})


def test_a_table_is_reprinted_from_what_is_kept(stubs, unpainted, tmp_path):
    results, files = run(tmp_path)
    assert sorted(stubs) == sorted((key, seed) for key in STUBS for seed in (5, 6, 7))
    assert [file.name for file in files] == ["baselines.json", "baselines.md"]
    texts = [file.read_bytes() for file in files]
    again, _ = run(tmp_path)
    assert len(stubs) == 9
    assert [file.read_bytes() for file in files] == texts
    assert again.sets[0].scores["voxel"].scenes == results.sets[0].scores["voxel"].scenes


def test_a_method_or_a_scene_more_computes_only_that(stubs, unpainted, tmp_path):
    run(tmp_path, methods=("voxel", "vprism"))
    stubs.clear()
    run(tmp_path)
    assert sorted(stubs) == [("vprism-paper", seed) for seed in (5, 6, 7)]
    stubs.clear()
    run(tmp_path, key="presets", methods=("vprism-paper", "vprism"), scenes=4)
    assert sorted(stubs) == [("vprism", 8), ("vprism-paper", 8)]


def test_another_preset_is_another_question_and_leaves_the_others_alone(monkeypatch):
    before = {key: scoring.method_question(key) for key in METHODS}
    assert before["vprism"]["config"] != before["vprism-fine"]["config"]
    assert "config" not in before["vprism-paper"]
    json.dumps(before, allow_nan=False)
    with monkeypatch.context() as patch:
        patch.setitem(scoring._PRESETS, "vprism", lambda: scoring.MapConfig(iterations=7))
        changed = {k for k in METHODS if scoring.method_question(k) != before[k]}
    assert changed == {"vprism"}


def test_the_report_says_what_the_json_says(stubs, tmp_path):
    results, files = run(tmp_path, kinds=("analytic", "random"))
    assert [file.name for file in files] == [
        "baselines.png", "baselines-reliability.png", "baselines-scenes.png", "baselines.json",
        "baselines.md",
    ]  # fmt: skip
    figures = json.loads(files[-2].read_text())
    text = files[-1].read_text()
    assert figures == json.loads(json.dumps(summary(results)))
    assert "seeds 5 to 7" in text
    assert "python -m experiments baselines" in text
    assert re.search(r"commit ([0-9a-f]{10}\+?|unknown)", text)
    assert "6 objects; 6 show" in text
    for kind in ("analytic", "random"):
        assert f"(`{kind}`)" in text
        for key in STUBS:
            row = figures["sets"][kind]["methods"][key]
            assert f"| {row['iou']['value']:.3f} [{row['iou']['low']:.3f}" in text
            assert row["iou"]["low"] <= row["iou"]["value"] <= row["iou"]["high"]
            scores = results.sets[0 if kind == "analytic" else 1].scores[key].all
            assert row["iou"]["value"] == pytest.approx(scores.mean_iou)
            assert row["chamfer"]["value"] == pytest.approx(scores.mean_chamfer)
        ours = figures["sets"][kind]["methods"]
        assert ours["vprism"]["iou"]["value"] > ours["voxel"]["iou"]["value"]
    claim = next(c for c in figures["claims"] if "higher IoU than the voxel" in c["claim"])
    assert claim["analytic"]["answer"] == "yes"
    assert f"| {claim['claim']} | **yes** (" in text
    for picture in re.findall(r"\]\((.*?\.png)\)", text):
        assert (files[0].parent / picture).stat().st_size > 5000


def test_a_claim_about_every_baseline_said_not_which_rows_it_had(stubs, unpainted, tmp_path):
    _, files = run(tmp_path)  # of nine rows, three
    text = files[-1].read_text()
    assert (
        "Rows of this table that were not computed: OctoMap; Point estimate (SGD); Sigmoid maps, "
        "one per object; PointSDF; Shape prior's network alone; V-PRISM (ours, flat prior). "
        '"Every baseline" below stands for Voxel.\n'
    ) in text
    _, files = run(tmp_path, key="presets", methods=("vprism-paper", "vprism"))
    assert "V-PRISM (ours, fine).\n" in files[-1].read_text()
    _, files = run(tmp_path, key="sampling", methods=tables.TABLES["sampling"].methods[1:2])
    assert '"Every' not in files[-1].read_text()


def test_objects_that_were_tuned_on_were_called_held_out(stubs, unpainted, tmp_path):
    _, files = run(tmp_path, kinds=("analytic", "random"), scenes=1)
    assert (
        "Our presets were chosen on seeds 0 to 99: `analytic` is held out by scene, not by object; "
        "the objects of `random` were in no tuning scene."
    ) in files[-1].read_text()


def test_answers_about_changed_scenes_are_not_mixed(stubs, unpainted, tmp_path, monkeypatch):
    run(tmp_path, methods=("voxel",))
    old = generation.generate
    monkeypatch.setattr(generation, "generate", lambda kind, seed, **k: old(kind, seed + 1, **k))
    scoring._prepared.cache_clear()
    with pytest.raises(ConfigError, match="different scenes analytic 5"):
        run(tmp_path, methods=("voxel", "vprism"))


def test_a_scene_that_fails_is_left_out_for_all_and_said(stubs, unpainted, tmp_path, monkeypatch):
    whole, _ = run(tmp_path / "whole", scenes=4)
    good = METHODS["vprism-paper"]

    def fit(seen, seed):
        if seed == 6:
            raise MapError("too many hinge points")
        return good.fit(seen, seed)

    monkeypatch.setitem(METHODS, "vprism-paper", replace(good, fit=fit))
    with pytest.raises(SweepInputError, match="analytic-6-vprism-paper: MapError: too many"):
        run(tmp_path, scenes=4)
    figures = json.loads((tmp_path / "out" / "baselines.json").read_text())
    assert figures["sets"]["analytic"]["scenes"] == 3
    for key in STUBS:
        rows = figures["sets"]["analytic"]["methods"][key]["scenes"]
        assert [row["seed"] for row in rows] == [5, 7, 8]
        others = [s.mean_iou for n, s in enumerate(whole.sets[0].scores[key].scenes) if n != 1]
        assert [row["iou"] for row in rows] == pytest.approx(others)
    text = (tmp_path / "out" / "baselines.md").read_text()
    assert "- analytic-6-vprism-paper: MapError: too many hinge points" in text
    with pytest.raises(SweepInputError):  # nothing left to report on
        run(tmp_path / "other", scenes=1, first_seed=6)
    assert not (tmp_path / "other" / "out").exists()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"key": "nothing"}, "baselines, sampling, presets"),
        ({"methods": ("vprsim",)}, "vprsim"),
        ({"kinds": ("ycbv",)}, "ycbv"),
        ({"kinds": ()}, "no set"),
        ({"scenes": 0}, "scenes is 0"),
        ({"methods": ("voxel", "voxel")}, "ask the same"),
    ],
)
def test_what_cannot_be_run_is_refused_at_once(how, message, stubs, tmp_path):
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, **how)
    assert stubs == []


def test_the_command_writes_a_report_and_prints_json(stubs, unpainted, tmp_path, capsys):
    words = ["baselines", "--set", "analytic", "--scenes", "2", "--jobs", "1", "--methods"]
    words += [*STUBS, "--store", str(tmp_path / "s"), "--output", str(tmp_path / "o"), "--json"]
    assert main(words) == 0
    streams = capsys.readouterr()
    found = json.loads(streams.out)
    assert found["command"].startswith("python -m experiments baselines --set analytic --scenes 2")
    assert set(found["means"]["analytic"]) == set(STUBS)
    assert all((tmp_path / "o" / name).is_file() for name in ("baselines.md", "baselines.json"))
    assert "6 of 6 done" in streams.err
    assert str(tmp_path) not in (tmp_path / "o" / "baselines.md").read_text()
    words.remove("--json")
    assert main(words) == 0
    assert "analytic vprism: IoU " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["baselines", "--set", "folder"], "--data"),
        (["uncertainty", "--methods", "voxel"], "--methods"),
        (["planning", "--methods", "voxel"], "voxel"),
        (["baselines", "--cluster", "here:1"], "--backend"),
        (["presets", "--methods", "best"], "best"),
        (["presets", "--first-seed", "-1"], "first-seed"),
    ],
)
def test_what_the_command_cannot_do_is_one_line(words, message, capsys, tmp_path):
    store = ["--store", str(tmp_path), "--output", str(tmp_path)]
    assert main([*words, *store]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
