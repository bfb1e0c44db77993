# SPDX-License-Identifier: BSD-3-Clause
"""Objects fall on a table until they rest (MuJoCo, headless, one thread).

MuJoCo collides convex hulls. Objects whose hulls touch without overlapping cannot
overlap themselves; a cup rests as if it were filled.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.generation.shapes import Shape
from vprism_plan.errors import MissingDependencyError

_NO_SLIP = 5  # iterations of the solver that keeps contacts from sliding slowly
_DENSITY = 400.0  # kg/m^3, of the hulls
_TIME_STEP = 0.002  # seconds
_TIME_LIMIT = 8.0  # seconds until every object must rest
_GATHERING = 0.8  # seconds from the start during which everything is drawn together
_PULL = 6.0  # m/s^2 towards the middle meanwhile
_CALM = 0.1  # seconds that speeds must stay below a limit
_CHUNK = 25  # steps between looks
_SLOW = (0.01, 0.1)  # m/s and rad/s after which friction is made firm
_STILL = (0.002, 0.02)  # m/s and rad/s that look like rest
_PROOF = 1.0  # seconds for which everything, let go without speed, must then stay
_STAYS = (0.0001, 0.002)  # metres and radians of motion that count as staying
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
    0.8 mm: the caller tries again with other numbers. At rest means: released without
    speed at these very poses, nothing moves by 0.1 mm or 0.002 rad in 1 s.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
    """
    mujoco = _mujoco()
    model = _compile(mujoco, shapes)
    data = mujoco.MjData(model)
    data.qpos[:] = _start(shapes, rng).ravel()
    if not _settle(mujoco, model, data, _SLOW):
        return None
    # MuJoCo's friction is soft: what leans would creep until it falls. The cure is dear,
    # so the fall itself does without it.
    model.opt.noslip_iterations = _NO_SLIP
    while _settle(mujoco, model, data, _STILL):
        placed = _rounded(data.qpos.reshape(-1, 7))
        data.qpos[:] = placed.ravel()
        if _rests(mujoco, model, data):
            fits = np.linalg.norm(placed[:, :2], axis=1).max() <= _REGION
            return _poses(placed) if fits else None
    return None


def rest_motion(
    shapes: list[Shape], poses: Float[np.ndarray, "n 4 4"], seconds: float
) -> tuple[float, float]:
    """Return how far shapes move and turn when released at rest at some poses: metres, radians.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
    """
    from scipy.spatial.transform import Rotation

    mujoco = _mujoco()
    model = _compile(mujoco, shapes)
    model.opt.noslip_iterations = _NO_SLIP
    data = mujoco.MjData(model)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    data.qpos[:] = np.concatenate([poses[:, :3, 3], turns], axis=1).ravel()
    return _released(mujoco, model, data, seconds)


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise MissingDependencyError(
            "scenes are dropped with MuJoCo: pip install 'vprism_plan[experiments]'"
        ) from error
    return mujoco


def _compile(mujoco: Any, shapes: list[Shape]) -> Any:
    """Return the model: a table and one freely moving convex hull per shape."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0  # friction ten times as firm as the contacts
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
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"shape{index}", density=_DENSITY, **contact
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


def _settle(mujoco: Any, model: Any, data: Any, limits: tuple[float, float]) -> bool:
    """Step until everything is slower than the limits for a while; whether it was in time."""
    calm = 0.0
    while data.time < _TIME_LIMIT:
        gathering = data.time < _GATHERING
        data.xfrc_applied[1:, :2] = _pull(model, data) if gathering else 0.0
        mujoco.mj_step(model, data, _CHUNK)
        speed = data.qvel.reshape(-1, 6)
        still = (
            np.linalg.norm(speed[:, :3], axis=1).max() < limits[0]
            and np.linalg.norm(speed[:, 3:], axis=1).max() < limits[1]
        )
        calm = calm + _CHUNK * _TIME_STEP if still and not gathering else 0.0
        if calm >= _CALM:
            return True
        if np.linalg.norm(data.qpos.reshape(-1, 7)[:, :2], axis=1).max() > 4 * _REGION:
            return False
    return False


def _rounded(placed: np.ndarray) -> np.ndarray:
    """Return positions and quaternions with the pile's middle above the origin, few digits.

    Micrometres and nine digits: what is saved, shown and simulated on is one and the same.
    """
    moved = placed.copy()
    moved[:, :2] -= moved[:, :2].mean(axis=0)
    moved[:, :3] = np.round(moved[:, :3], 6)
    moved[:, 3:] = np.round(moved[:, 3:], 9)
    return moved


def _rests(mujoco: Any, model: Any, data: Any) -> bool:
    """Whether everything stays where it is, and nothing is pressed in too far.

    A slow look is not rest: an object that balances takes its time to fall over.
    """
    mujoco.mj_forward(model, data)
    pressed = data.ncon and float(np.asarray(data.contact.dist).min()) < -_OVERLAP
    moved, turned = _released(mujoco, model, data, _PROOF, _STAYS)
    return not pressed and moved < _STAYS[0] and turned < _STAYS[1]


def _released(
    mujoco: Any,
    model: Any,
    data: Any,
    seconds: float,
    enough: tuple[float, float] = (np.inf, np.inf),
) -> tuple[float, float]:
    """Let go of everything without speed; return how far it moves (m) and turns (rad).

    Ends early once something has moved or turned by `enough`.
    """
    before = data.qpos.reshape(-1, 7).copy()
    data.qvel[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    moved = turned = 0.0
    for _ in range(round(seconds / (_CHUNK * _TIME_STEP))):
        mujoco.mj_step(model, data, _CHUNK)
        moved, turned = _difference(before, data.qpos.reshape(-1, 7))
        if moved >= enough[0] or turned >= enough[1]:
            break
    return moved, turned


def _difference(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return the largest distance (m) and angle (rad) between positions and quaternions."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(before[:, 3:], scalar_first=True).inv() * Rotation.from_quat(
        after[:, 3:], scalar_first=True
    )
    moved = np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max()
    return float(moved), float(turn.magnitude().max())


def _pull(model: Any, data: Any) -> np.ndarray:
    """Return horizontal forces (n, 2) towards the middle, fading within its last 3 cm."""
    away = data.xipos[1:, :2]
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(-_PULL * model.body_mass[1:, None] * away / np.maximum(distance, 0.03))


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _poses(placed: np.ndarray) -> np.ndarray:
    """Return transforms (n, 4, 4) of positions and quaternions (n, 7)."""
    poses = np.tile(np.eye(4), (len(placed), 1, 1))
    for pose, row in zip(poses, placed, strict=True):
        pose[:3, :3] = _rotation(row[3:])
        pose[:3, 3] = row[:3]
    return poses
