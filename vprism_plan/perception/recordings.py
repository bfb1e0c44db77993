# SPDX-License-Identifier: BSD-3-Clause
"""A depth image out of a recording: ROS 1 and 2 bags, MCAP files, RealSense's `.bag`."""

import io
from collections import defaultdict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from vprism_plan import _files
from vprism_plan._arguments import number
from vprism_plan._shapes import Pose
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.camera_files import MILLIMETRE, camera_of, check_size
from vprism_plan.perception.images import straight, without_no_data
from vprism_plan.perception.observation import Observation

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_NEAR, _TF_NEAR = 10**9, 10**10  # nanoseconds around a time in which images and TF are looked for
_HELD = 0.1  # seconds that a transform is good for beyond the first and last that were recorded
_UNITS = "/option/Depth_Units/value"  # RealSense: metres per raw unit
_LISTED = 40


def is_recording(path: Path) -> bool:
    """Whether a path is a bag: a file, or a folder of ROS 2 with `metadata.yaml`."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.is_file() and path.suffix in (".bag", ".mcap", ".db3")


def load_recording(
    path: Path,
    depth: str | None = None,
    frame: int | str | None = None,
    at: float | None = None,
    more: dict[str, Any] | None = None,
) -> Observation:
    """Load one depth image of a recording, with its camera and its pose at that time.

    The image has no labels: `segment_tabletop` makes them.

    Args:
        path: `.bag` (ROS 1, RealSense), `.mcap`, `.db3`, or a folder of ROS 2.
        depth: topic of `Image` (16-bit millimetres, or float metres: REP 118) or compressed depth;
            not needed if there is one.
        frame: TF frame that is the world, z up; None = the view is unposed.
        at: seconds from the start of the recording; the nearest image is taken, default the first.
        more: other attributes of the observation.

    Raises:
        ObservationError: what is missing; topics or frames that there are.
        MissingDependencyError: `rosbags`, which the extra `formats` brings, is not installed.
    """
    version = 1 if path.suffix == ".bag" else 2
    bags = _files.optional(f"rosbags.rosbag{version}", "formats", "recordings need")
    with _files.reading(path, "a readable recording", ObservationError), bags.Reader(path) as bag:
        return _Recording(path, bag).view(depth, frame, at, more or {})


class _Recording:
    """An open bag. Messages are read by ROS's own definitions, never by those in the file."""

    def __init__(self, path: Path, bag: Any) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.bag, self.name = bag, str(path)
        one = path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if one else Stores.LATEST)
        if one:  # its store lacks TF's
            for name in _TF:
                text = "geometry_msgs/TransformStamped[] transforms"
                store.register(get_types_from_msg(text, name))
        self.read = store.deserialize_ros1 if one else store.deserialize_cdr

    def view(
        self, depth: str | None, frame: int | str | None, at: float | None, more: dict[str, Any]
    ) -> Observation:
        topic = self._depth_topic(depth)
        when = None if at is None else number("at", at, 0.0, unit="s", error=ObservationError)
        recorded, message = self._nearest(topic, when)
        raw = without_no_data(_pixels(message, topic))
        info_topic = self._info_topic(topic, message.header.frame_id)
        _, info = self._nearest(info_topic, None)
        content = {
            name: getattr(info, name if hasattr(info, name) else name.upper())
            for name in ("width", "height", "distortion_model", "d", "k", "p")
        }
        if "rect" in topic:  # rectified: the lens is undone, and the camera is the projection's
            content |= {"k": np.reshape(content["p"], (3, 4))[:, :3], "d": []}
        check_size(content, raw.shape, info_topic)
        camera = camera_of({k: content[k] for k in ("k", "d", "distortion_model")}, info_topic)
        given = {
            "depth": raw if raw.dtype.kind == "f" else raw * self._unit(topic),
            "labels": None,
            "T_world_camera": None,
            "warnings": (),
        }
        if frame is not None:
            given["T_world_camera"] = self._pose(str(frame), message.header, recorded)
        return straight(given | more, camera)

    def _messages(self, *topics: str, **when: int) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording (ns) and message, of topics and between two times."""
        wanted = [c for c in self.bag.connections if c.topic in topics and c.msgcount]
        if wanted:
            for connection, time, raw in self.bag.messages(wanted, **when):
                yield connection.topic, time, self.read(raw, connection.msgtype)

    def _topics(self, *kinds: str) -> list[str]:
        return sorted({c.topic for c in self.bag.connections if c.msgtype in kinds and c.msgcount})

    def _depth_topic(self, asked: str | None) -> str:
        topics = self._topics(_IMAGE, _COMPRESSED)
        if asked is None:
            found = [topic for topic in topics if self._is_depth(topic)]
            if len(found) == 1:
                return found[0]
            what = f"it has {len(found)} topics of depth images; choose by `depth` (--depth TOPIC)"
        elif asked in topics:
            return asked
        else:
            what = f"it has no image topic {asked!r}"
        listed = sorted({f"{c.topic} ({c.msgtype.split('/')[-1]})" for c in self.bag.connections})
        listed[_LISTED:] = ["..."] if len(listed) > _LISTED else []
        raise ObservationError(f"{self.name}: {what}; topics: {', '.join(listed) or 'none'}")

    def _is_depth(self, topic: str) -> bool:
        message = next(self._messages(topic))[2]
        return _encoding(message) in _DEPTHS and (
            hasattr(message, "encoding") or "compressedDepth" in message.format
        )

    def _nearest(self, topic: str, seconds: float | None) -> tuple[int, Any]:
        """Return when a topic's message nearest to a time since the start was recorded, and it."""
        if seconds is None:
            return next(self._messages(topic))[1:]
        wanted = self.bag.start_time + round(1e9 * seconds)
        around = {"start": wanted - _NEAR, "stop": wanted + _NEAR}
        connections = [c for c in self.bag.connections if c.topic == topic]
        times = [
            (abs(time - wanted), time) for _, time, _ in self.bag.messages(connections, **around)
        ]
        if not times:
            raise ObservationError(
                f"{self.name}: {topic} has nothing within {1e-9 * _NEAR:g} s of {seconds:g} s; the "
                f"recording is {1e-9 * (self.bag.end_time - self.bag.start_time):.1f} s long"
            )
        time = min(times)[1]
        return next(self._messages(topic, start=time, stop=time + 1))[1:]

    def _info_topic(self, depth: str, frame: str) -> str:
        """Return the topic of the camera of a depth topic."""
        topics = self._topics(_INFO)
        parts = depth.split("/")
        while len(parts) > 1:  # of the names above, nearest first; RealSense: X/image/data
            parts.pop()
            for name in ("camera_info", "info/camera_info"):
                if (topic := "/".join([*parts, name])) in topics:
                    return topic
        same = [t for t in topics if next(self._messages(t))[2].header.frame_id == frame]
        if len(same) != 1:
            raise ObservationError(
                f"{self.name}: no CameraInfo belongs to {depth} (frame {frame!r}); "
                f"there are: {', '.join(topics) or 'none'}"
            )
        return same[0]

    def _unit(self, depth: str) -> float:
        """Metres per raw unit: RealSense states it, everybody else has millimetres."""
        sensor = "/".join(depth.split("/")[:3])
        for _, _, message in self._messages(sensor + _UNITS):
            return float(message.data)
        return MILLIMETRE

    # ------------------------------------------------------------------------------------- TF
    def _pose(self, world: str, header: Any, recorded: int) -> Pose:
        """Return the pose of an image's frame in another at its time; it was recorded at (ns)."""
        camera, time = header.frame_id, _seconds(header)
        moves: dict[str, list[tuple[float, str, Pose]]] = defaultdict(list)
        fixed: dict[str, tuple[str, Pose]] = {}
        near = {"start": recorded - _TF_NEAR, "stop": recorded + _TF_NEAR}
        static = [t for t in self._topics(*_TF) if t.endswith("tf_static")]
        moving = [t for t in self._topics(*_TF) if t not in static]
        for topic, _, message in chain(self._messages(*static), self._messages(*moving, **near)):
            for item in message.transforms:
                parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
                if topic in static:
                    fixed[child] = parent, _transform(item.transform)
                else:
                    moves[child].append((_seconds(item.header), parent, _transform(item.transform)))

        def upwards(child: str) -> Iterator[tuple[str, Pose]]:
            """Yield a frame, and those above it, with the pose of `child` in each."""
            pose, seen = np.eye(4), {child}
            yield child, pose
            while child in fixed or child in moves:
                if child in fixed:
                    child, step = fixed[child]
                else:
                    child, step = _between(child, moves[child], time)
                pose = step @ pose
                yield child, pose
                if child in seen:
                    raise ObservationError(f"{self.name}: TF has a loop at frame {child!r}")
                seen.add(child)

        above = dict(upwards(world.lstrip("/")))
        for frame, pose in upwards(camera.lstrip("/")):
            if frame in above:
                return invert_transform(above[frame]) @ pose
        parents = [parent for parent, _ in fixed.values()] + [m[0][1] for m in moves.values()]
        frames = sorted({*fixed, *moves, *parents})
        raise ObservationError(
            f"{self.name}: TF does not connect {camera!r}, the frame of the images, to {world!r}; "
            f"frames: {', '.join(frames[:_LISTED]) or 'none'}"
        )


