"""Whatever is in a file, reading it works or fails in one line of this package, soon."""

import io
import json
import struct
import time
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from oracles import view_files
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import save_file

from vprism_plan.errors import VPrismError
from vprism_plan.mapping import MapConfig, VPrismMap, load_map
from vprism_plan.mapping.em import Posterior, diagonal_prior
from vprism_plan.mapping.features import FeatureSpace, sorted_hinges
from vprism_plan.mapping.serialization import content_digest
from vprism_plan.perception import Observation, load_observation, save_observation
from vprism_plan.perception.plane import Plane
from vprism_plan.planning import read_trajectory
from vprism_plan.robots.geometry import MeshFile
from vprism_plan.robots.sphere_files import read_spheres
from vprism_plan.robots.srdf import load_srdf
from vprism_plan.robots.urdf import load_model

SECONDS = 20.0  # of processor time for one small file; the slowest takes about one
EACH = 25  # random mutations of each kind of file

# --- small whole files -------------------------------------------------------------
K = np.array([[20.0, 0.0, 8.0], [0.0, 20.0, 6.0], [0.0, 0.0, 1.0]])
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper"><collision><origin xyz="0 0 0.1" rpy="0 0 0"/>
    <geometry><box size="0.1 0.1 0.3"/></geometry></collision></link>
  <link name="hand"><collision><geometry><mesh filename="hand.stl" scale="1 1 1"/></geometry>
    </collision><collision><geometry><cylinder radius="0.03" length="0.1"/></geometry></collision>
  </link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
    <limit lower="-2.0" upper="2.0" velocity="1.5" effort="10"/></joint>
  <joint name="wrist" type="prismatic"><parent link="upper"/><child link="hand"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.1" velocity="1" effort="1"/>
    <mimic joint="shoulder" multiplier="0.02" offset="0.05"/></joint>
</robot>
"""
SRDF = """<robot name="arm"><group name="whole"><chain base_link="base" tip_link="hand"/></group>
<group name="again"><group name="whole"/><joint name="shoulder"/><link name="hand"/></group>
<group_state name="ready" group="whole"><joint name="shoulder" value="0.5"/></group_state>
<disable_collisions link1="base" link2="upper" reason="Adjacent"/></robot>
"""
SPHERES = """collision_spheres:
  upper:
    - {center: [0.0, 0.0, 0.1], radius: 0.05}
    - {center: [0.0, 0.0, 0.2], radius: 0.05}
  hand: &hand
    - {center: [0.0, 0.0, 0.0], radius: 0.04}
padding:
  upper: 0.01
"""
CUROBO = """robot_cfg:
  kinematics:
    collision_spheres:
      upper:
        - {center: [0.0, 0.0, 0.1], radius: 0.05}
    collision_sphere_buffer: 0.005
"""
XRDF = """format: xrdf
format_version: 1.0
geometry:
  all:
    spheres:
      upper:
        - {center: [0.0, 0.0, 0.1], radius: 0.05}
collision:
  geometry: all
  buffer_distance:
    upper: 0.01
