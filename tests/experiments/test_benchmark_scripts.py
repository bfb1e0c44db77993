# SPDX-License-Identifier: BSD-3-Clause
"""What scripts of benchmarks/ keep between runs is taken again only if it answers the question."""

import importlib
import importlib.util
import json
from pathlib import Path

import pytest

from vprism_plan.mapping import MapConfig

BENCHMARKS = Path(__file__).resolve().parents[2] / "experiments" / "benchmarks"


def script(name):
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Part:
    """Examples that remember what they were made of."""

    def __init__(self, text):
        self.text = text

    def save(self, file):
        file.write_text(self.text)


def test_examples_of_other_settings_were_taken_again(tmp_path, monkeypatch):
    train = script("train_pointsdf")
    monkeypatch.setattr(train.Examples, "load", staticmethod(Path.read_text))
    made = []

    def make(seed):
        made.append((seed, train.QUERIES))
        learn = Part(f"{seed} {train.QUERIES}")
        return learn, Part("some") if train.QUERIES == 512 else None

    def collected():
        return train.collected("solids", make, range(2), tmp_path)

    assert collected() == collected() == (["0 512", "1 512"], ["some", "some"])
    assert made == [(0, 512), (1, 512)]
    monkeypatch.setattr(train, "QUERIES", 256)
    assert collected() == collected() == (["0 256", "1 256"], [])  # nothing old is left
    monkeypatch.setattr(train, "VERSION", train.VERSION + 1)
    collected()
    assert made[2:] == [(0, 256), (1, 256)] * 2


@pytest.fixture
def calibration(monkeypatch):
    """The script with nothing to compute; `asked` names the scenes that were evaluated."""
    module = script("calibration")
    module.asked = []

    class Nothing:
        solids = ()
        observation = None

        @staticmethod
        def to_dict():
            return {"cases": []}

    def scene(seed):
        module.asked.append(seed)
        return Nothing

    monkeypatch.setattr(module, "calibration_scene", scene)
    monkeypatch.setattr(module, "fit_map", lambda *a, **k: None)
    monkeypatch.setattr(module, "evaluate_voxels", lambda *a: Nothing)
    monkeypatch.setattr(module, "evaluate_paths", lambda *a: Nothing)
    return module


def test_kept_scenes_were_taken_again_after_the_code_changed(calibration, tmp_path, monkeypatch):
    keep, config = tmp_path / "7.json", MapConfig()
    first = calibration.one_scene(7, config, 2, keep)
    assert calibration.one_scene(7, config, 2, keep) == first
    # What was kept before there was a number is of the first version.
    del first["asked"]["version"]
    keep.write_text(json.dumps(first))
    assert calibration.one_scene(7, config, 2, keep) == first
    assert calibration.asked == [7]
    monkeypatch.setattr(calibration, "VERSION", 2)
    calibration.one_scene(7, config, 2, keep)
    calibration.one_scene(7, config, 2, keep)
    assert calibration.asked == [7, 7]
    calibration.one_scene(7, config, 3, keep)
    assert calibration.asked == [7, 7, 7]
    assert json.loads(keep.read_text())["asked"]["paths"] == 3


@pytest.mark.parametrize("name", sorted(file.stem for file in BENCHMARKS.glob("[!_]*.py")))
def test_every_benchmark_can_be_loaded_as_a_module(name):
    """Two imported a neighbour by its bare name, which works for a script alone."""
    assert callable(importlib.import_module(f"experiments.benchmarks.{name}").main)
