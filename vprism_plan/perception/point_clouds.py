# SPDX-License-Identifier: BSD-3-Clause
"""A point cloud, looked at from where its camera stood, is a depth image."""

from typing import Any

import numpy as np
from scipy import ndimage
from scipy.linalg import rq
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vprism_plan._arguments import rigid_pose
from vprism_plan._shapes import Indices, Matrix, Pixels, PointImage, Points, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import project
from vprism_plan.perception.labels import label_image, to_numpy
from vprism_plan.perception.observation import check_intrinsics

_OFF = 1.0  # pixels rms by which an organised cloud may miss a pinhole's pixels
_FEWEST = 50  # points that tell where a camera looked and how dense they lie
_SAMPLE = 20000
_WIDEST = 3.0  # tangent of the angle off the axis that an image still shows: 72 degrees
_MOST_ACROSS = 2000  # pixels of an image that is made
_NEIGHBOURS = 8  # of a point; on a square lattice the pixels around it
_SPARSE = 98.0  # percent of the points; where these few are sparser there may be holes
_WIDEST_GAP = 16  # pixels
_BEHIND, _MANY_BEHIND = 0.05, 0.1  # metres, share of the points
_STEEP = 5.0  # how much farther a pixel's far side may be, in its widths: a slant of 79 degrees


def image_of(points: Any, labels: Any, camera: Any, intrinsics: Any) -> dict[str, Any]:
    """Return `depth`, `labels`, `intrinsics`, `T_world_camera` and `warnings` of a view.

    Arguments are those of `Observation.from_points`.
    """
    points = to_numpy(points, "points").astype(np.float64)
    if points.ndim not in (2, 3) or points.shape[-1] != 3 or not points.size:
        wanted = "they must be (H, W, 3), one per pixel, or (N, 3), metres"
        raise ObservationError(f"points have shape {points.shape}; {wanted}")
    shape = (points.shape[0], points.shape[1] if points.ndim == 3 else 1)
    points = points.reshape(*shape, 3)
    is_point = np.isfinite(points).all(axis=-1) & points.any(axis=-1)
    if is_point.sum() < _FEWEST:
        raise ObservationError(
            f"{int(is_point.sum())} of {is_point.size} points are finite and not (0, 0, 0); a view "
            f"needs at least {_FEWEST}"
        )
    found: tuple[str, ...] = ()
    if labels is not None:
        value = labels if shape[1] > 1 else to_numpy(labels, "labels").reshape(-1, 1)
        labels, found = label_image(value, shape)
    center, turn = _camera(camera, points[is_point])
    known = None
    if intrinsics is not None:
        known = check_intrinsics(intrinsics, shape if min(shape) > 1 else (2**31, 2**31))
    if min(shape) > 1:
        view, off = _organised(points - center, is_point, turn, known)
        if off <= _OFF:
            turn = view.pop("turn")
            return {**view, "labels": labels, "warnings": found} | _placed(center, turn)
        if center.any() and _organised(points, is_point, np.eye(3), known)[1] <= _OFF:
            raise ObservationError(
                f"the points are in the camera's own frame, not in that in which it is at "
                f"{center.round(3)}: transform them, or give (0, 0, 0) and set T_world_camera after"
            )
        found += (
            f"the (H, W, 3) points miss the pixels of a pinhole camera at {center.round(3)} by "
            f"{off:.3g} pixels rms, more than {_OFF:g}, and are taken as (N, 3): is "
            "camera_position in the frame of the points?",
        )
    own = None if labels is None else labels[is_point]
    view = _unorganised(points[is_point] - center, own, turn, known)
    turn = view.pop("turn")
    return {**view, "warnings": found + view["warnings"]} | _placed(center, turn)