"""
TRAJECTORY = {
    "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
    "joint_names": ["a", "b"],
    "points": [
        {
            "positions": [0.1 * i, 0.2 * i],
            "velocities": [0.0, 0.0],
            "accelerations": [],
            "effort": [],
            "time_from_start": {"sec": i, "nanosec": 5},
        }
        for i in range(3)
    ],
}


def observation() -> Observation:
    depth = np.full((12, 16), 0.7)
    depth[3:6, 4:8] = 0.6
    labels = np.zeros((12, 16), np.int32)
    labels[3:6, 4:8] = 1
    plane = Plane([0.0, 0.0, -1.0], -0.7)
    return Observation(depth, labels, K, np.eye(4), None, plane, [[0.0, 0.0, 0.3, 0.05]])


def small_map() -> VPrismMap:
    """A map that nobody fitted: five hinges, one object."""
    config = MapConfig()
    hinges = sorted_hinges(np.random.default_rng(0).uniform(-0.05, 0.05, (5, 3)))
    space = FeatureSpace(hinges, config.gamma, config.cutoff_radius)
    classes = diagonal_prior(space, np.zeros((space.size, 2)), np.full(space.size, 0.25))
    posterior = Posterior(classes, (-2.0, -1.0))
    seen = observation()
    return VPrismMap(config, (1,), seen.plane, (seen,), space, posterior, 0, ("odd",))


@dataclass
class Kind:
    """A kind of file: a whole one, the part of it that is spoilt, and who reads it."""

    part: Path
    read: Any


def folder_of(obs: Observation, folder: Path) -> Path:
    save_observation(obs, folder)
    return folder


def bop_scene(folder: Path) -> Path:
    for name in ("depth", "mask_visib"):
        (folder / name).mkdir(parents=True)
    Image.fromarray(np.full((12, 16), 700, np.uint16)).save(folder / "depth" / "000003.png")
    mask = np.zeros((12, 16), np.uint8)
    mask[3:6, 4:8] = 255
    Image.fromarray(mask).save(folder / "mask_visib" / "000003_000000.png")
    camera = {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}
    pose = {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [0.0, 0.0, 500.0]}
    (folder / "scene_camera.json").write_text(json.dumps({"3": camera | pose}))
    return folder


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


@pytest.fixture(scope="module")
def kinds(tmp_path_factory) -> dict[str, Kind]:
    root = tmp_path_factory.mktemp("whole")
    obs, ball = observation(), trimesh.creation.icosphere(1, 0.05)
    save_observation(obs, root / "view.npz")
    seen, scene = folder_of(obs, root / "view"), bop_scene(root / "scene")
    small_map().save(root / "map.safetensors")
    urdf = text(root / "arm.urdf", URDF)
    ball.export(root / "hand.stl")
    model = load_model(urdf)

    def mesh(name: str) -> Kind:
        ball.export(root / name)
        own = MeshFile("hand", name, np.ones(3), np.eye(4), root / name)
        return Kind(root / name, own.triangles)

    def spheres(name: str, content: str) -> Kind:
        return Kind(text(root / name, content), lambda: read_spheres(root / name))

    def view(name: str, write: Any, part: str = "") -> Kind:
        (root / name).mkdir()
        path = write(obs, root / name)
        return Kind(path / part if part else path, lambda: load_observation(path))

    return {
        "npz": Kind(root / "view.npz", lambda: load_observation(root / "view.npz")),
        "camera": Kind(seen / "camera.json", lambda: load_observation(seen)),
        "png": Kind(seen / "depth.png", lambda: load_observation(seen)),
        "labels": Kind(seen / "labels.png", lambda: load_observation(seen)),
        "bop": Kind(scene / "scene_camera.json", lambda: load_observation(scene)),
        "map": Kind(root / "map.safetensors", lambda: load_map(root / "map.safetensors")),
        "urdf": Kind(urdf, lambda: load_model(urdf)),
        "srdf": Kind(
            text(root / "arm.srdf", SRDF), lambda: load_srdf(root / "arm.srdf", model)
        ),
        "spheres": spheres("spheres.yml", SPHERES),
        "curobo": spheres("curobo.yml", CUROBO),
        "xrdf": spheres("arm.xrdf", XRDF),
        "trajectory": Kind(
            text(root / "t.json", json.dumps(TRAJECTORY)),
            lambda: read_trajectory(root / "t.json"),
        ),
        "pcd": view("pcd", lambda v, r: view_files.pcd(v, r, *v.points())),
        "ply points": view("ply points", view_files.ply),
        "npy points": view("npy points", view_files.xyz_and_mask_images),
        "masks": view("masks", view_files.coco, "labels.json"),
        "yaml": view("yaml", view_files.calibration_yaml, "camera.yaml"),
        "mat": view("mat", view_files.graspnet, "meta.mat"),
        "mcap": view("mcap", lambda v, r: view_files.mcap(v, r, view_files.one_image)),
        "sqlite": view("sqlite", lambda v, r: view_files.sqlite(v, r, view_files.one_image)),
        "bag": view("bag", lambda v, r: view_files.bag1(v, r, view_files.one_image)),
        **{name: mesh(f"ball.{name}") for name in ("stl", "obj", "ply", "off", "dae", "glb")},
    }  # fmt: skip


NAMES = (
    "npz", "camera", "png", "labels", "bop", "map", "urdf", "srdf", "spheres", "curobo", "xrdf",
    "trajectory", "stl", "obj", "ply", "off", "dae", "glb", "pcd", "ply points", "npy points",
    "masks", "yaml", "mat", "mcap", "sqlite", "bag",
)  # fmt: skip


def outcome(kind: Kind, content: bytes) -> str:
    """Read a kind of file with other content: "" if it can be used, else why not."""
    whole = kind.part.read_bytes()
    kind.part.write_bytes(content)
    began = time.process_time()
    try:
        kind.read()
        said = ""
    except VPrismError as error:
        said = str(error)
    finally:
        kind.part.write_bytes(whole)
    assert time.process_time() - began < SECONDS
    assert len(said) < 1200
    assert said.isprintable()
    return said


# --- random damage -----------------------------------------------------------------
WORDS = (
    b"nan", b"-inf", b"1e400", b"1e308", b"-1", b"0", b"9" * 400, b"9" * 5000, b"1e-320", b"null",
    b"true", b'"x"', b"[]", b"{}", b"[[", b"<a>", b"&x;", b"*hand", b"\\ud800", b"\xff\xfe",
    b"\x00", b"18446744073709551616", b"-9223372036854775808", b",", b" ", b"\n", b"x" * 3000,
)  # fmt: skip


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """One or a few random changes of a file's bytes."""
    content = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(content))) if content else 0
        length = int(rng.integers(1, 20))
        word = WORDS[rng.integers(len(WORDS))]
        how = rng.integers(7)
        if how == 0:
            content = content[:at]
        elif how == 1 and content:
            content[at] ^= 1 << rng.integers(8)
        elif how == 2:
            del content[at : at + length]
        elif how == 3:
            content[at:at] = content[at : at + 20 * length]
        elif how == 4:
            content[at : at + length] = rng.bytes(length)
        elif how == 5:
            content[at:at] = word
        else:  # a whole number, name or value in place of another
            numbers = [i for i, c in enumerate(content) if chr(c).isalnum()]
            if numbers:
                start = stop = numbers[rng.integers(len(numbers))]
                while stop < len(content) and chr(content[stop]) in "0123456789.-+e":
                    stop += 1
                content[start : max(stop, start + 1)] = word
    return bytes(content)


