# SPDX-License-Identifier: BSD-3-Clause
"""One scene, written by each format's own library, is the same view through every door."""

import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import yaml
from oracles.perception_oracles import Scene, intrinsics, look_at
from PIL import Image
from scipy.io import savemat
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vprism_plan.errors import MissingDependencyError
from vprism_plan.perception import Observation, load_observation
from vprism_plan.perception.camera import invert_transform, project, transform_points

SHAPE = (96, 128)
K = intrinsics(128, 96)
POSE = look_at((0.6, 0.1, 0.5))
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


def image(path: Path, pixels: np.ndarray, **options) -> None:
    Image.fromarray(pixels).save(path, **options)


def raw(v: Observation) -> np.ndarray:
    return np.rint(v.depth * 1000).astype(np.uint16)


def ours(v: Observation, **changes) -> dict:
    content = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 0.001}
    content |= {"T_world_camera": POSE.tolist()}
    return {k: x for k, x in (content | changes).items() if x is not None}


def folder(v, root, camera="camera.json", content=None, labels="labels.png") -> Path:
    image(root / "depth.png", raw(v))
    content = ours(v) if content is None else content
    text = json.dumps(content) if camera.endswith("json") else yaml.safe_dump(content)
    (root / camera).write_text(text)
    if labels:
        image(root / labels, v.labels.astype(np.uint8))
    return root


def no_returns(v: Observation) -> np.ndarray:
    """Depth in metres with every way of saying that nothing returned."""
    depth = v.depth.astype(np.float32)
    none = np.array([0.0, np.nan, np.inf, 0.0], np.float32)
    depth[v.depth == 0] = np.resize(none, int((v.depth == 0).sum()))
    return depth


def float_tiff(v, root):
    folder(v, root)
    (root / "depth.png").unlink()
    (root / "camera.json").write_text(json.dumps(ours(v, depth_scale=None)))
    image(root / "depth.tif", no_returns(v))
    return root


def float_npy(v, root):
    float_tiff(v, root)
    (root / "depth.tif").unlink()
    np.save(root / "depth.npy", no_returns(v))
    return root


def masks_of(v) -> np.ndarray:
    """Masks of the boxes; the first, larger, reaches over the second."""
    first, second = v.labels == 1, v.labels == 2
    assert first.sum() > second.sum()
    return np.stack([first | second, second])


def stack_npy(v, root):
    folder(v, root, labels=None)
    np.save(root / "labels.npy", masks_of(v))
    return root


def stack_tiff(v, root):
    folder(v, root, labels=None)
    first, second = (Image.fromarray(m.astype(np.uint8)) for m in masks_of(v))
    first.save(root / "masks.tif", save_all=True, append_images=[second])
    return root


def ids_npy(v, root):
    folder(v, root, labels=None)
    np.save(root / "labels.npy", v.labels)
    return root


def colours(v, root):
    folder(v, root, labels=None)
    palette = np.array([[0, 0, 0], [200, 30, 10], [0, 0, 255]], np.uint8)
    image(root / "labels.png", palette[v.labels])
    return root


def coco(v, root):
    from pycocotools import mask

    folder(v, root, labels=None)
    found = []
    for part in masks_of(v):
        lengths = mask.encode(np.asfortranarray(part.astype(np.uint8)))
        lengths["counts"] = lengths["counts"].decode()
        found.append({"segmentation": lengths, "area": int(part.sum()), "image_id": 7})
    (root / "labels.json").write_text(json.dumps({"images": [{"id": 7}], "annotations": found}))
    return root


def camera_info(**more) -> dict:
    row = [*K[0], 0.0, *K[1], 0.0, *K[2], 0.0]
    info = {"width": SHAPE[1], "height": SHAPE[0], "distortion_model": "plumb_bob"}
    info |= {"d": [0.0] * 5, "k": K.ravel().tolist(), "p": [float(x) for x in row]}
    return info | {"header": {"frame_id": "camera"}} | more


def calibration_yaml(v, root):
    flat = {"rows": 3, "cols": 3, "data": K.ravel().tolist()}
    content = {"image_width": SHAPE[1], "image_height": SHAPE[0], "camera_matrix": flat}
    content |= {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5}}
    return folder(v, root, "camera.yaml", content)


def open3d(v, root):
    columns = K.T.ravel().tolist()
    content = {"width": SHAPE[1], "height": SHAPE[0], "intrinsic_matrix": columns}
    return folder(v, root, "intrinsics.json", content)


def open3d_with_pose(v, root):
    inner = {"width": SHAPE[1], "height": SHAPE[0], "intrinsic_matrix": K.T.ravel().tolist()}
    extrinsic = invert_transform(POSE).T.ravel().tolist()
    content = {"class_name": "PinholeCameraParameters", "extrinsic": extrinsic, "intrinsic": inner}
    return folder(v, root, content=content)


