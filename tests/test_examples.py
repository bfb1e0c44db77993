# SPDX-License-Identifier: BSD-3-Clause
"""What the examples say, beyond that they run and draw: building the site shows that."""

import os
import re
import runpy
import subprocess
import sys

import pytest


@pytest.fixture(scope="session")
def saved_demo_map(demo_map, tmp_path_factory):
    """The bundled scene's map in a file, so that no example fits it again."""
    path = tmp_path_factory.mktemp("example_maps") / "demo.safetensors"
    demo_map.save(path)
    return path


@pytest.fixture
def said_by(repository, saved_demo_map, tmp_path, monkeypatch, capsys):
    """A function that runs an example as a program and returns what it printed."""

    def run(number):
        (script,) = (repository / "examples").glob(f"{number}_*.py")
        picture = tmp_path / f"{number}.png"
        arguments = [str(script), "--picture", str(picture), "--map", str(saved_demo_map)]
        monkeypatch.setattr(sys, "argv", arguments)
        runpy.run_path(str(script), run_name="__main__")
        assert picture.stat().st_size > 10_000
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_a_bound_on_risk_gives_a_less_risky_path_than_none(said_by):
    said = said_by("03")
    found = re.findall(r"P\(collision\) (\d\.\d+)", said)
    straight, free, bounded, risky = (float(p) for p in found)
    assert straight > 0.5
    assert bounded <= 0.05
    assert bounded <= free
    assert "max_risk 0.05: exact" in said
    assert "too_risky: only riskier motions" in said
    assert risky > 0.05


@pytest.mark.slow
def test_a_path_may_end_touching_the_target_and_says_so(said_by):
    said = said_by("06")
    assert "without a rule: invalid_goal" in said
    assert "into object:1" in said
    assert "with it: exact" in said
    assert "ends touching object:1" in said


@pytest.mark.slow
def test_margins_name_the_nearest_pair_and_keep_what_the_checker_keeps(said_by):
    said = said_by("05")
    least = float(re.search(r"at least (-?[\d.]+) mm everywhere", said)[1])
    assert least >= 10.0 - 0.5
    assert re.search(r"nearest: panda_\w+ to \S+ on edge \d+", said)
    assert "safe up to" in said


@pytest.mark.slow
def test_a_robot_without_spheres_gets_some_that_hold_it_and_a_path(said_by):
    pytest.importorskip("pybullet_data", reason="pybullet is not installed (extra `experiments`)")
    said = said_by("07")
    links = re.findall(r"lbr_iiwa_link_\d .*", said)
    assert len(links) == 8
    assert all("proved" in link and "100.0 %" in link for link in links)
    assert "the same spheres when read: True" in said
    assert re.search(r"^exact path", said, flags=re.M)


@pytest.mark.slow
def test_your_own_ompl_program_leaves_without_binding_noise(repository, saved_demo_map, tmp_path):
    script = repository / "examples" / "02_your_own_ompl_program.py"
    picture = tmp_path / "02.png"
    done = subprocess.run(
        [sys.executable, script, "--picture", picture, "--map", saved_demo_map],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    free, edges = re.search(r"(\d+) of (\d+) edges free", done.stdout).groups()
    assert free == edges
    assert "nanobind" not in done.stderr
    assert picture.exists()


@pytest.fixture
def said_with_peer(repository, saved_demo_map):
    """A function that runs an example with a peer's library and returns what it printed."""

    def run(name, *more):
        script = repository / "examples" / "peers" / f"{name}.py"
        command = [sys.executable, script, "--map", saved_demo_map, *more]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.mark.slow
def test_coal_measures_what_we_measure(said_with_peer):
    pytest.importorskip("coal", reason="coal is not installed (extra `peers`)")
    found = re.search(
        r"(\d+) distances: ours are (\S+) to (\S+) mm below", said_with_peer("coal_distances")
    )
    assert int(found[1]) > 100
    assert float(found[2]) >= -0.5  # of the surface's own resolution, 4 mm
    assert float(found[3]) < 20.0


@pytest.mark.slow
def test_drake_keeps_the_clearance_it_is_given(said_with_peer):
    pytest.importorskip("pydrake", reason="drake is not installed (extra `peers`)")
    said = said_with_peer("drake_constraint")
    assert float(re.search(r"wanted: (\S+) mm", said)[1]) < 0.0
    assert "kSolutionFound" in said
    assert float(re.search(r"found: (\S+) mm, valid: True", said)[1]) > 19.0


@pytest.mark.slow
def test_mplib_plans_on_our_boxes(said_with_peer):
    peer = os.environ.get("MPLIB_PYTHON")
    if peer is None:
        pytest.skip("MPLIB_PYTHON names no interpreter with mplib, which needs numpy below 2")
    said = said_with_peer("mplib_plans", "--peer", peer)
    free, edges = re.search(r"(\d+) of (\d+) edges free", said).groups()
    assert free == edges
