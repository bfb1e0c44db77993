# SPDX-License-Identifier: BSD-3-Clause
"""One scene, written by each format's own library, is the same view through every door."""

import sys
from dataclasses import dataclass

import numpy as np
import pytest
from oracles import view_files as files
from oracles.perception_oracles import Scene
from oracles.view_files import POSE, SHAPE, K
from scipy.spatial import cKDTree

from vprism_plan.errors import MissingDependencyError
from vprism_plan.perception import Observation, load_observation
from vprism_plan.perception.camera import invert_transform, project, transform_points

BOXES = [((-0.1, -0.05, 0), (0, 0.08, 0.12)), ((0.05, -0.2, 0), (0.12, -0.1, 0.08))]
MILLIMETRES = 0.51e-3


@pytest.fixture(scope="module")
def truth() -> Observation:
    depth, labels = Scene(boxes=BOXES, floor=-0.7).render(POSE, K, SHAPE)
    depth[40:44, :30] = 0.0  # nothing returned
    return Observation(depth, labels, K, POSE)


@dataclass
class Door:
    """What a form keeps of a view, and how it is written and asked for."""

    write: object
    labels: bool = True
    pose: bool = True
    tolerance: float = MILLIMETRES
    pixels: bool = True  # the images are the same, pixel by pixel
    ids: tuple[int, int] = (1, 2)  # of the two boxes
    options: tuple = ()
    warns: str = ""


ASKED = (("frame", "base"), ("at", 1.2))
DRIVEN = {"labels": False, "options": ASKED}
UNPOSED = {"labels": False, "pose": False}
MM = "taken as millimetres"
DOORS = {
    "npz": Door(
        lambda v, r: files.npz(
            r, depth=v.depth, labels=v.labels, intrinsics=K, T_world_camera=POSE
        ),
        tolerance=0,
    ),
    "npz, other names": Door(
        lambda v, r: files.npz(
            r, depth=files.raw(v), depth_scale=0.001, segmap=files.masks_of(v), K=K.ravel()
        ),
        pose=False,
    ),
    "folder": Door(files.folder),
    "float tiff": Door(files.float_tiff, tolerance=1e-6),
    "float npy": Door(files.float_npy, tolerance=1e-6),
    "labels.npy, masks": Door(files.stack_npy),
    "labels.npy, ids": Door(files.ids_npy),
    "masks.tif, pages": Door(files.stack_tiff),
    "labels in colours": Door(files.colours, ids=(0xC81E0A, 0x0000FF)),
    "COCO's run lengths": Door(files.coco),
    "CameraInfo, YAML": Door(
        lambda v, r: files.folder(v, r, "camera_info.yaml", files.camera_info(v)),
        pose=False,
        warns=MM,
    ),
    "CameraInfo, JSON": Door(
        lambda v, r: files.folder(
            v, r, content={k.upper(): x for k, x in files.camera_info(v).items() if k == "k"}
        ),
        pose=False,
        warns=MM,
    ),
    "camera_calibration": Door(files.calibration_yaml, pose=False, warns=MM),
    "cam_K": Door(
        lambda v, r: files.folder(
            v, r, content={"cam_K": K.ravel().tolist(), "depth_scale": 0.001}
        ),
        pose=False,
    ),
    "Open3D": Door(files.open3d, pose=False, warns=MM),
    "Open3D with a pose": Door(files.open3d_with_pose, warns=MM),
    "GraspNet": Door(files.graspnet, pose=False),
    "X.depth.png and X.pose.txt": Door(files.pose_file),
    "BOP": Door(files.bop),
    "BOP, root": Door(files.bop_root),
    "BOP, industrial": Door(files.bop_industrial),
    "BOP, mask/": Door(lambda v, r: files.bop(v, r, masks="mask"), warns="no mask_visib/"),
    "xyz and mask images": Door(files.xyz_and_mask_images, tolerance=1e-6),
    "points in the camera's frame": Door(files.camera_frame, pose=False, tolerance=1e-6),
    "organised points in .npz": Door(
        lambda v, r: files.npz(
            r, points=files.grid(v), labels=v.labels, camera_position=POSE[:3, 3]
        ),
        tolerance=1e-6,
    ),
    "points in .npz": Door(
        lambda v, r: files.npz(
            r, points=files.flat(v)[0], labels=files.flat(v)[1], camera_position=POSE[:3, 3]
        ),
        pixels=False,
    ),
    "organised PCD": Door(lambda v, r: files.pcd(v, r, files.grid(v), v.labels), tolerance=1e-6),
    "PCD": Door(lambda v, r: files.pcd(v, r, *files.flat(v)), pixels=False),
    "PLY": Door(files.ply, pixels=False),
    "MCAP": Door(files.mcap, **DRIVEN),
    "ROS 2 folder": Door(files.sqlite, **DRIVEN),
    "ROS 1": Door(files.bag1, **DRIVEN),
    "ROS 1, rectified": Door(lambda v, r: files.bag1(v, r, files.rectified), **DRIVEN),
    "RealSense": Door(lambda v, r: files.bag1(v, r, files.realsense), **UNPOSED),
    "compressed depth": Door(lambda v, r: files.mcap(v, r, files.compressed), **UNPOSED),
    "compressed depth, float": Door(
        lambda v, r: files.bag1(v, r, files.compressed, encoding="32FC1"), **UNPOSED, tolerance=3e-3
    ),
}