def _camera(camera: Any, points: Points) -> tuple[Vector, Matrix | None]:
    """Return where the camera is, and its turn if that is known, in the frame of the points."""
    given = to_numpy(camera, "camera_position").astype(np.float64)
    if given.shape == (4, 4):
        pose = rigid_pose("camera_position", given, tolerance=1e-3, error=ObservationError)
        return pose[:3, 3], pose[:3, :3]
    if given.shape != (3,) or not np.isfinite(given).all():
        wanted = "it must be (x, y, z), metres, or a pose (4, 4), in the frame of the points"
        raise ObservationError(f"camera_position is {given.tolist()}; {wanted}")
    if not given.any() and (points[:, 2] > 0).all():
        return given, np.eye(3)
    return given, None


def _placed(center: Vector, turn: Matrix) -> dict[str, Any]:
    if not center.any() and np.array_equal(turn, np.eye(3)):
        return {"T_world_camera": None}
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, center
    return {"T_world_camera": pose}


# ---------------------------------------------------------------------------------- organised
def _organised(
    points: PointImage, is_point: Pixels, turn: Matrix | None, intrinsics: Matrix | None
) -> tuple[dict[str, Any], float]:
    """Return the view that a grid of points is, and by how many pixels rms it is none.

    Points are relative to the camera, `turn` maps the optical frame to theirs.
    """
    rows, columns = np.nonzero(is_point)
    some = slice(None, None, max(1, len(rows) // _SAMPLE))
    pixels = np.stack([columns[some], rows[some]], axis=1).astype(np.float64)
    seen = points[rows[some], columns[some]]
    if turn is not None and not (seen @ turn[:, 2] > 0).all():
        return {}, np.inf
    try:
        if intrinsics is None:
            intrinsics = _intrinsics(seen, pixels, turn)
        check_intrinsics(intrinsics, is_point.shape)
        if turn is None:
            turn = _turn(seen, pixels, intrinsics)
    except (ObservationError, np.linalg.LinAlgError):
        return {}, np.inf  # no pinhole's image; the caller says so
    local = points @ turn
    there, z = project(local[is_point], intrinsics)
    off = np.inf
    if (z > 0).all():
        off = float(np.sqrt(((there - np.stack([columns, rows], axis=1)) ** 2).sum(1).mean()))
    depth = np.where(is_point, local[..., 2], 0.0)
    return {"depth": depth, "intrinsics": intrinsics, "turn": turn}, off


def _intrinsics(seen: Points, pixels: np.ndarray, turn: Matrix | None) -> Matrix:
    """Fit a pinhole to points relative to the camera and their pixels (column, row)."""
    if turn is not None:
        local = seen @ turn
        fx, cx = np.polyfit(local[:, 0] / local[:, 2], pixels[:, 0], 1)
        fy, cy = np.polyfit(local[:, 1] / local[:, 2], pixels[:, 1], 1)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    # Directions map to pixels by K R^T, up to scale: two linear equations for each.
    ray = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    middle, scale = pixels.mean(axis=0), pixels.std()
    u, v = ((pixels - middle) / max(scale, 1.0)).T[..., None]
    none = np.zeros_like(ray)
    equations = np.concatenate([np.hstack([ray, none, -u * ray]), np.hstack([none, ray, -v * ray])])
    solution = np.linalg.eigh(equations.T @ equations)[1][:, 0].reshape(3, 3)
    solution *= np.sign(np.median(ray @ solution[2]))
    back = np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1.0]])
    matrix, _ = rq(back @ solution)
    matrix = matrix @ np.diag(np.sign(np.diag(matrix))) / abs(matrix[2, 2])
    matrix[0, 1] = 0.0
    return np.asarray(matrix)


def _turn(seen: Points, pixels: np.ndarray, intrinsics: Matrix) -> Matrix:
    """Turn of the optical frame that lays the rays of pixels onto the points seen there."""
    rays = np.ones_like(seen)
    rays[:, :2] = (pixels - intrinsics[:2, 2]) / intrinsics.diagonal()[:2]
    lengths = (np.linalg.norm(v, axis=1, keepdims=True) for v in (seen, rays))
    there, here = (v / length for v, length in zip((seen, rays), lengths, strict=True))
    return np.asarray(Rotation.align_vectors(there, here)[0].as_matrix())