def graspnet(v, root):
    folder(v, root)
    (root / "camera.json").unlink()
    savemat(root / "meta.mat", {"intrinsic_matrix": K, "factor_depth": np.array([[1000]])})
    return root


def pose_file(v, root):
    folder(v, root, content=ours(v, T_world_camera=None), labels=None)
    (root / "depth.png").rename(root / "frame-7.depth.png")
    image(root / "frame-7.labels.png", v.labels.astype(np.uint8))
    np.savetxt(root / "frame-7.pose.txt", POSE)
    return root / "frame-7.depth.png"


def bop(v, scene, sensor="", masks="mask_visib"):
    for name in ("depth", masks):
        (scene / f"{name}{sensor}").mkdir(parents=True)
    image(scene / f"depth{sensor}" / "000003.png", raw(v))
    for index in (0, 1):
        visible = np.where(v.labels == index + 1, 255, 0).astype(np.uint8)
        image(scene / f"{masks}{sensor}" / f"000003_{index:06d}.png", visible)
    world_to_camera = invert_transform(POSE)
    camera = {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}
    camera["cam_R_w2c"] = world_to_camera[:3, :3].ravel().tolist()
    camera["cam_t_w2c"] = (1000 * world_to_camera[:3, 3]).tolist()
    (scene / f"scene_camera{sensor}.json").write_text(json.dumps({"3": camera}))
    return scene


def bop_root(v, root):
    bop(v, root / "test" / "000001")
    (root / "camera.json").write_text("{}")
    return root


def bop_industrial(v, root):
    bop(v, root, "_cam2")
    (root / "scene_camera_cam1.json").write_text("{}")
    return root / "scene_camera_cam2.json"


def grid(v) -> np.ndarray:
    """Organised points, world frame, as drivers write them."""
    return v.point_image().astype(np.float32)


def npz(root, **arrays) -> Path:
    np.savez(root / "view.npz", **arrays)
    return root / "view.npz"


def xyz_and_mask_images(v, root):
    np.save(root / "a-xyz.npy", grid(v))
    image(root / "a-mask.png", v.labels.astype(np.uint8))
    (root / "camera.json").write_text(json.dumps({"camera_position": POSE[:3, 3].tolist()}))
    return root / "a-xyz.npy"


def pcd(v, root, points, labels):
    from pypcd4 import PointCloud

    flat = [*points.reshape(-1, 3).T, labels.ravel().astype(np.uint32)]
    types = [np.float32, np.float32, np.float32, np.uint32]
    cloud = PointCloud.from_points(flat, ("x", "y", "z", "label"), types)
    turn = Rotation.from_matrix(POSE[:3, :3]).as_quat(scalar_first=True)
    cloud.metadata.viewpoint = (*POSE[:3, 3].tolist(), *turn.tolist())
    if points.ndim == 3:
        cloud.metadata.height, cloud.metadata.width = SHAPE
    cloud.save(root / "cloud.pcd")
    return root / "cloud.pcd"


def flat(v) -> tuple[np.ndarray, np.ndarray]:
    points, labels = v.points()
    mixed = np.random.default_rng(0).permutation(len(points))
    return points[mixed].astype(np.float32), labels[mixed]


