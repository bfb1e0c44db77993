# SPDX-License-Identifier: BSD-3-Clause
"""`vprism-plan map` and the doors: recordings, clouds, several views, labels to leave out."""

import json

import numpy as np
import pytest
from oracles import view_files as files
from oracles.perception_oracles import Scene, intrinsics, look_at

import vprism_plan as vp
from vprism_plan.cli import main

SHAPE, K = (120, 160), intrinsics(160, 120)
BOXES = [((-0.1, -0.05, 0), (0, 0.05, 0.1)), ((0.05, -0.2, 0), (0.12, -0.1, 0.08))]


def seen_from(eye, posed=True) -> vp.Observation:
    pose = look_at(eye)
    depth, labels = Scene(boxes=BOXES).render(pose, K, SHAPE)
    return vp.Observation(depth, labels, K, pose if posed else None)


@pytest.fixture
def mapped(tmp_path, capsys):
    """Exit code, report and error lines of `map`."""

    def call(*arguments):
        output = tmp_path / "map.safetensors"
        code = main([*map(str, ("map", *arguments, "--output", output)), "--json"])
        streams = capsys.readouterr()
        return code, json.loads(streams.out) if streams.out else None, streams.err

    return call


def test_a_recording_is_segmented_and_lies_in_the_frame_asked_for(mapped, tmp_path):
    path = files.mcap(seen_from((0.6, 0.1, 0.5)), tmp_path)
    code, report, _ = mapped(path, "--frame", "base", "--at", "1.2")
    assert code == 0
    assert report["segmented"]
    assert not report["aligned"]
    assert len(report["objects"]) == 2
    np.testing.assert_allclose(report["map"]["plane"]["normal"], [0, 0, 1], atol=0.02)
    assert abs(report["map"]["plane"]["offset"]) < 0.005
    code, report, error = mapped(path, "--depth", "/cam/depth/camera_info")
    assert (code, report) == (2, None)
    assert "/cam/depth/image_raw (Image)" in error


def test_views_are_fitted_together(mapped, tmp_path):
    for name, eye in (("a", (0.6, 0.1, 0.5)), ("b", (-0.5, 0.3, 0.5))):
        (tmp_path / "views").mkdir(exist_ok=True)
        vp.save_observation(seen_from(eye), tmp_path / "views" / name)
    code, report, _ = mapped(tmp_path / "views")
    assert code == 0
    assert report["map"]["views"] == 2
    assert report["objects"] == [1, 2]
    one, other = (tmp_path / "views" / name for name in "ab")
    _, same, _ = mapped(one, other, "--background", "2")
    assert same["map"]["views"] == 2
    assert same["objects"] == [1]
    vp.save_observation(seen_from((0.1, 0.6, 0.5), posed=False), tmp_path / "views" / "c")
    code, report, error = mapped(tmp_path / "views")
    assert (code, report) == (2, None)
    assert f"{tmp_path / 'views' / 'c'} has no camera pose, which each of several" in error


def test_a_cloud_is_a_view(mapped, tmp_path):
    view = seen_from((0.6, 0.1, 0.5))
    path = files.pcd(view, tmp_path, *view.points())
    code, report, _ = mapped(path)
    assert code == 0
    assert report["objects"] == [1, 2]
    for (low, high), box in zip(BOXES, report["map"]["objects"].values(), strict=True):
        assert np.abs(np.array(box["upper"])[2] - high[2]) < 0.01
        assert (np.array(box["lower"])[:2] > np.array(low)[:2] - 0.02).all()
        assert (np.array(box["upper"])[:2] < np.array(high)[:2] + 0.02).all()
