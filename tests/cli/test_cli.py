"""The command line as a person uses it: answers, exit codes, one clear line for what is wrong."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene, render
from vprism_plan.simulation.solids import Box


@pytest.fixture(scope="module")
def view():
    """A small, clean view of one box."""
    pose = np.eye(4)
    pose[2, 3] = 0.05
    camera = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.8, 0.3, 0.7)
    box = Box((0.04, 0.03, 0.05), pose=pose)
    return render(Scene((box,), (1,), camera), camera)


@pytest.fixture(scope="module")
def saved_map(view, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    config = vp.MapConfig(hinge_spacing=0.06, surface_hinges=8, iterations=2)
    vp.fit_map(view, config).save(path)
    return path


def call(capsys, *arguments):
    """Exit code, standard output and standard error lines of one call."""
    code = main([str(argument) for argument in arguments])
    streams = capsys.readouterr()
    return code, streams.out, streams.err.splitlines()


def write(path, **arrays):
    np.savez(path, **arrays)
    return path


BROKEN = {
    "missing file": ("absent.npz", {}, "absent.npz"),
    "wrong shape": ("a.npz", {"depth": lambda d: d[0]}, "depth"),
    "labels of another shape": ("b.npz", {"labels": lambda x: x[:-1]}, "labels"),
    "negative depth": ("c.npz", {"depth": lambda d: np.where(d > 1.0, -0.5, d)}, "negative"),
    "singular intrinsics": ("e.npz", {"intrinsics": lambda k: 0 * k}, "intrinsics"),
    "pose that is not rigid": ("f.npz", {"T_world_camera": lambda t: 2 * t}, "T_world_camera|pose"),
    "no plane": ("g.npz", {"depth": lambda d: np.where(d > 0, 0 * d, d)}, "plane|depth|return"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_input_is_one_clear_line_and_leaves_nothing_behind(name, view, tmp_path, capsys):
    file, changes, words = BROKEN[name]
    arrays = {
        "depth": view.depth,
        "labels": view.labels,
        "intrinsics": view.intrinsics,
        "T_world_camera": view.T_world_camera,
    }
    path = tmp_path / file
    if changes:
        for key, change in changes.items():
            arrays[key] = change(arrays[key])
        write(path, **arrays)
    output = tmp_path / "out" / "map.safetensors"
    code, out, err = call(capsys, "map", path, "--output", output)
    assert code == 2
    assert out == ""
    assert len(err) == 1, err
    import re

    assert re.search(words, err[0]), err[0]
    assert not list(tmp_path.glob("out/*"))


def test_an_empty_table_is_mapped_and_planned_over(view, tmp_path, repository, capsys):
    empty = write(
        tmp_path / "empty.npz", depth=view.depth, labels=0 * view.labels,
        intrinsics=view.intrinsics, T_world_camera=view.T_world_camera,
    )  # fmt: skip
    code, out, _ = call(capsys, "map", empty, "--output", tmp_path / "map.safetensors")
    assert code == 0
    assert "0 objects" in out
    assert "warning: no pixel has an object's label" in out
    robot = ("--robot", repository / "urdf" / "panda.urdf")
    code, out, _ = call(
        capsys, "plan", tmp_path / "map.safetensors", *robot, "--output", tmp_path / "plan"
    )
    assert code == 0, out
    assert (tmp_path / "plan" / "map.png").exists()
    code, *_ = call(capsys, "view", tmp_path / "map.safetensors")
    assert code == 2
    code, *_ = call(capsys, "map", empty, "--output", tmp_path / "map.safetensors", "--strict")
    assert code == 2


def test_scattered_points_without_labels_have_no_plane(view, tmp_path, capsys):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 2.0, view.depth.shape)
    path = write(tmp_path / "noise.npz", depth=depth, intrinsics=view.intrinsics)
    code, _, err = call(capsys, "map", path, "--output", tmp_path / "map.safetensors")
    assert code == 2
    assert len(err) == 1
    assert "plane" in err[0]
    assert not (tmp_path / "map.safetensors").exists()


def test_a_failed_write_keeps_the_old_map(saved_map, tmp_path, capsys):
    old = tmp_path / "map.safetensors"
    old.write_bytes(b"old")
    code, *_ = call(capsys, "map", tmp_path / "absent.npz", "--output", old)
    assert code == 2
    assert old.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]


def test_map_writes_what_load_map_reads(view, tmp_path, capsys):
    path = write(
        tmp_path / "view.npz",
        depth=view.depth,
        labels=view.labels,
        intrinsics=view.intrinsics,
        T_world_camera=view.T_world_camera,
    )
    output = tmp_path / "map.safetensors"
    code, out, _ = call(capsys, "map", path, "--output", output, "--json")
    assert code == 0
    assert isinstance(json.loads(out), dict)
    assert vp.load_map(output).object_ids == (1,)


def planar(repository):
    return repository / "urdf" / "planar3.urdf"


def test_query_answers_with_reasons_and_codes(saved_map, repository, capsys):
    far = ("--base-xyz", "0", "0", "0.6")
    code, out, _ = call(
        capsys, "query", saved_map, "--robot", planar(repository), "--q", 0, 0, 0, *far
    )
    assert code == 0
    assert out.startswith("free")
    # The arm's plane cuts the box, and the box stands within its reach.
    near = ("--base-xyz", "-0.4", "0", "-0.1")
    code, out, _ = call(
        capsys, "query", saved_map, "--robot", planar(repository), "--q", 0, 0, 0, *near, "--json"
    )
    assert code == 1
    report = json.loads(out)
    assert report["valid"] is False
    assert any(c["contact_body_2"] == "object:1" for c in report["contacts"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--q", "0", "0"], "joint|shape"),
        (["--q", "0", "0", "0", "--margin", "-1"], "margin"),
    ],
)
def test_a_bad_question_is_bad_input(arguments, words, saved_map, repository, capsys):
    import re

    code, _, err = call(capsys, "query", saved_map, "--robot", planar(repository), *arguments)
    assert code == 2
    assert len(err) == 1
    assert re.search(words, err[0])


def test_query_and_plan_take_what_belongs_to_a_urdf(saved_map, repository, tmp_path, capsys):
    """Meshes in a folder of packages, spheres and an SRDF elsewhere, a group of its joints."""
    import trimesh

    urdf = planar(repository).read_text().replace('<robot name="planar3"', '<robot name="mine"')
    mesh = (
        '<collision><geometry><mesh filename="package://mine/m.stl"/></geometry></collision></link>'
    )
    own = tmp_path / "there" / "mine.urdf"
    own.parent.mkdir()
    own.write_text(urdf.replace("</link>", mesh, 1))
    (tmp_path / "packages" / "mine").mkdir(parents=True)
    trimesh.creation.box((0.02, 0.02, 0.02)).export(tmp_path / "packages" / "mine" / "m.stl")
    srdf = tmp_path / "other.srdf"
    srdf.write_text(
        planar(repository)
        .with_suffix(".srdf")
        .read_text()
        .replace(
            "</robot>",
            '<group name="two"><joint name="joint3"/><joint name="joint1"/></group></robot>',
        )
    )
    spheres = repository / "urdf" / "planar3_spheres.yml"
    options = ["--robot", own, "--srdf", srdf, "--spheres", spheres, "--group", "two"]
    options += ["--package-dirs", tmp_path / "packages", "--base-xyz", "3", "0", "-0.1", "--json"]
    code, out, _ = call(capsys, "query", saved_map, *options, "--q", "0.1", "0.2")
    said = json.loads(out)
    assert code == 0
    assert said["joint_names"] == ["joint3", "joint1"]
    assert not any("mesh" in text for text in said["warnings"])
    ends = ["--start", "0", "0.2", "--goal", "0", "0.5", "--output", tmp_path / "out"]
    code, out, _ = call(capsys, "plan", saved_map, *options, *ends)
    assert code == 0
    assert json.loads(out)["joint_names"] == ["joint3", "joint1"]
    code, _, err = call(capsys, "query", saved_map, *options, "--group", "none", "--q", "0")
    assert code == 2
    assert "'none'" in err[0]


def test_an_unknown_robot_file_is_bad_input(saved_map, tmp_path, capsys):
    code, _, err = call(
        capsys, "query", saved_map, "--robot", tmp_path / "none.urdf", "--q", "0", "0"
    )
    assert code == 2
    assert "none.urdf" in err[0]


def test_unknown_arguments_are_bad_input(capsys):
    code, *_ = call(capsys, "map", "--no-such-flag")
    assert code == 2


def test_an_unknown_policy_is_bad_input_and_the_valid_ones_are_listed(
    saved_map, repository, capsys
):
    policy = ("--occluded", "maybe")
    code, _, err = call(
        capsys, "query", saved_map, "--robot", planar(repository), "--q", 0, 0, 0, *policy
    )
    assert code == 2
    assert "posterior" in " ".join(err)


def test_mesh_writes_watertight_objects(saved_map, tmp_path, capsys):
    import trimesh

    code, out, _ = call(capsys, "mesh", saved_map, "--output", tmp_path / "meshes", "--json")
    assert code == 0
    assert isinstance(json.loads(out), dict)
    mesh = trimesh.load_mesh(tmp_path / "meshes" / "object_1.ply")
    assert mesh.is_watertight
    assert mesh.volume > 0


def test_plan_reports_an_invalid_goal_with_its_reason(saved_map, repository, tmp_path, capsys):
    free, blocked = ("1.2", "0", "0"), ("0", "0", "0")
    code, out, _ = call(
        capsys,
        *("plan", saved_map, "--robot", planar(repository), "--output", tmp_path / "out"),
        *("--base-xyz", "-0.4", "0", "-0.1", "--start", *free, "--goal", *blocked),
    )
    assert code == 1
    assert "goal is invalid" in out
    assert "object:1" in out
    assert not (tmp_path / "out" / "trajectory.json").exists()


def test_plan_writes_a_trajectory_that_reads_back(saved_map, repository, tmp_path, capsys):
    from vprism_plan.planning import read_trajectory

    output = tmp_path / "out"
    code, out, _ = call(
        capsys,
        *("plan", saved_map, "--robot", planar(repository), "--output", output, "--json"),
        *("--base-xyz", "0.45", "0", "-0.1", "--base-yaw", "3.14159"),
        *("--start", "1.2", "0", "0", "--goal", "-1.2", "0", "0"),
    )
    report = json.loads(out)
    assert code == 0, report
    names, trajectory = read_trajectory(output / "trajectory.json")[:2]
    assert len(names) == 3
    assert trajectory.positions.shape[1] == 3
    assert {p.name for p in output.iterdir()} >= {"plan.png", "map.png", "scene.png", "report.json"}


def test_help_answers_at_once():
    durations = []
    for _ in range(3):
        start = time.perf_counter()
        command = [sys.executable, "-m", "vprism_plan.cli", "--help"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        durations.append(time.perf_counter() - start)
    assert "demo" in done.stdout
    assert min(durations) < 1.0, durations
    heavy = (
        "import sys, vprism_plan.cli._parsing; "
        "print([m for m in ('torch', 'numba', 'ompl', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_warmup_compiles_each_half_that_is_not_cached_in_a_process_of_its_own(capsys, monkeypatch):
    started = []

    class Compiler:
        def __init__(self, command, **_):
            started.append(command[-1])
            self.code = command[-1] == "checks" and len(started) > 2

        def wait(self):
            return int(self.code)

    monkeypatch.setattr("subprocess.Popen", Compiler)
    monkeypatch.setattr("vprism_plan._kernels.jit.is_cached", lambda kernel: False)
    assert call(capsys, "warmup")[0] == 0
    assert started == ["maps", "checks"]
    code, _, errors = call(capsys, "warmup")  # this time the checks fail
    assert code == 2
    assert "checks failed" in errors[0]
    monkeypatch.setattr("vprism_plan._kernels.jit.is_cached", lambda kernel: True)
    assert call(capsys, "warmup")[0] == 0
    assert len(started) == 4


@pytest.mark.parametrize("suffix", [".bt", ".scene", ".npz", ".glb"])
def test_a_map_is_exported_by_its_suffix(suffix, saved_map, tmp_path, capsys):
    if suffix == ".bt":
        pytest.importorskip("pyoctomap")
    file = tmp_path / "out" / f"world{suffix}"
    box = ("--bounds", -0.1, -0.1, -0.02, 0.1, 0.1, 0.2)
    code, out, err = call(capsys, "export", saved_map, "--output", file, *box, "--json")
    assert (code, err) == (0, [])
    assert json.loads(out)["bytes"] == file.stat().st_size > 100
    code, _, err = call(capsys, "export", saved_map, "--output", tmp_path / "world.dae", *box)
    assert code == 2
    assert ".scene" in err[0]


def test_a_trajectory_is_exported_for_ros(tmp_path, capsys):
    from vprism_plan.planning.trajectory import Trajectory, write_trajectory

    motion = Trajectory(np.array([0.0, 1.5]), np.array([[0.0], [1.0]]), np.zeros((2, 1)))
    write_trajectory(tmp_path / "trajectory.json", ["slide"], motion)
    code, *_ = call(
        capsys, "export", tmp_path / "trajectory.json", "--output", tmp_path / "t.yaml",
        "--frame-id", "map",
    )  # fmt: skip
    assert code == 0
    assert "frame_id: map" in (tmp_path / "t.yaml").read_text()