@pytest.mark.parametrize("name", NAMES)
def test_random_damage(kinds, name):
    kind = kinds[name]
    whole = kind.part.read_bytes()
    assert outcome(kind, whole) == ""
    rng = np.random.default_rng(NAMES.index(name))
    refused = [outcome(kind, damaged(whole, rng)) for _ in range(EACH)]
    assert any(refused)


# --- damage on purpose -------------------------------------------------------------
def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


ODD = (
    None, True, "x", "1", [], {}, [[]], [None], [{}], -1, 0, 10**400, 1e308, float("nan"),
    float("inf"), nested(50), nested(900), "x" * 10_000, [1] * 1000, {"a": {"b": 1}},
)  # fmt: skip


def changed(value: Any, odd: tuple[Any, ...] = ODD) -> Any:
    """Every copy of a JSON value with one part left out, or of an odd kind."""
    if isinstance(value, dict):
        for key in value:
            yield {k: v for k, v in value.items() if k != key}
            yield from ({**value, key: other} for other in odd)
            yield from ({**value, key: other} for other in changed(value[key], odd))
    elif isinstance(value, list) and value:
        yield from ([other, *value[1:]] for other in odd)
        yield from ([other, *value[1:]] for other in changed(value[0], odd))


@pytest.mark.parametrize("name", ["camera", "bop", "trajectory", "masks"])
def test_every_value_of_a_json_file_may_be_of_any_kind(kinds, name):
    whole = json.loads(kinds[name].part.read_text())
    for content in changed(whole):
        outcome(kinds[name], json.dumps(content).encode())


