# SPDX-License-Identifier: BSD-3-Clause
"""Maps on disk: one safetensors file, JSON in its header, no pickle.

The tensors are the posterior exactly as it is used, so a loaded map answers with the
same bits. The header key "vprism_plan" holds version, configuration, object ids, plane,
seed, bound and which parts each view has.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from vprism_plan._files import replacing
from vprism_plan.errors import MapError, VPrismError
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.em import Posterior
from vprism_plan.mapping.features import FeatureSpace
from vprism_plan.perception.observation import DEFAULT_MAX_RANGE, Observation
from vprism_plan.perception.plane import Plane

if TYPE_CHECKING:
    from vprism_plan.mapping.posterior import VPrismMap

FORMAT_VERSION = 1
_HEADER = "vprism_plan"
_VIEW_PARTS = ("depth", "labels", "intrinsics", "T_world_camera", "color", "robot_spheres")


def save_map(fitted: "VPrismMap", path: str | Path) -> None:
    """Write a map to `path`: to a temporary file beside it first, then renamed."""
    path = Path(path)
    posterior = fitted.posterior
    tensors = {
        "hinges": fitted.space.hinges,
        "mean": posterior.mean,
        "covariance": posterior.covariance,
        "precision": posterior.precision,
        "log_determinant": posterior.log_determinant,
        "history": np.array(posterior.history),
        "plane": _plane_row(fitted.plane),
    }
    for index, view in enumerate(fitted.views):
        for part in _VIEW_PARTS:
            if getattr(view, part) is not None:
                tensors[f"view{index}.{part}"] = getattr(view, part)
        if view.plane is not None:
            tensors[f"view{index}.plane"] = _plane_row(view.plane)
    meta = {
        "version": FORMAT_VERSION,
        "config": asdict(fitted.config),
        "object_ids": list(fitted.object_ids),
        "seed": fitted.seed,
        "views": len(fitted.views),
        "max_range": [view.max_range for view in fitted.views],
        "warnings": list(fitted.warnings),
        "radius": float(fitted.space.radius).hex(),
    }
    arrays = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    if not path.parent.is_dir():
        raise MapError(f"cannot write {path}: the folder {path.parent} does not exist")
    with replacing(path) as temporary:
        save_file(arrays, temporary, metadata={_HEADER: json.dumps(meta)})


def load_map(path: str | Path) -> "VPrismMap":
    """Read a map written by `VPrismMap.save`; it answers bit-identically.

    Raises:
        MapError: no such file, not a map, a version this release does not read, or damaged.
    """
    from vprism_plan.mapping.posterior import VPrismMap

    path = Path(path)
    if not path.is_file():
        raise MapError(f"no map at {path}; write one with VPrismMap.save")
    meta, tensors = _read(path)
    if meta.get("version") != FORMAT_VERSION:
        raise MapError(
            f"{path} is a map of format version {meta.get('version')!r}; this release reads "
            f"version {FORMAT_VERSION}; fit it again"
        )
    try:
        config = MapConfig(
            **{**meta["config"], "hinge_shift": tuple(meta["config"]["hinge_shift"])}
        )
        space = FeatureSpace(tensors["hinges"], config.gamma, float.fromhex(meta["radius"]))
        posterior = Posterior(
            tensors["mean"],
            tensors["covariance"],
            tensors["precision"],
            tensors["log_determinant"],
            tuple(tensors["history"].tolist()),
        )
        object_ids = tuple(int(i) for i in meta["object_ids"])
        _check_sizes(path, space, posterior, object_ids)
        count = int(meta["views"])
        ranges = meta.get("max_range", [None] * count)
        views = tuple(_view(tensors, i, r) for i, r in zip(range(count), ranges, strict=True))
        plane = _plane(tensors["plane"])
        warnings = tuple(str(text) for text in meta.get("warnings", ()))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, VPrismError):
            raise
        raise MapError(f"{path} is a damaged map ({error!r}); fit it again") from error
    return VPrismMap(
        config, object_ids, plane, views, space, posterior, int(meta["seed"]), warnings
    )


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get(_HEADER)
            if header is None:
                raise MapError(f"{path} is a safetensors file, but not a map of this package")
            tensors = {name: np.ascontiguousarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
        return json.loads(header), tensors
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise MapError(f"{path} cannot be read as a map: {error}; fit it again") from error


def _check_sizes(
    path: Path, space: FeatureSpace, posterior: Posterior, object_ids: tuple[int, ...]
) -> None:
    classes = len(object_ids) + 1
    expected = {
        "mean": (space.size, classes),
        "covariance": (space.envelope_size, classes),
        "precision": (space.envelope_size, classes),
        "log_determinant": (classes,),
    }
    for name, shape in expected.items():
        array = getattr(posterior, name)
        if array.shape != shape or array.dtype != np.float64 or not np.isfinite(array).all():
            raise MapError(
                f"{path} is damaged: {name} has shape {array.shape} and type {array.dtype}, "
                f"or holds NaN; expected finite float64 {shape}; fit it again"
            )


def _plane_row(plane: Plane) -> np.ndarray:
    return np.array([*plane.normal, plane.offset])


def _plane(row: np.ndarray) -> Plane:
    plane = Plane(row[:3], float(row[3]))
    # The constructor scales to unit length, which may move the last bit of a stored normal.
    plane.__setstate__({"normal": row[:3].copy(), "offset": float(row[3])})
    return plane


def _view(tensors: dict[str, np.ndarray], index: int, max_range: float | None) -> Observation:
    parts: dict[str, Any] = {part: tensors.get(f"view{index}.{part}") for part in _VIEW_PARTS}
    row = tensors.get(f"view{index}.plane")
    if max_range is None:  # a file older than the limit: the map was learned from all it holds
        max_range = max(DEFAULT_MAX_RANGE, float(parts["depth"].max()))
    return Observation(**parts, plane=None if row is None else _plane(row), max_range=max_range)
