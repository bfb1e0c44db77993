"""The whole way on real depth images: no labels, no camera pose, a path planned and verified."""

import json

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.cli import main
from vprism_plan.planning import read_trajectory

FRAMES = (0, 2, 4, 6, 8)


@pytest.mark.slow
@pytest.mark.parametrize("frame", FRAMES)
def test_a_verified_path_around_real_objects(
    frame, real_frames, repository, tmp_path, capsys, monkeypatch
):
    if frame != FRAMES[0]:  # one set of pictures is drawn; a third of the time goes into them
        monkeypatch.setattr("vprism_plan.cli._plans._draw", lambda *_: None)
    path = next(f for f in real_frames if f.name == f"frame{frame}-depth.png")
    urdf = repository / "urdf" / "panda.urdf"
    output = tmp_path / "out"
    code = main(["plan", str(path), "--robot", str(urdf), "--output", str(output), "--json"])
    printed = capsys.readouterr().out
    assert code == 0, printed
    report = json.loads(printed)
    # Verified again from what was written, by a checker of our own.
    names, trajectory = read_trajectory(output / "trajectory.json")
    map_ = vp.load_map(output / "map.safetensors")
    assert len(map_.object_ids) >= 3
    robot = vp.Robot.from_urdf(urdf, base_pose=np.array(report["base_pose"]))
    assert tuple(names) == tuple(robot.joint_names)
    checker = vp.CollisionChecker(vp.World(map_), robot)
    assert checker.is_valid_batch(trajectory.positions).all()
    assert np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0]) > 0.5
