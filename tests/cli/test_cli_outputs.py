# SPDX-License-Identifier: BSD-3-Clause
"""What the command line writes is whole, current and honest, also when things go wrong."""

import json

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.cli._console import Console, dump_json, staged
from vprism_plan.cli._parsing import UsageError, parse
from vprism_plan.cli._placing import Surroundings, candidate_bases, choose_ends
from vprism_plan.cli._plans import PLAN_FILES, pose_matrix, true_distance
from vprism_plan.errors import PlanningError, VPrismError
from vprism_plan.planning.path import interpolated


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no command"),
        (["fly"], "fly"),
        (["map"], "VIEW"),
        (["map", "x.npz", "--seed", "many"], "many"),
        (["map", "x.npz", "--sede", "1"], "--sede"),
        (["plan", "x.npz", "--robot", "r.urdf", "--base-xyz", "1", "2"], "--base-xyz"),
        (["plan", "x.npz"], "--robot"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, words, capsys):
    with pytest.raises(UsageError, match=words.replace("*", r"\*")) as caught:
        parse(arguments)
    assert "\n" not in str(caught.value)
    assert not set("│╭╰─[") & set(str(caught.value).replace("['", "").replace("('", ""))
    assert main(arguments) == 2
    streams = capsys.readouterr()
    assert len(streams.err.splitlines()) == 1
    assert streams.out == ""


