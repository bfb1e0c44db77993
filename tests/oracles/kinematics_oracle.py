# SPDX-License-Identifier: BSD-3-Clause
"""Textbook kinematics, slow and independent of the package.

The URDF is read with ElementTree, rotations are matrix exponentials, transforms are
4x4 products from the root down. Nothing is shared with `vprism_plan.robots`.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation


def transform(R: np.ndarray, t) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def random_pose(rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    return transform(Rotation.random(rng=rng).as_matrix(), spread * rng.normal(size=3))


def _numbers(element, key: str, default: str) -> np.ndarray:
    text = default if element is None else element.get(key, default)
    return np.array([float(v) for v in text.split()])


def _origin(element) -> np.ndarray:
    origin = element.find("origin")
    rpy = _numbers(origin, "rpy", "0 0 0")
    return transform(Rotation.from_euler("xyz", rpy).as_matrix(), _numbers(origin, "xyz", "0 0 0"))


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def link_poses(path: Path, values: dict[str, float], base: np.ndarray) -> dict[str, np.ndarray]:
    """World pose of every link, given a value for every joint that moves and mimics none."""
    joints = ET.parse(path).getroot().findall("joint")
    by_name = {joint.get("name"): joint for joint in joints}

    def value(name: str) -> float:
        mimic = by_name[name].find("mimic")
        if mimic is None:
            return values[name]
        factor = float(mimic.get("multiplier", "1"))
        return factor * value(mimic.get("joint")) + float(mimic.get("offset", "0"))

    children = {joint.find("child").get("link") for joint in joints}
    links = [link.get("name") for link in ET.parse(path).getroot().findall("link")]
    poses = {link: base for link in links if link not in children}
    while len(poses) < len(links):
        for joint in joints:
            parent, child = (joint.find(k).get("link") for k in ("parent", "child"))
            if parent not in poses or child in poses:
                continue
            motion = np.eye(4)
            if joint.get("type") != "fixed":
                axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
                axis = axis / np.linalg.norm(axis)
                q = value(joint.get("name"))
                if joint.get("type") == "prismatic":
                    motion[:3, 3] = q * axis
                else:
                    motion[:3, :3] = expm(q * _skew(axis))
            poses[child] = poses[parent] @ _origin(joint) @ motion
    return poses


def sphere_centers(path: Path, spheres: dict, values: dict[str, float], base: np.ndarray) -> dict:
    """Link -> rows (x, y, z, radius) in the world, radius falling."""
    poses = link_poses(path, values, base)
    placed = {}
    for link, entries in spheres.items():
        rows = sorted(entries, key=lambda entry: -entry["radius"])
        T = poses[link]
        placed[link] = np.array(
            [[*(T[:3, :3] @ np.array(e["center"]) + T[:3, 3]), e["radius"]] for e in rows]
        )
    return placed


def dh_pose(rows: list[tuple[float, float, float]], q: np.ndarray, modified: bool) -> np.ndarray:
    """Product of Denavit-Hartenberg transforms; rows are (a, d, alpha)."""
    T = np.eye(4)
    for (a, d, alpha), theta in zip(rows, q, strict=True):
        turn_x = transform(Rotation.from_euler("x", alpha).as_matrix(), [a, 0, 0])
        turn_z = transform(Rotation.from_euler("z", theta).as_matrix(), [0, 0, d])
        T = T @ turn_x @ turn_z if modified else T @ turn_z @ turn_x
    return T


def random_urdf(rng: np.random.Generator, n_links: int) -> tuple[str, dict]:
    """A random tree as URDF text, and spheres for its links.

    Any joint type, axes of any length (unit for prismatic joints), branches, and
    followers of followers.
    """

    def origin() -> str:
        xyz, rpy = rng.normal(size=3) * 0.3, rng.uniform(-np.pi, np.pi, size=3)
        return f'<origin xyz="{" ".join(map(repr, xyz.tolist()))}" ' + (
            f'rpy="{" ".join(map(repr, rpy.tolist()))}"/>'
        )

    text = ['<robot name="random">'] + [f'<link name="l{i}"/>' for i in range(n_links)]
    movable: list[str] = []
    for i in range(1, n_links):
        kind = str(
            rng.choice(["revolute", "continuous", "prismatic", "fixed"], p=[0.5, 0.2, 0.2, 0.1])
        )
        if not movable:
            kind = "revolute"
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis) if kind == "prismatic" else 1.0
        body = [
            origin(),
            f'<parent link="l{int(rng.integers(max(0, i - 2), i))}"/><child link="l{i}"/>',
            f'<axis xyz="{" ".join(map(repr, axis.tolist()))}"/>',
            '<limit lower="-1.5" upper="1.25" effort="1" velocity="2"/>',
        ]
        if movable and kind != "fixed" and rng.random() < 0.3:
            driver = movable[int(rng.integers(len(movable)))]
            # Wide: followers would narrow the limits of what they follow.
            body[-1] = '<limit lower="-1000" upper="1000" effort="1" velocity="2"/>'
            body.append(
                f'<mimic joint="{driver}" multiplier="{rng.normal()!r}" offset="{rng.normal()!r}"/>'
            )
        text.append(f'<joint name="j{i}" type="{kind}">{"".join(body)}</joint>')
        if kind != "fixed":
            movable.append(f"j{i}")
    spheres = {
        f"l{i}": [
            {"center": (rng.normal(size=3) * 0.1).tolist(), "radius": float(rng.uniform(0.01, 0.1))}
            for _ in range(int(rng.integers(1, 4)))
        ]
        for i in range(n_links)
    }
    return "\n".join([*text, "</robot>"]), spheres