@pytest.mark.parametrize("name", DOORS)
def test_every_door_shows_the_same_view(truth, tmp_path, name):
    door = DOORS[name]
    seen = load_observation(door.write(truth, tmp_path), **dict(door.options))
    assert [text for text in seen.warnings if not door.warns or door.warns not in text] == []
    assert bool(seen.warnings) == bool(door.warns)
    assert (seen.labels is not None) == door.labels
    assert seen.posed == door.pose
    known = np.array([0, *door.ids]) if door.labels else None
    if door.pixels:
        np.testing.assert_allclose(seen.intrinsics, K, rtol=0, atol=1e-3)
        np.testing.assert_allclose(seen.pose, POSE if door.pose else np.eye(4), atol=1e-5)
        np.testing.assert_array_equal(seen.depth > 0, truth.depth > 0)
        np.testing.assert_allclose(seen.depth, truth.depth, rtol=0, atol=door.tolerance)
        if door.labels:
            np.testing.assert_array_equal(seen.labels, known[truth.labels])
        return
    np.testing.assert_allclose(seen.camera_center, POSE[:3, 3], atol=1e-6)
    points, labels = truth.points()
    local = transform_points(invert_transform(seen.pose), points)
    pixel, z = project(local, seen.intrinsics)
    column, row = np.rint(pixel).astype(int).T
    assert (seen.depth[row, column] <= z + 1e-6).all()  # no seen point is before what it shows
    assert (seen.depth[row, column] > 0).all()
    shown, ids = seen.points()
    reach = np.linalg.norm(shown - POSE[:3, 3], axis=1) / seen.intrinsics[0, 0]
    for value in (0, 1, 2):
        gap = cKDTree(points[labels == value]).query(shown[ids == value])[0]
        assert (gap < 3.0 * reach[ids == value]).all()  # pixels of the image that was made
        assert len(gap) > 0.5 * (labels == value).sum()


@pytest.mark.parametrize(
    ("module", "name"),
    [("rosbags.rosbag2", "MCAP"), ("pypcd4", "PCD"), ("pycocotools.mask", "COCO's run lengths")],
)
def test_a_missing_library_names_the_extra(truth, tmp_path, monkeypatch, module, name):
    path = DOORS[name].write(truth, tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'vprism_plan\[formats\]'"):
        load_observation(path, **dict(DOORS[name].options))
