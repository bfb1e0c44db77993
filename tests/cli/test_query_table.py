"""`vprism-plan query`: the table says what the library says, and JSON has all of it."""

import json

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene, render
from vprism_plan.simulation.solids import Box

BASE = ("--base-xyz", "-0.4", "0", "-0.1")
FREE, BLOCKED = ("1.2", "0.1", "0"), ("0", "0", "0")


@pytest.fixture(scope="module")
def saved_map(tmp_path_factory):
    """A coarse map of one box."""
    pose = np.eye(4)
    pose[2, 3] = 0.05
    camera = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.8, 0.3, 0.7)
    view = render(Scene((Box((0.04, 0.03, 0.05), pose=pose),), (1,), camera), camera)
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    config = vp.MapConfig(hinge_spacing=0.06, surface_hinges=8, iterations=2)
    vp.fit_map(view, config).save(path)
    return path


@pytest.fixture
def ask(saved_map, repository, capsys):
    def query(*arguments):
        robot = repository / "urdf" / "planar3.urdf"
        code = main(["query", str(saved_map), "--robot", str(robot), *BASE, *arguments])
        streams = capsys.readouterr()
        assert streams.err == "" or code == 2
        return code, streams.out if code < 2 else streams.err

    return query


def checker_of(saved_map, repository, **config):
    base = np.eye(4)
    base[:3, 3] = -0.4, 0.0, -0.1
    robot = vp.Robot.from_urdf(repository / "urdf" / "planar3.urdf").with_base_pose(base)
    world = vp.World(vp.load_map(saved_map))
    return vp.CollisionChecker(world, robot, vp.CheckerConfig(**config))


def test_the_table_lists_the_nearest_pairs_first(ask):
    code, out = ask("--q", *FREE, "--rows", "4")
    assert code == 0
    lines = out.splitlines()
    assert lines[0].startswith("free: clearance")
    assert any(line.startswith("P(collision)") for line in lines)
    assert any(line.startswith("map entropy") for line in lines)
    top = next(i for i, line in enumerate(lines) if line.startswith("link "))
    assert {"body", "clearance", "P(occ)", "entropy", "steepest"} <= set(lines[top].split())
    rows = lines[top + 1 : top + 5]
    assert "farther pairs" in lines[top + 5]
    shown = [float(row.split(" mm")[0].split()[-1]) for row in rows]
    assert shown == sorted(shown)
    assert all(len(line) <= 100 for line in rows)


@pytest.mark.slow
def test_json_says_what_the_library_says(ask, saved_map, repository):
    code, out = ask("--q", *FREE, "--json")
    assert code == 0
    report = json.loads(out)
    checker = checker_of(saved_map, repository)
    # The base faces the objects, which here lie straight ahead of it, but for the noise.
    checker = vp.CollisionChecker(
        checker.world, checker.robot.with_base_pose(np.array(report["base_pose"])), checker.config
    )
    q = np.array(report["q"])
    margins = checker.safety_margin(q)
    assert report["margins"] == json.loads(json.dumps(margins.to_dict()))
    assert report["risk"] == json.loads(json.dumps(checker.collision_probability(q).to_dict()))
    assert report["entropy"] == json.loads(json.dumps(checker.path_entropy(q).to_dict()))
    first = report["margins"]["margins"][0]
    assert len(first["gradient"]) == len(report["joint_names"]) == 3
    assert set(report["timings"]) >= {"bake", "check", "margins", "risk"}


@pytest.mark.slow
def test_a_refusal_names_reasons_risk_and_what_may_be_touched(ask):
    code, out = ask("--q", *BLOCKED)
    assert code == 1
    assert out.startswith("refused")
    assert "object:1" in out
    assert "P(collision) 1.000" in out or "P(collision) 0.9" in out
    reasons = [line.split() for line in out.splitlines() if " mm into object:1" in line]
    touching = sorted({words[0] for words in reasons})
    assert touching
    allow = [f"{link}:1" for link in touching]
    code, out = ask("--q", *BLOCKED, "--allow", *allow, "--json")
    report = json.loads(out)
    assert not any(c["contact_body_2"] == "object:1" for c in report["contacts"])
    allowed = {(m["link"], m["body"]) for m in report["margins"]["margins"] if m["allowed"]}
    assert allowed == {(link, "object:1") for link in touching}


def test_what_cannot_be_asked_is_bad_input(ask):
    for arguments, word in (
        (("--allow", "hand"), "LINK:ID"),
        (("--allow", "nothing:1"), "nothing"),
        (("--max-risk", "2"), "max_risk"),
    ):
        code, err = ask("--q", *FREE, *arguments)
        assert code == 2
        assert word in err
        assert len(err.splitlines()) == 1