# -------------------------------------------------------------------------------- unorganised
def _unorganised(
    points: Points, labels: Indices | None, turn: Matrix | None, intrinsics: Matrix | None
) -> dict[str, Any]:
    """Return what a camera sees of points (relative to it) that it looks at.

    A pixel has the nearest point in it. Where every window of pixels around it that is as wide
    as gaps between points has a nearer one, it has the farthest of these: surfaces have no
    holes, nothing shines through them, and outlines stay where they are (a grey closing).
    """
    turn = _towards(points) if turn is None else turn
    local = points @ turn
    shown = (np.abs(local[:, :2]) < _WIDEST * local[:, 2:]).all(axis=1)
    if shown.sum() < _FEWEST:
        raise ObservationError(
            f"{int(shown.sum())} of {len(points)} points lie within 72 degrees of the camera's "
            "axis: does camera_position, and its pose if given, fit the points?"
        )
    local, z = local[shown], local[shown, 2]
    image = local[:, :2] / z[:, None]
    size, window = _pixel_size(image, intrinsics)
    low = np.minimum(image.min(axis=0), 0.0) - size
    column, row = np.floor((image - low) / size).astype(np.int64).T
    width, height = np.maximum([column.max(), row.max()], np.floor(-low / size).astype(int)) + 1

    # Points by nearness, from 1: of those in one pixel the last written, the nearest, stays.
    order = np.argsort(-z, kind="stable")
    nearness = np.zeros((height, width), dtype=np.int32)
    nearness[row[order], column[order]] = np.arange(1, len(order) + 1)
    point = np.append(-1, order)[ndimage.grey_closing(nearness, (window, window))]
    depth = np.where(point < 0, 0.0, z[point])
    ids = None if labels is None else np.where(point < 0, 0, labels[shown][point]).astype(np.int32)
    far = z > depth[row, column] + _BEHIND + _STEEP * size * z
    found = []
    if not shown.all():
        found.append(
            f"{int((~shown).sum())} of {len(points)} points lie more than 72 degrees off the "
            "camera's axis, or behind it, and are not in the view"
        )
    if far.mean() > _MANY_BEHIND:
        found.append(
            f"{100 * far.mean():.0f} % of the points lie more than {100 * _BEHIND:g} cm behind "
            "others and count as hidden: is camera_position right, and is this one view?"
        )
    column0, row0 = -low / size - 0.5
    return {
        "depth": depth,
        "labels": ids,
        "intrinsics": np.array([[1 / size, 0, column0], [0, 1 / size, row0], [0, 0, 1.0]]),
        "turn": turn,
        "warnings": tuple(found),
    }


def _towards(points: Points) -> Matrix:
    """Turn of an upright optical frame that looks at points."""
    forward = (points / np.linalg.norm(points, axis=1, keepdims=True)).mean(axis=0)
    forward /= max(float(np.linalg.norm(forward)), 1e-9)
    right = np.cross(forward, [0.0, 0, 1] if abs(forward[2]) < 0.999 else [0.0, 1, 0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _pixel_size(image: np.ndarray, intrinsics: Matrix | None) -> tuple[float, int]:
    """Return the width of a pixel at z = 1, and that of a window that always has a point, in
    pixels and odd."""
    distinct = np.unique(image.round(7), axis=0)  # of merged clouds
    if len(distinct) < _FEWEST:
        raise ObservationError(f"only {len(distinct)} points are distinct as the camera sees them")
    asked = distinct[:: max(1, len(distinct) // _SAMPLE)]
    gap = np.asarray(cKDTree(distinct).query(asked, [_NEIGHBOURS + 1])[0]).ravel()
    # To the eighth neighbour it is 1.4 spacings on a square lattice, 1.6 at random.
    sparse = 1.1 * float(np.percentile(gap, _SPARSE))
    size = 0.75 * float(np.median(gap)) if intrinsics is None else 1.0 / intrinsics[0, 0]
    across = float((np.maximum(image.max(axis=0), 0.0) - np.minimum(image.min(axis=0), 0.0)).max())
    size = max(size, sparse / _WIDEST_GAP, across / _MOST_ACROSS)  # the axis is in the image
    return size, int(np.ceil(sparse / size)) | 1