def test_an_unknown_planner_is_one_line_that_lists_all(capsys):
    assert main(["plan", "x.npz", "--robot", "r.urdf", "--planner", "A*"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'A*'" in line
    assert all(name in line for name in vp.planning.planners())


def test_negative_numbers_are_values():
    command = parse(["plan", "m", "--robot", "r", "--start", "-1e0", "2.5", "-.1", "--base-yaw=-1"])
    assert command.command == "plan"
    assert command.start == [-1.0, 2.5, -0.1]
    assert command.base_yaw == -1.0


def test_staged_files_appear_together_and_stale_ones_go(tmp_path):
    folder = tmp_path / "a" / "out"
    with staged(folder, PLAN_FILES) as aside:
        (aside / "trajectory.json").write_text("first")
        (aside / "report.json").write_text("first")
        assert not folder.exists()
    (folder / "notes.txt").write_text("the user's own")
    with staged(folder, PLAN_FILES) as aside:
        (aside / "report.json").write_text("second")
    assert sorted(p.name for p in folder.iterdir()) == ["notes.txt", "report.json"]
    assert (folder / "report.json").read_text() == "second"
    assert [p.name for p in folder.parent.iterdir()] == ["out"]


def stage_and_fail(folder, error):
    with staged(folder, PLAN_FILES) as aside:
        (aside / "report.json").write_text("half")
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_staging_that_fails_leaves_everything_as_it_was(tmp_path, error):
    folder = tmp_path / "new" / "out"
    with pytest.raises(error):
        stage_and_fail(folder, error)
    assert list(tmp_path.iterdir()) == []
    old = tmp_path / "old"
    old.mkdir()
    (old / "report.json").write_text("old")
    with pytest.raises(error):
        stage_and_fail(old, error)
    assert [p.name for p in tmp_path.iterdir()] == ["old"]
    assert (old / "report.json").read_text() == "old"


def test_output_that_is_a_file_is_named(tmp_path):
    (tmp_path / "out").write_text("x")
    with pytest.raises(VPrismError, match="out is a file"), staged(tmp_path / "out", ()):
        pass


def test_an_interrupt_is_not_an_answer(monkeypatch, capsys, tmp_path):
    from vprism_plan.cli import _maps

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(_maps, "fit_views", interrupted)
    assert main(["map", "x.npz", "--output", str(tmp_path / "m.safetensors")]) == 130
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_defect_is_neither_an_answer_nor_bad_input(monkeypatch, capsys):
    from vprism_plan.cli import _maps

    def broken(*_args, **_kwargs):
        raise AssertionError("defect")

    monkeypatch.setattr(_maps, "fit_views", broken)
    assert main(["map", "x.npz"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_json_is_strict():
    values = {"a": np.float64("nan"), "b": [np.inf, 1.0], "c": np.arange(2), "d": {1: None}}
    assert json.loads(dump_json(values)) == {
        "a": None,
        "b": [None, 1.0],
        "c": [0, 1],
        "d": {"1": None},
    }


def test_compilation_is_noticed_and_timed():
    import numba

    console = Console()

    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    with console.stage("work"):
        assert outer(3) == 8
    assert console.compiled == 1  # the inner one is part of the outer one
    assert 0 < console.compile_seconds <= console.timings["work"]
    assert "first use" in console.time_line()
    with console.stage("again"):
        outer(4)
    assert console.compiled == 1


def test_goal_poses_are_checked():
    pose = pose_matrix((0.1, 0.2, 0.3, 0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(pose[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_array_equal(pose[:3, 3], [0.1, 0.2, 0.3])
    with pytest.raises(PlanningError, match="length 2"):
        pose_matrix((0.1, 0.2, 0.3, 2.0, 0.0, 0.0, 0.0))


def test_true_distance_finds_the_nearest_sphere(ball_robot):
    robot = ball_robot(0.05)
    path = np.array([[-0.5, 0.02, 0.1], [0.5, 0.02, 0.1]])
    truth = true_distance(robot, path, lambda p: np.linalg.norm(p, axis=1) - 0.03)
    exact = np.hypot(0.02, 0.1) - 0.08
    assert exact <= truth["minimum_distance"] <= exact + 1e-5
    assert truth["largest_motion_between_samples"] < 0.002
    assert truth["fraction"] == pytest.approx(0.5, abs=0.01)
    dense = interpolated(path, 0.01)
    assert len(dense) == 101
    np.testing.assert_array_equal(dense[[0, -1]], path)


def test_bases_stand_beside_the_objects_and_face_them(demo_map, repository):
    around = Surroundings.of(demo_map)
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf")
    poses = list(candidate_bases(robot, around))
    first = poses[0][:2, 3] - around.middle
    towards = around.camera[:2] - around.middle
    assert first @ towards > 0.99 * np.linalg.norm(first) * np.linalg.norm(towards)
    for pose in poses:
        ahead = around.middle - pose[:2, 3]
        assert pose[:2, 0] @ ahead == pytest.approx(np.linalg.norm(ahead))
        assert np.linalg.norm(ahead) > around.half_width(ahead / np.linalg.norm(ahead)) + 0.19
        assert pose[2, 3] == pytest.approx(0.0, abs=0.005)


def test_ends_that_are_chosen_leave_most_of_a_bound_to_the_way(demo_map, repository, monkeypatch):
    around = Surroundings.of(demo_map)
    urdf = repository / "urdf" / "panda.urdf"
    pose = around.base_pose([0.05, -0.6, 0.0], np.pi / 2)
    checker = vp.CollisionChecker(vp.World(demo_map), vp.Robot.from_urdf(urdf, base_pose=pose))
    allowed = checker._bounded.allowed
    asked = []

    def reach(judge, *_):
        asked.append(judge._bounded.allowed)
        return judge.robot.neutral if len(asked) != 1 else None

    monkeypatch.setattr("vprism_plan.cli._placing._reach_for", reach)
    assert choose_ends(checker, around, np.random.default_rng(0)) is not None
    assert allowed > 4
    assert asked == [allowed // 4, allowed, allowed // 4]  # the first found nothing so careful


@pytest.mark.slow
def test_demo_writes_what_it_names_and_keeps_clear_of_the_truth(tmp_path, capsys):
    code = main(["demo", "--output", str(tmp_path / "demo"), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == 0
    written = {p.name for p in (tmp_path / "demo").iterdir()}
    assert written == {
        *("scene.png", "map.png", "plan.png", "map.safetensors", "meshes"),
        *("trajectory.json", "report.json"),
    }
    assert report["plan"]["status"] == "exact"
    assert report["plan"]["direct"] is False  # the clutter stands in the way
    assert report["truth"]["minimum_distance"] > 0.0
    assert report["clearance"]["minimum"] >= 0.0
    on_disk = json.loads((tmp_path / "demo" / "report.json").read_text())
    assert on_disk["truth"] == report["truth"]
    assert set(report["sizes"]) >= {"map.safetensors", "plan.png", "meshes/object_1.ply"}
