# SPDX-License-Identifier: BSD-3-Clause
"""The examples of trajectory optimisation end with free paths, and draw them."""

import re
import runpy
import sys

import pytest


@pytest.fixture
def said_by(repository, demo_map, tmp_path, monkeypatch, capsys):
    """A function that runs an example as a program and returns what it printed."""
    file = tmp_path / "demo.safetensors"
    demo_map.save(file)

    def run(name):
        picture = tmp_path / f"{name}.png"
        script = repository / "examples" / f"{name}.py"
        monkeypatch.setattr(
            sys, "argv", [str(script), "--picture", str(picture), "--map", str(file)]
        )
        runpy.run_path(str(script), run_name="__main__")
        assert picture.stat().st_size > 10_000
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_a_planners_path_gets_shorter_and_no_nearer(said_by):
    said = said_by("04_trajectory_optimisation")
    assert "from nothing: exact" in said
    lengths = [float(r) for r in re.findall(r"^(?:RRTConnect|optimised): ([\d.]+) rad", said, re.M)]
    gaps = [float(g) for g in re.findall(r"at least (-?[\d.]+) mm everywhere", said)]
    assert lengths[1] < 0.75 * lengths[0]
    assert gaps[1] >= gaps[0] - 0.5
    nats = [float(n) for n in re.findall(r"rad, ([\d.]+) nats", said)]
    assert nats[1] < nats[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["04a_costs_in_a_torch_loop", "04b_costs_in_scipy"])
def test_costs_alone_lead_to_a_free_path_too(said_by, name):
    said = said_by(name)
    free, edges = re.findall(r"(\d+) of (\d+) edges free", said)[-1]
    assert free == edges
    before, after = (float(v) for v in re.search(r"cost ([\d.]+) to ([\d.]+)", said).groups())
    assert after < 0.2 * before