def ply(v, root):
    points, labels = flat(v)
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<i4")]
    rows = np.zeros(len(points), kind)
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    rows["label"] = labels
    names = {"<f4": "float", "<i4": "int"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {names[t]} {name}" for name, t in kind]
    head += ["element camera 1", *(f"property float view_p{axis}" for axis in "xyz"), "end_header"]
    view = POSE[:3, 3].astype("<f4").tobytes()
    (root / "cloud.ply").write_bytes("\n".join(head).encode() + b"\n" + rows.tobytes() + view)
    return root / "cloud.ply"


def camera_frame(v, root):
    points = transform_points(invert_transform(POSE), v.point_image())
    return npz(root, xyz=points, segmentation=v.labels)


# ---------------------------------------------------------------------------------- recordings
STEP = 10**8  # nanoseconds between images


class Bag:
    """Writes a drive of 2 s: the view is image 12, at 1.2 s."""

    def __init__(self, one: bool):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.one = one
        self.store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_JAZZY)
        if one:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.types = self.store.types
        self.topics: dict = {}

    def header(self, time: int, frame: str):
        stamp = self.types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
        first = {"seq": 0} if self.one else {}
        return self.types["std_msgs/msg/Header"](**first, stamp=stamp, frame_id=frame)

    def write(self, topic, kind, time, **content):
        message = self.types[kind](**content)
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        self.writer.write(self.topics[topic], time, pack(message, kind))

    def depth(self, topic, time, pixels, encoding="16UC1", frame="/camera"):
        rows = np.frombuffer(pixels.tobytes(), np.uint8)
        step = pixels.shape[1] * pixels.itemsize
        size = {"height": pixels.shape[0], "width": pixels.shape[1]}
        content = {"encoding": encoding, "is_bigendian": 0, "step": step, "data": rows}
        header = self.header(time, frame)
        self.write(topic, "sensor_msgs/msg/Image", time, header=header, **size, **content)

    def info(self, topic, time, matrix=K, d=(0.0,) * 5, frame="/camera"):
        region = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {"d": np.array(d), "k": matrix.ravel(), "r": np.eye(3).ravel()}
        values["p"] = np.column_stack([K, np.zeros(3)]).ravel()
        values = {k.upper() if self.one else k: x for k, x in values.items()}
        size = {"height": SHAPE[0], "width": SHAPE[1], "distortion_model": "plumb_bob"}
        rest = {"binning_x": 0, "binning_y": 0, "roi": region, "header": self.header(time, frame)}
        self.write(topic, "sensor_msgs/msg/CameraInfo", time, **size, **values, **rest)

    def transform(self, topic, time, parent, child, pose):
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        vector = self.types["geometry_msgs/msg/Vector3"](*pose[:3, 3])
        quaternion = self.types["geometry_msgs/msg/Quaternion"](*turn)
        move = self.types["geometry_msgs/msg/Transform"](vector, quaternion)
        stamped = self.types["geometry_msgs/msg/TransformStamped"]
        item = stamped(self.header(time, parent), child, move)
        self.write(topic, "tf2_msgs/msg/TFMessage", time, transforms=[item])


