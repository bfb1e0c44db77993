# SPDX-License-Identifier: BSD-3-Clause
"""Objects fall on a table until they rest (MuJoCo, headless, one thread).

MuJoCo collides convex hulls. Objects whose hulls touch without overlapping cannot
overlap themselves; a cup rests as if it were filled.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import MissingDependencyError
from vprism_plan.evaluation.generation.shapes import Shape

_DENSITY = 400.0  # kg/m^3, of the hulls
_TIME_STEP = 0.002  # seconds
_TIME_LIMIT = 8.0  # seconds until every object must rest
_GATHERING = 0.8  # seconds from the start during which everything is drawn together
_PULL = 6.0  # m/s^2 towards the middle meanwhile
_CALM = 0.3  # seconds that it must rest
_CHUNK = 25  # steps between looks
_SLOW = (0.002, 0.02)  # m/s and rad/s that count as rest
_DAMPING = np.repeat([0.1, 1e-3], 3)  # N s/m, N m s/rad: ends the rolling of round objects
_OVERLAP = 0.0008  # metres by which hulls may press into each other and the table
_REGION = 0.3  # metres around the middle of the pile that every object must lie within
_GAP = 0.004  # metres between the boxes of objects before they fall
_CANDIDATES = 4  # places that are looked at for each object; the lowest wins
_PACKING = 1.5  # share of the disc of places that the objects' shadows cover


def drop(shapes: list[Shape], rng: np.random.Generator) -> Float[np.ndarray, "n 4 4"] | None:
    """Return the poses of shapes at rest, the middle of the pile above the origin.

    Objects start in random orientations, close together, and fall at the same time.
    Returns None when something does not come to rest within 8 simulated seconds, rolls
    farther than 30 cm from the others, or is pressed into its neighbour by more than
    0.8 mm: the caller tries again with other numbers.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
    """
    mujoco = _mujoco()
    model = _compile(mujoco, shapes)
    data = mujoco.MjData(model)
    data.qpos[:] = _start(shapes, rng).ravel()
    if not _settle(mujoco, model, data):
        return None
    if data.ncon and float(np.asarray(data.contact.dist).min()) < -_OVERLAP:
        return None
    poses = _poses(mujoco, data.qpos.reshape(-1, 7))
    middle = poses[:, :2, 3].mean(axis=0)
    # Rounded to micrometres, so that the move itself is no source of odd bits.
    poses[:, :2, 3] = np.round(poses[:, :2, 3] - middle, 6)
    poses[:, 2, 3] = np.round(poses[:, 2, 3], 6)
    if np.linalg.norm(poses[:, :2, 3], axis=1).max() > _REGION:
        return None
    return poses


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise MissingDependencyError(
            "scenes are dropped with MuJoCo: pip install 'vprism_plan[evaluation]'"
        ) from error
    return mujoco


def _compile(mujoco: Any, shapes: list[Shape]) -> Any:
    """Return the model: a table and one freely moving convex hull per shape."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0  # friction as firm as the contacts: nothing creeps
    # Several contacts per pair, so that a face on a face does not rock: MuJoCo 4 always
    # has them, MuJoCo 3 only where asked.
    if hasattr(mujoco.mjtEnableBit, "mjENBL_MULTICCD"):
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_MULTICCD
    contact = {"condim": 6, "friction": [0.5, 0.005, 0.001], "solref": [0.01, 1.0]}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **contact)
    for index, shape in enumerate(shapes):
        corners = np.ascontiguousarray(shape.vertices[shape.hull])
        spec.add_mesh(name=f"shape{index}", uservert=corners.ravel())
        body = spec.worldbody.add_body(name=f"object{index}")
        body.add_freejoint()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"shape{index}",
            density=_DENSITY,
            **contact,
        )
    model = spec.compile()
    model.dof_damping[:] = np.tile(_DAMPING, len(shapes))
    return model


def _start(shapes: list[Shape], rng: np.random.Generator) -> np.ndarray:
    """Return positions and quaternions (n, 7): boxes close together, none overlapping."""
    turns = rng.normal(size=(len(shapes), 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    corners = [s.vertices[s.hull] @ _rotation(q).T for s, q in zip(shapes, turns, strict=True)]
    low = np.array([c.min(axis=0) for c in corners])
    high = np.array([c.max(axis=0) for c in corners])
    shadows = np.prod((high - low)[:, :2], axis=1)
    reach = float(np.sqrt(shadows.sum() / (np.pi * _PACKING)))
    start = np.empty((len(shapes), 7))
    for k in range(len(shapes)):
        best = np.inf
        for _ in range(_CANDIDATES):
            angle = rng.uniform(-np.pi, np.pi)
            place = reach * np.sqrt(rng.random()) * np.array([np.cos(angle), np.sin(angle)])
            height = _lowest(place, k, start, low, high)
            if height < best:
                best = height
                start[k, :3] = (*place, height)
        start[k, 3:] = turns[k]
    return start


def _lowest(
    place: np.ndarray, k: int, start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> float:
    """Return the height of object k's origin at which its box clears those placed before."""
    apart = (
        (start[:k, :2] + low[:k, :2] > place + high[k, :2] + _GAP)
        | (start[:k, :2] + high[:k, :2] < place + low[k, :2] - _GAP)
    ).any(axis=1)
    tops = (start[:k, 2] + high[:k, 2])[~apart]
    return float(max(tops.max(initial=0.0), 0.0) + _GAP - low[k, 2])


def _settle(mujoco: Any, model: Any, data: Any) -> bool:
    """Step until everything has been slow for a while; whether that happened in time."""
    calm = 0.0
    while data.time < _TIME_LIMIT:
        data.xfrc_applied[1:, :2] = _pull(model, data) if data.time < _GATHERING else 0.0
        mujoco.mj_step(model, data, _CHUNK)
        speed = data.qvel.reshape(-1, 6)
        still = (
            np.linalg.norm(speed[:, :3], axis=1).max() < _SLOW[0]
            and np.linalg.norm(speed[:, 3:], axis=1).max() < _SLOW[1]
        )
        calm = calm + _CHUNK * _TIME_STEP if still else 0.0
        if calm >= _CALM:
            return True
        if np.linalg.norm(data.qpos.reshape(-1, 7)[:, :2], axis=1).max() > 4 * _REGION:
            return False
    return False


def _pull(model: Any, data: Any) -> np.ndarray:
    """Return horizontal forces (n, 2) towards the middle, fading within its last 3 cm."""
    away = data.xipos[1:, :2]
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(-_PULL * model.body_mass[1:, None] * away / np.maximum(distance, 0.03))


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _poses(mujoco: Any, placed: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(placed), 1, 1))
    for pose, row in zip(poses, placed, strict=True):
        pose[:3, :3] = _rotation(np.round(row[3:], 9))
        pose[:3, 3] = row[:3]
    return poses