def _between(child: str, moves: list[tuple[float, str, Pose]], time: float) -> tuple[str, Pose]:
    """Return a frame's parent, and its pose there at a time, between two that were recorded."""
    moves = sorted(moves, key=lambda move: move[0])
    after = int(np.searchsorted([move[0] for move in moves], time))
    before, after = max(after - 1, 0), min(after, len(moves) - 1)
    (t0, parent, first), (t1, parent1, last) = moves[before], moves[after]
    if not t0 - _HELD <= time <= t1 + _HELD:
        ends = f"from {moves[0][0] - time:+.2f} to {moves[-1][0] - time:+.2f} s around it"
        raise ObservationError(
            f"TF of {child!r} was recorded {ends}, not at the image's time; choose another by `at`"
        )
    if parent != parent1:
        raise ObservationError(f"TF of {child!r} changes its parent, {parent!r} to {parent1!r}")
    if t1 <= t0:
        return parent, first
    share = float(np.clip((time - t0) / (t1 - t0), 0.0, 1.0))
    pose = np.eye(4)
    pose[:3, 3] = (1.0 - share) * first[:3, 3] + share * last[:3, 3]
    turns = Rotation.from_matrix(np.stack([first[:3, :3], last[:3, :3]]))
    pose[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
    return parent, pose


def _seconds(header: Any) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def _transform(message: Any) -> Pose:
    turn, shift = message.rotation, message.translation
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    pose[:3, 3] = shift.x, shift.y, shift.z
    return pose


# ------------------------------------------------------------------------------------- images
def _encoding(message: Any) -> str:
    return str(getattr(message, "encoding", "") or message.format.partition(";")[0]).strip()


def _pixels(message: Any, topic: str) -> np.ndarray:
    """Return the raw depth (H, W) in an `Image` or a `CompressedImage`."""
    encoding = _encoding(message)
    if encoding not in _DEPTHS:
        raise ObservationError(
            f"{topic} has images of {encoding!r}, no depth; that is one of {', '.join(_DEPTHS)}"
        )
    kind = np.dtype(_DEPTHS[encoding])
    if not hasattr(message, "encoding"):
        return _decompressed(bytes(message.data), encoding, topic)
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * kind.itemsize].copy().view(kind)
    return pixels.astype(kind.newbyteorder("="))


def _decompressed(data: bytes, encoding: str, topic: str) -> np.ndarray:
    """Decode compressed_depth_image_transport: 12 bytes of header, then a PNG of 16 bits."""
    from PIL import Image

    with Image.open(io.BytesIO(data[12:]), formats=("PNG",)) as image:
        raw = np.array(image)
    if raw.ndim != 2:
        raise ObservationError(f"{topic} holds colour images, no depth")
    if encoding != "32FC1":
        return raw.astype(np.uint16)
    a, b = np.frombuffer(data[4:12], "<f4")  # depth is quantised as A / depth + B
    with np.errstate(divide="ignore"):
        return np.where(raw > 0, a / (raw - np.float64(b)), 0.0).astype(np.float32)