def moved(seconds: float) -> np.ndarray:
    """Pose of the hand in the base: straight on and evenly about one axis."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.2, 0.3 * seconds]).as_matrix()
    pose[:3, :3] = Rotation.from_rotvec([0, 0, 0.4 * seconds]).as_matrix()
    pose[:3, 3] = 0.2 + 0.1 * seconds, -0.3 * seconds, 0.5
    return pose


def drive(
    bag: Bag, v, topic="/cam/depth/image_raw", info="/cam/depth/camera_info", lens=(), **more
):
    """Images every 0.1 s; TF of the hand every 0.08 s, never at the time of image 12."""
    start = 1_700_000_000 * 10**9
    bag.transform("/tf_static", start, "hand", "camera", invert_transform(moved(1.2)) @ POSE)
    bag.transform("/tf_static", start, "map", "base", np.eye(4))
    for i in range(30):
        time = start + i * 8 * 10**7
        bag.transform("/tf", time, "base", "hand", moved(0.08 * i))
    for i in range(20):
        time = start + i * STEP
        seen = raw(v) if i == 12 else np.full(SHAPE, 900 + i, np.uint16)
        pixels = (seen * 0.001).astype(np.float32) if more.get("encoding") == "32FC1" else seen
        bag.depth(topic, time, pixels, **more)
        bag.info(info, time, **dict(lens))


def mcap(v, root, fill=drive, **more):
    from rosbags.rosbag2 import StoragePlugin, Writer

    bag = Bag(one=False)
    with Writer(root / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as bag.writer:
        fill(bag, v, **more)
    return root / "drive" / "drive.mcap"


def sqlite(v, root):
    from rosbags.rosbag2 import StoragePlugin, Writer

    bag = Bag(one=False)
    with Writer(root / "drive", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag.writer:
        drive(bag, v, encoding="32FC1")
    return root / "drive"


def bag1(v, root, fill=drive, **more):
    from rosbags.rosbag1 import Writer

    bag = Bag(one=True)
    with Writer(root / "drive.bag") as bag.writer:
        fill(bag, v, **more)
    return root / "drive.bag"


def rectified(bag, v):
    """The image is rectified, so the projection holds and the lens is undone."""
    lens = {"matrix": K * [[1.1], [1.1], [1.0]], "d": (0.1, 0.1, 0.0, 0.0, 0.0)}
    drive(bag, v, "/cam/depth/image_rect", lens=lens)


def realsense(bag, v):
    start = 10**9
    sensor = "/device_0/sensor_0"
    kind = "std_msgs/msg/Float32"
    bag.write(f"{sensor}/option/Depth_Units/value", kind, start, data=np.float32(0.0005))
    bag.info(f"{sensor}/Depth_0/info/camera_info", start, frame="0")
    for i in range(3):
        pixels, time = (raw(v) * 2).astype(np.uint16), start + i
        bag.depth(f"{sensor}/Depth_0/image/data", time, pixels, "mono16", "0")


def compressed(bag, v, encoding="16UC1"):
    bag.info("/cam/depth/camera_info", 5)
    packed, head = raw(v), np.zeros(3, "<f4")
    if encoding == "32FC1":
        a, b = 0.1 * 60000, -200.0  # closest at 0.1 m
        with np.errstate(divide="ignore"):
            packed = np.where(v.depth > 0, a / v.depth + b, 0).astype(np.uint16)
        head[1:] = a, b
    stream = BytesIO()
    Image.fromarray(packed).save(stream, format="PNG")
    data = np.frombuffer(head.tobytes() + stream.getvalue(), np.uint8)
    content = {"header": bag.header(5, "camera"), "data": data}
    content["format"] = f"{encoding}; compressedDepth png"
    topic = "/cam/depth/image_raw/compressedDepth"
    bag.write(topic, "sensor_msgs/msg/CompressedImage", 5, **content)


ASKED = (("frame", "base"), ("at", 1.2))
DRIVEN = {"labels": False, "options": ASKED}
UNPOSED = {"labels": False, "pose": False}
MM = "taken as millimetres"
DOORS = {
    "npz": Door(
        lambda v, r: npz(r, depth=v.depth, labels=v.labels, intrinsics=K, T_world_camera=POSE),
        tolerance=0,
    ),
    "npz, other names": Door(
        lambda v, r: npz(r, depth=raw(v), depth_scale=0.001, segmap=masks_of(v), K=K.ravel()),
        pose=False,
    ),
    "folder": Door(folder),
    "float tiff": Door(float_tiff, tolerance=1e-6),
    "float npy": Door(float_npy, tolerance=1e-6),
    "labels.npy, masks": Door(stack_npy),
    "labels.npy, ids": Door(ids_npy),
    "masks.tif, pages": Door(stack_tiff),
    "labels in colours": Door(colours, ids=(0xC81E0A, 0x0000FF)),
    "COCO's run lengths": Door(coco),
    "CameraInfo, YAML": Door(
        lambda v, r: folder(v, r, "camera_info.yaml", camera_info()), pose=False, warns=MM
    ),
    "CameraInfo, JSON": Door(
        lambda v, r: folder(
            v, r, content={k.upper(): x for k, x in camera_info().items() if k == "k"}
        ),
        pose=False,
        warns=MM,
    ),
    "camera_calibration": Door(calibration_yaml, pose=False, warns=MM),
    "cam_K": Door(
        lambda v, r: folder(v, r, content={"cam_K": K.ravel().tolist(), "depth_scale": 0.001}),
        pose=False,
    ),
    "Open3D": Door(open3d, pose=False, warns=MM),
    "Open3D with a pose": Door(open3d_with_pose, warns=MM),
    "GraspNet": Door(graspnet, pose=False),
    "X.depth.png and X.pose.txt": Door(pose_file),
    "BOP": Door(bop),
    "BOP, root": Door(bop_root),
    "BOP, industrial": Door(bop_industrial),
    "BOP, mask/": Door(lambda v, r: bop(v, r, masks="mask"), warns="no mask_visib/"),
    "xyz and mask images": Door(xyz_and_mask_images, tolerance=1e-6),
    "points in the camera's frame": Door(camera_frame, pose=False, tolerance=1e-6),
    "organised points in .npz": Door(
        lambda v, r: npz(r, points=grid(v), labels=v.labels, camera_position=POSE[:3, 3]),
        tolerance=1e-6,
    ),
    "points in .npz": Door(
        lambda v, r: npz(r, points=flat(v)[0], labels=flat(v)[1], camera_position=POSE[:3, 3]),
        pixels=False,
    ),
    "organised PCD": Door(lambda v, r: pcd(v, r, grid(v), v.labels), tolerance=1e-6),
    "PCD": Door(lambda v, r: pcd(v, r, *flat(v)), pixels=False),
    "PLY": Door(ply, pixels=False),
    "MCAP": Door(mcap, **DRIVEN),
    "ROS 2 folder": Door(sqlite, **DRIVEN),
    "ROS 1": Door(bag1, **DRIVEN),
    "ROS 1, rectified": Door(lambda v, r: bag1(v, r, rectified), **DRIVEN),
    "RealSense": Door(lambda v, r: bag1(v, r, realsense), **UNPOSED),
    "compressed depth": Door(lambda v, r: mcap(v, r, compressed), **UNPOSED),
    "compressed depth, float": Door(
        lambda v, r: bag1(v, r, compressed, encoding="32FC1"), **UNPOSED, tolerance=3e-3
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
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'vprism_plan\[formats\]'"):
        load_observation(path, **dict(DOORS[name].options))
