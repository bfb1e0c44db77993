# SPDX-License-Identifier: BSD-3-Clause
"""Points, their labels and where their camera was, from files of point clouds."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan import _files
from vprism_plan.errors import ObservationError
from vprism_plan.perception.images import MOST_PIXELS, read_array

_LABELS = ("label", "labels", "object_id", "instance", "instance_id", "segment", "id")
_MOST_BYTES = 64 * MOST_PIXELS
# Points (..., 3), labels (...) and the position of the camera, the latter two if stated.
Cloud = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]


def read_cloud(path: Path) -> Cloud:
    """Read a `.pcd`, `.ply` or `.npy` file; organised points are (H, W, 3), others (N, 3).

    Raises:
        ObservationError: it cannot be read, or is a mesh.
        MissingDependencyError: PCD files need the extra `formats`.
    """
    with _files.reading(path, "a readable point cloud", ObservationError, _MOST_BYTES):
        return _READERS[path.suffix](path)


def _read_pcd(path: Path) -> Cloud:
    """Points, labels and viewpoint of PCL's format."""
    library = _files.optional("pypcd4", "formats", "PCD files need")
    with path.open("rb") as stream:
        cloud = library.PointCloud.from_fileobj(stream)
    shape = (cloud.metadata.height, cloud.metadata.width)
    points, labels = _columns(cloud.pc_data)
    view = np.array(cloud.metadata.viewpoint[:3], dtype=np.float64)
    if shape[0] > 1:
        points = points.reshape(*shape, 3)
        labels = None if labels is None else labels.reshape(shape)
    return points, labels, view if view.any() else None


def _read_ply(path: Path) -> Cloud:
    """Points, labels and viewpoint (as PCL writes it) of a PLY file without faces."""
    import trimesh

    cloud = trimesh.load(path, process=False)
    raw = cloud.metadata.get("_ply_raw", {})
    vertex = raw.get("vertex", {}).get("data")
    if vertex is None or len(raw.get("face", {}).get("data", ())):
        raise ObservationError(f"{path} is a mesh or empty; a view is a cloud of seen points")
    points, labels = _columns(vertex)
    seen = raw.get("camera", {}).get("data")
    view = None
    if seen is not None and len(seen) and "view_px" in (seen.dtype.names or ()):
        view = np.array([float(seen[f"view_p{axis}"][0]) for axis in "xyz"])
    return points, labels, view if view is not None and view.any() else None


def _columns(table: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (N, 3), and labels if there are some, of a table with named columns."""
    points = np.stack([np.asarray(table[axis], np.float64).ravel() for axis in "xyz"], axis=-1)
    name = next((name for name in _LABELS if name in (table.dtype.names or ())), None)
    return points, None if name is None else _whole(table[name].ravel(), f"field {name!r}")


def _read_npy(path: Path) -> Cloud:
    """Points (..., 3), or with their labels (..., 4)."""
    array = read_array(path)
    if array.ndim not in (2, 3) or array.shape[-1] not in (3, 4):
        wanted = "points are (N, 3) or (H, W, 3), with labels (N, 4) or (H, W, 4)"
        raise ObservationError(f"{path} has shape {array.shape}; {wanted}")
    labels = _whole(array[..., 3], "column 3, the labels,") if array.shape[-1] == 4 else None
    return array[..., :3], labels, None


_READERS: dict[str, Callable[[Path], Cloud]]
_READERS = {".pcd": _read_pcd, ".ply": _read_ply, ".npy": _read_npy}


def _whole(values: Any, what: str) -> np.ndarray:
    """Return labels that a format keeps as floats."""
    values = np.asarray(values)
    if values.dtype.kind == "f":
        values = np.where(np.isnan(values), 0, values)
        if not (values == np.rint(values)).all():
            raise ObservationError(f"{what} holds {values.dtype} numbers that are no whole ids")
        values = values.astype(np.int64)
    return values
