# SPDX-License-Identifier: BSD-3-Clause
"""What the page on other stacks shows runs, as far as their libraries are here; make's Python."""

import re
import subprocess
import sys

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.planning import time_parameterize, write_trajectory
from vprism_plan.world import Box, Cells, HalfSpace


class Recorder:
    """Stands for what is not installed here: takes anything and keeps what it was given."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs, self.calls = args, kwargs, []

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)

        def call(*args, **kwargs):
            made = Recorder(*args, **kwargs)
            self.calls.append((name, made))
            return made

        return call


def test_every_recipe_runs_on_its_side_of_the_door(repository, tmp_path, monkeypatch, ball_robot):
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra `export`)")
    import torch

    text = (repository / "docs" / "stacks.md").read_text()
    recipes = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(recipes) == 5
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self: self)  # no GPU here
    box = Box("crate", (0.3, 0.2, 0.4))
    node, vamp = Recorder(), Recorder()
    names = {
        "world": vp.World(known=[box]), "vp": vp, "np": np, "torch": torch, "vamp": vamp,
        "node": node, "VoxelGrid": Recorder, "Box": Box, "HalfSpace": HalfSpace, "Cells": Cells,
        "write_trajectory": write_trajectory, "time_parameterize": time_parameterize,
        "JointTrajectory": "JointTrajectory", "Path": __import__("pathlib").Path,
        "robot": ball_robot(0.05), "result": Recorder(), "T_world": np.eye(4),
    }  # fmt: skip
    names["result"].path = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    names["world"].export("table.npz")
    for recipe in recipes:
        exec(compile(recipe, "stacks.md", "exec"), names)
    assert (tmp_path / "table.scene").read_text().startswith("vprism_plan\n* known:crate\n")
    # The field in cuRobo's order and sign: at the crate's middle inside, positive.
    grid = names["grid"].kwargs
    shape = np.rint(np.array(grid["dims"]) / grid["voxel_size"]).astype(int)
    values = grid["feature_tensor"].reshape(*shape)
    lower = np.array(grid["pose"][:3]) - 0.5 * np.array(grid["dims"])
    index = tuple(np.floor((np.array([0.01, 0.01, 0.01]) - lower) / grid["voxel_size"]).astype(int))
    assert values[index] > 0.05
    assert values[0, 0, 0] < -0.3
    # VAMP's cuboids fill the crate: position, turn, half the edges.
    halves = [made.args for name, made in vamp.calls if name == "Cuboid"]
    volume = sum(float(np.prod(2 * half)) for _, _, half in halves)
    assert 0.3 * 0.2 * 0.4 <= volume < 1.6 * 0.3 * 0.2 * 0.4
    ((_, publisher),) = node.calls
    ((_, published),) = publisher.calls
    assert published.args[0] == (tmp_path / "motion.cdr").read_bytes()


@pytest.mark.skipif(sys.platform == "win32", reason="make")
def test_make_takes_the_python_that_is_there_or_says_that_none_is(repository, tmp_path):
    def make(*more, path):
        return subprocess.run(
            ["/usr/bin/env", "make", "-n", f"VENV={tmp_path}/venv", *more, "demo"], cwd=repository,
            env={"PATH": path}, capture_output=True, text=True, check=False,
        )  # fmt: skip

    tools = tmp_path / "bin"
    tools.mkdir()
    for name, code in {"python3.11": 127, "python3.12": 0}.items():  # the first is only a shim
        (tools / name).write_text(f"#!/bin/sh\nexit {code}\n")
        (tools / name).chmod(0o755)
    import shutil

    (tools / "make").symlink_to(shutil.which("make"))
    assert "python3.12 -m venv" in make(path=str(tools)).stdout
    (tools / "python3.12").unlink()
    missing = make(path=str(tools))
    assert missing.returncode != 0
    assert "none of Python 3.11 3.12 3.13 runs here" in missing.stderr
    assert "mine -m venv" in make("PYTHON=mine", path=str(tools)).stdout