def test_every_value_of_a_map_may_be_of_any_kind(kinds, tmp_path):
    """With the right digest: who makes such a file can count that."""
    kind, made = kinds["map"], tmp_path / "made.safetensors"
    with safe_open(kind.part, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        meta = json.loads(file.metadata()["vprism_plan"])
    config = meta["config"]
    some = {key: config[key] for key in ("gamma", "hinge_shift", "prior_occupancy", "max_hinges")}
    variants = [(m, arrays) for m in changed({**meta, "config": some}, ODD[::3])]
    for m, _ in variants:
        if isinstance(m.get("config"), dict):
            m["config"] = {**config, **m["config"]}
    for name, array in arrays.items():
        for other in (
            array[:0], array[:1], array[..., None], array.astype(np.float32) * np.nan,
            np.full_like(array, 3), array.astype(np.int8), np.full(array.shape, 1e300),
        ):  # fmt: skip
            variants.append((meta, {**arrays, name: np.ascontiguousarray(other)}))
    for m, tensors in variants:
        said = json.dumps(m)
        header = {"vprism_plan": said, "sha256": content_digest(said, tensors)}
        save_file(tensors, made, metadata=header)
        outcome(kind, made.read_bytes())


def npz_of(depth: bytes, intrinsics: bytes | None = None, said: int | None = None) -> bytes:
    """An observation, its depth of so many bytes as the archive says."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", depth)
        archive.writestr("intrinsics.npy", npy_of(K) if intrinsics is None else intrinsics)
        if said is not None:
            archive.filelist[0].file_size = said
    return stream.getvalue()


def npy_of(array: Any, shape: Any = None, descr: str | None = None) -> bytes:
    """An array as .npy, its header saying something else if that is given."""
    stream = io.BytesIO()
    np.save(stream, array)
    content = stream.getvalue()
    for found, said in ((str(array.shape), shape), (repr(array.dtype.str), descr)):
        if said is not None:
            content = content.replace(found.encode(), said.encode(), 1)
            length = len(content) - 10 - array.nbytes
            content = content[:8] + struct.pack("<H", length) + content[10:]
    return content


def png_of(width: int, height: int) -> bytes:
    def chunk(name: bytes, content: bytes) -> bytes:
        body = name + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    rows = zlib.compress(bytes(10_000_000), 9)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        (chunk(b"IHDR", head), chunk(b"IDAT", rows), chunk(b"IEND", b""))
    )


def safetensors_of(header: str | dict[str, Any]) -> bytes:
    said = header if isinstance(header, str) else json.dumps(header)
    return struct.pack("<Q", len(said)) + said.encode() + bytes(64)


DEEP = 200_000
ALIASES = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
TENFOLD = "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefg", "bcdefgh", strict=True)
)
ENTITIES = f'<!DOCTYPE robot [<!ENTITY a "xxxxxxxxxx">{TENFOLD}]><robot name="&h;"/>'
LINKS = "".join(f'<link name="{i}"/>' for i in range(5000))
NODES = "".join(
    f'<node id="n{i}"><instance_node url="#n{i + 1}"/><instance_node url="#n{i + 1}"/></node>'
    for i in range(60)
)
DAE = (
    '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><library_nodes>'
    f'{NODES}<node id="n60"/></library_nodes><library_visual_scenes><visual_scene id="s">'
    '<node><instance_node url="#n0"/></node></visual_scene></library_visual_scenes>'
    '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
)
HUGE = {"version": 2, "config": {}, "object_ids": [1], "views": 1}
MADE = {
    "no such shape": ("npz", npz_of(npy_of(np.ones(3), "(9, 9)"))),
    "terabytes": ("npz", npz_of(npy_of(np.ones(3), "(9999999, 999999)"))),
    "a shape beyond integers": ("npz", npz_of(npy_of(np.ones(3), f"({2**62}, 8)"))),
    "objects": ("npz", npz_of(npy_of(np.ones(3), None, "'|O'"))),
    "text": ("npz", npz_of(npy_of(np.array([["x"]])))),
    "records": ("npz", npz_of(npy_of(np.ones((3, 3))), npy_of(np.zeros((3, 3), [("a", "f8")])))),
    "a deep header": ("npz", npz_of(npy_of(np.ones(3), "(" * 9000))),
    "a bomb": ("npz", npz_of(npy_of(np.zeros(1_000_000)), said=2**40)),
    "a wide image": ("png", png_of(100_000, 100_000)),
    "an image of 150 million pixels": ("png", png_of(15_000, 10_000)),
    "an image of nothing": ("png", png_of(0, 5)),
    "deep json": ("camera", b"[" * DEEP),
    "deep json in a key": ("bop", b'{"3":' * DEEP),
    "a long number": ("camera", b'{"fx": ' + b"9" * 100_000 + b"}"),
    "an image of a long number": ("bop", b'{"' + b"9" * 100_000 + b'": {}}'),
    "no text": ("trajectory", b"\xff\xfe\x00{"),
    "a text times a billion": (
        "trajectory",
        json.dumps(TRAJECTORY).replace('"sec": 1', '"sec": "xxxx"').encode(),
    ),
    "aliases of aliases": ("spheres", f"{ALIASES}collision_spheres: {{hand: *i}}".encode()),
    "aliases in a camera": ("yaml", f"{ALIASES}K: *i".encode()),
    "deep yaml of a camera": ("yaml", b"[" * DEEP),
    "a python object for a camera": ("yaml", b"K: !!python/object/apply:os.getcwd []"),
    "masks of a terabyte": ("masks", b'[{"size": [1000000, 1000000], "counts": "0"}]'),
    "masks that end early": ("masks", b'[{"size": [12, 16], "counts": "01"}]'),
    "runs that end early": ("masks", b'[{"size": [12, 16], "counts": [5, 3]}]'),
    "runs below zero": ("masks", b'[{"size": [12, 16], "counts": [5, -3, 190]}]'),
    "deep masks": ("masks", b"[" * DEEP),
    "a terabyte of points": (
        "npy points", npy_of(np.ones((4, 3)), "(999999999, 3)")
    ),
    "points of nothing": ("npy points", npy_of(np.ones((0, 3)))),
    "billions of points": (
        "pcd",
        b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 99999999999\n"
        b"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 99999999999\nDATA binary\n\x00\x00",
    ),
    "billions of packed points": (
        "pcd",
        b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 999999999\n"
        b"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 999999999\nDATA binary_compressed\n"
        b"\x08\x00\x00\x00\xff\xff\xff\xffabcdefgh",
    ),
    "aliases as names": ("spheres", f"{ALIASES}? *i\n: 1".encode()),
    "an alias in itself": ("spheres", b"collision_spheres: &a {hand: *a}"),
    "deep yaml": ("spheres", b"[" * DEEP),
    "deep yaml by indents": ("xrdf", "".join(" " * i + "a:\n" for i in range(1300)).encode()),
    "a number by sixties": ("xrdf", b"format: 1" + b":1" * 200_000),
    "a python object": ("spheres", b"collision_spheres: !!python/object/apply:os.getcwd []"),
    "entities": ("urdf", ENTITIES.encode()),
    "entities in UTF-16": ("srdf", ENTITIES.encode("utf-16")),
    "deep xml": ("urdf", b"<robot>" + b"<link>" * DEEP),
    "deep xml, closed": ("srdf", b"<robot>" + b"<a>" * DEEP + b"</a>" * DEEP + b"</robot>"),
    "many links": ("urdf", f"<robot>{LINKS}</robot>".encode()),
    "an encoding of no name": ("urdf", b'<?xml version="1.0" encoding="x-none"?><robot/>'),
    "a group of itself": ("srdf", b'<robot><group name="a"><group name="a"/></group></robot>'),
    "nodes of nodes": ("dae", DAE.encode()),
    "a node of itself": ("dae", DAE.replace("#n60", "#n0").encode()),
    "an STL of many": ("stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(100)),
    "a PLY of many": (
        "ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n" + bytes(100),
    ),
    "an OBJ of far corners": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999999\n"),
    "an OFF of many": ("off", b"OFF\n999999999 999999999 0\n0 0 0\n"),
    "a header of many bytes": ("map", struct.pack("<Q", 2**63) + bytes(100)),
    "a deep list of tensors": ("map", safetensors_of("[" * DEEP)),
    "a deep map": ("map", safetensors_of({"__metadata__": {"vprism_plan": "[" * DEEP}})),
    "a large tensor": (
        "map",
        safetensors_of(
            {
                "__metadata__": {"vprism_plan": json.dumps(HUGE)},
                "mean": {"dtype": "F64", "shape": [2**62, 2**62], "data_offsets": [0, 64]},
            }
        ),
    ),
    "an empty tensor": (
        "map",
        safetensors_of(
            {
                "__metadata__": {"vprism_plan": json.dumps(HUGE)},
                "mean": {"dtype": "F64", "shape": [0, 2**62], "data_offsets": [0, 0]},
            }
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_files_made_to_harm(kinds, name):
    kind, content = MADE[name]
    assert outcome(kinds[kind], content)
