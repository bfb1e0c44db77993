# SPDX-License-Identifier: BSD-3-Clause
"""Writes a view in every form in which it is read, by the library of the form."""

import json
from io import BytesIO
from pathlib import Path

import numpy as np
import yaml
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from oracles.perception_oracles import intrinsics, look_at
from vprism_plan.perception import Observation
from vprism_plan.perception.camera import invert_transform, transform_points

SHAPE = (96, 128)
K = intrinsics(128, 96)
POSE = look_at((0.6, 0.1, 0.5))


def image(path: Path, pixels: np.ndarray, **options) -> None:
    Image.fromarray(pixels).save(path, **options)


def raw(v: Observation) -> np.ndarray:
    return np.rint(v.depth * 1000).astype(np.uint16)


def ours(v: Observation, **changes) -> dict:
    content = {
        "fx": v.intrinsics[0, 0],
        "fy": v.intrinsics[1, 1],
        "cx": v.intrinsics[0, 2],
        "cy": v.intrinsics[1, 2],
        "depth_scale": 0.001,
    }
    content |= {"T_world_camera": v.pose.tolist()}
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


def camera_info(v) -> dict:
    row = np.column_stack([v.intrinsics, np.zeros(3)])
    info = {"width": v.shape[1], "height": v.shape[0], "distortion_model": "plumb_bob"}
    info |= {"d": [0.0] * 5, "k": v.intrinsics.ravel().tolist(), "p": row.ravel().tolist()}
    return info | {"header": {"frame_id": "camera"}}


def calibration_yaml(v, root):
    flat = {"rows": 3, "cols": 3, "data": v.intrinsics.ravel().tolist()}
    content = {"image_width": v.shape[1], "image_height": v.shape[0], "camera_matrix": flat}
    content |= {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5}}
    return folder(v, root, "camera.yaml", content)


def open3d(v, root):
    columns = v.intrinsics.T.ravel().tolist()
    content = {"width": v.shape[1], "height": v.shape[0], "intrinsic_matrix": columns}
    return folder(v, root, "intrinsics.json", content)


def open3d_with_pose(v, root):
    inner = {
        "width": v.shape[1],
        "height": v.shape[0],
        "intrinsic_matrix": v.intrinsics.T.ravel().tolist(),
    }
    extrinsic = invert_transform(v.pose).T.ravel().tolist()
    content = {"class_name": "PinholeCameraParameters", "extrinsic": extrinsic, "intrinsic": inner}
    return folder(v, root, content=content)


def graspnet(v, root):
    folder(v, root)
    (root / "camera.json").unlink()
    savemat(
        root / "meta.mat", {"intrinsic_matrix": v.intrinsics, "factor_depth": np.array([[1000]])}
    )
    return root


def pose_file(v, root):
    folder(v, root, content=ours(v, T_world_camera=None), labels=None)
    (root / "depth.png").rename(root / "frame-7.depth.png")
    image(root / "frame-7.labels.png", v.labels.astype(np.uint8))
    np.savetxt(root / "frame-7.pose.txt", v.pose)
    return root / "frame-7.depth.png"


def bop(v, scene, sensor="", masks="mask_visib"):
    for name in ("depth", masks):
        (scene / f"{name}{sensor}").mkdir(parents=True)
    image(scene / f"depth{sensor}" / "000003.png", raw(v))
    for index in (0, 1):
        visible = np.where(v.labels == index + 1, 255, 0).astype(np.uint8)
        image(scene / f"{masks}{sensor}" / f"000003_{index:06d}.png", visible)
    world_to_camera = invert_transform(v.pose)
    camera = {"cam_K": v.intrinsics.ravel().tolist(), "depth_scale": 1.0}
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
    (root / "camera.json").write_text(json.dumps({"camera_position": v.pose[:3, 3].tolist()}))
    return root / "a-xyz.npy"


def pcd(v, root, points, labels):
    from pypcd4 import PointCloud

    flat = [*points.reshape(-1, 3).T, labels.ravel().astype(np.uint32)]
    types = [np.float32, np.float32, np.float32, np.uint32]
    cloud = PointCloud.from_points(flat, ("x", "y", "z", "label"), types)
    turn = Rotation.from_matrix(v.pose[:3, :3]).as_quat(scalar_first=True)
    cloud.metadata.viewpoint = (*v.pose[:3, 3].tolist(), *turn.tolist())
    if points.ndim == 3:
        cloud.metadata.height, cloud.metadata.width = v.shape
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
    view = v.pose[:3, 3].astype("<f4").tobytes()
    (root / "cloud.ply").write_bytes("\n".join(head).encode() + b"\n" + rows.tobytes() + view)
    return root / "cloud.ply"


def camera_frame(v, root):
    points = transform_points(invert_transform(v.pose), v.point_image())
    return npz(root, xyz=points, segmentation=v.labels)


# ---------------------------------------------------------------------------------- recordings
STEP = 10**8  # nanoseconds between images


class Bag:
    """Writes a drive of 2 s: the view is image 12, at 1.2 s."""

    def __init__(self, one: bool, v: Observation):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.one, self.v = one, v
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

    def info(self, topic, time, matrix=None, d=(0.0,) * 5, frame="/camera"):
        v = self.v
        matrix = v.intrinsics if matrix is None else matrix
        region = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {"d": np.array(d), "k": matrix.ravel(), "r": np.eye(3).ravel()}
        values["p"] = np.column_stack([v.intrinsics, np.zeros(3)]).ravel()
        values = {k.upper() if self.one else k: x for k, x in values.items()}
        size = {"height": v.shape[0], "width": v.shape[1], "distortion_model": "plumb_bob"}
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
    pose[:3, :3] = Rotation.from_rotvec([0, 0, 0.4 * seconds]).as_matrix()
    pose[:3, 3] = 0.2 + 0.1 * seconds, -0.3 * seconds, 0.5
    return pose


def drive(
    bag: Bag, v, topic="/cam/depth/image_raw", info="/cam/depth/camera_info", lens=(), **more
):
    """Images every 0.1 s; TF of the hand every 0.08 s, never at the time of image 12."""
    start = 1_700_000_000 * 10**9
    bag.transform("/tf_static", start, "hand", "camera", invert_transform(moved(1.2)) @ v.pose)
    bag.transform("/tf_static", start, "map", "base", np.eye(4))
    for i in range(30):
        time = start + i * 8 * 10**7
        bag.transform("/tf", time, "base", "hand", moved(0.08 * i))
    for i in range(20):
        time = start + i * STEP
        seen = raw(v) if i == 12 else np.full(v.shape, 900 + i, np.uint16)
        pixels = (seen * 0.001).astype(np.float32) if more.get("encoding") == "32FC1" else seen
        bag.depth(topic, time, pixels, **more)
        bag.info("/cam/depth/camera_info", time, **dict(lens))


def mcap(v, root, fill=drive, **more):
    from rosbags.rosbag2 import StoragePlugin, Writer

    bag = Bag(False, v)
    with Writer(root / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as bag.writer:
        fill(bag, v, **more)
    return root / "drive" / "drive.mcap"


def sqlite(v, root, fill=None):
    from rosbags.rosbag2 import StoragePlugin, Writer

    bag = Bag(False, v)
    with Writer(root / "drive", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag.writer:
        fill(bag, v) if fill else drive(bag, v, encoding="32FC1")
    return root / "drive" / "drive.db3" if fill else root / "drive"


def bag1(v, root, fill=drive, **more):
    from rosbags.rosbag1 import Writer

    bag = Bag(True, v)
    with Writer(root / "drive.bag") as bag.writer:
        fill(bag, v, **more)
    return root / "drive.bag"


def rectified(bag, v):
    """The image is rectified, so the projection holds and the lens is undone."""
    lens = {"matrix": v.intrinsics * [[1.1], [1.1], [1.0]], "d": (0.1, 0.1, 0.0, 0.0, 0.0)}
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


def one_image(bag, v):
    bag.info("/camera_info", 5)
    bag.depth("/depth", 5, raw(v))


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
