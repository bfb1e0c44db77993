# SPDX-License-Identifier: BSD-3-Clause
"""Maps on disk: one safetensors file, JSON in its header, no pickle.

The tensors are what the posterior follows from: means, and those entries of the precisions
that are not 0. Covariances are computed again, by the same steps on the same numbers, so a map
answers with the same bits (on another processor the last ones may differ). The header key
"vprism_plan" holds version, configuration, object ids, seed, warnings, the number of views and
the kernel's radius; "sha256" a digest of that and of all tensors. A file that is not what was
written is refused: one bit of it can free a shadow.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file
from scipy.spatial import cKDTree

from vprism_plan._arguments import is_whole
from vprism_plan._files import reading, replacing
from vprism_plan.errors import ConfigError, MapError, ObservationError
from vprism_plan.mapping.changes import Changes
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.em import Posterior, Weights
from vprism_plan.mapping.factors import inverse, run_per_class
from vprism_plan.mapping.features import FeatureSpace
from vprism_plan.mapping.prior import SIDE, PriorField
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

if TYPE_CHECKING:
    from vprism_plan.mapping.posterior import VPrismMap

FORMAT_VERSION = 4
_HEADER = "vprism_plan"
_DIGEST = "sha256"
_NEEDED_PARTS = ("depth", "labels", "intrinsics")
_VIEW_PARTS = (*_NEEDED_PARTS, "T_world_camera", "color", "robot_spheres", "clear")
_PRIOR = tuple(field.name for field in fields(PriorField) if field.name != "own")
_FARTHEST = 1e6  # metres; kernels count cells up to the farthest hinge


def save_map(fitted: "VPrismMap", path: str | Path) -> None:
    """Write a map to `path`: to a temporary file beside it first, then renamed."""
    path = Path(path)
    posterior = fitted.posterior
    tensors = {
        "hinges": fitted.space.hinges,
        "history": np.array(posterior.history),
        "plane": _plane_row(fitted.plane),
    }
    for k, own in enumerate(posterior.classes):
        rows, columns = own.space.pairs.T
        tensors[f"class{k}.members"] = own.members.astype(np.int32)
        tensors[f"class{k}.mean"] = own.mean
        tensors[f"class{k}.precision"] = own.precision[own.space.base[rows] + columns]
    prior = fitted.prior
    if prior is not None:
        tensors |= {f"prior.{name}": getattr(prior, name) for name in _PRIOR}
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
        "time": [view.time for view in fitted.views],
        "changes": asdict(fitted.changes),
        "warnings": list(fitted.warnings),
        "radius": float(fitted.space.radius).hex(),
        "own_prior": prior is not None and prior.own,
    }
    arrays = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    if not path.parent.is_dir():
        raise MapError(f"cannot write {path}: the folder {path.parent} does not exist")
    text = json.dumps(meta)
    header = {_HEADER: text, _DIGEST: content_digest(text, arrays)}
    with replacing(path) as temporary:
        save_file(arrays, temporary, metadata=header)


def content_digest(meta: str, tensors: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of everything that a map file says, as 64 hexadecimal digits."""
    digest = hashlib.sha256(meta.encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data.cast("B") if array.size else b"")
    return digest.hexdigest()


def load_map(path: str | Path) -> "VPrismMap":
    """Read a map written by `VPrismMap.save`; it answers bit-identically.

    Raises:
        MapError: no such file, not a map, a version this release does not read, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise MapError(f"no map at {path}; write one with VPrismMap.save")
    with reading(path, "a readable map", MapError):
        meta, tensors = _read(path)
        try:
            return _restored(meta, tensors)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            # Of this package's errors only the text is worth showing, not the kind.
            known = isinstance(error, MapError | ObservationError | ConfigError)
            raise MapError(
                f"{path} is a damaged map ({error if known else repr(error)}); fit it again"
            ) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what a file says, as it was written."""
    with safe_open(path, framework="numpy") as file:
        header = file.metadata() or {}
        if _HEADER not in header:
            raise MapError(f"{path} is a safetensors file, but not a map of this package")
        meta = json.loads(header[_HEADER])
        if meta["version"] != FORMAT_VERSION:
            raise MapError(
                f"{path} is a map of format version {meta['version']!r}; this release reads "
                f"version {FORMAT_VERSION}; fit it again"
            )
        tensors = {name: np.ascontiguousarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
    if content_digest(header[_HEADER], tensors) != header.get(_DIGEST):
        raise MapError(
            f"{path} is damaged: its SHA-256 digest is not that of its content; copy the file "
            "again, or fit the map again"
        )
    return meta, tensors


def _restored(meta: dict[str, Any], tensors: dict[str, np.ndarray]) -> "VPrismMap":
    """Return the map, if all of its parts fit together."""
    from vprism_plan.mapping.posterior import VPrismMap

    lengths = {name: tuple(meta["config"][name]) for name in ("hinge_shift", "prior_depths")}
    config = MapConfig(**{**meta["config"], **lengths})
    space = FeatureSpace(tensors["hinges"], config.gamma, float.fromhex(meta["radius"]))
    object_ids = tuple(meta["object_ids"])
    if not all(is_whole(i) and i > 0 for i in object_ids) or tuple(sorted(set(object_ids))) != (
        object_ids
    ):
        raise MapError(f"object ids are {object_ids}; they must be positive and rise")
    if not (is_whole(meta["seed"]) and meta["seed"] >= 0):
        raise MapError(f"seed is {meta['seed']!r}; it must be a whole number from 0")
    _check_hinges(space, config, len(tensors["class0.precision"]))
    posterior = _posterior(tensors, space, len(object_ids) + 1)
    views = _views(tensors, meta["views"], meta["max_range"], len(object_ids) + 1)
    times = meta.get("time", [None] * len(views))  # files of before have none, and no changes
    views = tuple(replace(view, time=t) for view, t in zip(views, times, strict=True))
    _check_labels(views, object_ids)
    plane, warnings = _plane(tensors["plane"]), tuple(meta["warnings"])
    if not all(isinstance(text, str) for text in warnings):
        raise MapError("warnings must be sentences")
    prior = _prior(tensors, len(object_ids), meta["own_prior"])
    return VPrismMap(
        config, object_ids, plane, views, space, posterior, meta["seed"], warnings, prior,
        _changes(meta.get("changes", {})),
    )  # fmt: skip


def _changes(meta: Any) -> Changes:
    """Return what the last update noticed."""
    found = {name: tuple(map(tuple, v) if name == "ids" else v) for name, v in meta.items()}
    flat = [i for name, v in found.items() for i in (sum(v, ()) if name == "ids" else v)]
    if not all(is_whole(i) and i > 0 for i in flat):
        raise MapError(f"changes are {meta}; they must be ids")
    return Changes(**found)


def _prior(tensors: Mapping[str, np.ndarray], objects: int, own: Any) -> PriorField | None:
    """Return the prior's field, if the file has one."""
    if "prior.log_odds" not in tensors:
        return None
    if not isinstance(own, bool):
        raise MapError(f"own_prior is {own!r}; it must be true or false")
    field = PriorField(**{name: tensors[f"prior.{name}"] for name in _PRIOR}, own=own)
    expected: dict[str, Any] = {
        "T_voxel_world": ((objects, 3, 4), np.float64),
        "log_odds": ((objects, SIDE, SIDE, SIDE), np.float32),
        "T_node_world": ((3, 4), np.float64),
        "elsewhere": (field.elsewhere.shape, np.float32),
    }
    for name, (shape, dtype) in expected.items():
        array = getattr(field, name)
        if array.shape != shape or array.dtype != dtype or not np.isfinite(array).all():
            raise MapError(f"prior.{name} must be finite {np.dtype(dtype)} {shape}")
    if field.elsewhere.ndim != 3 or min(field.elsewhere.shape) < 2:
        raise MapError(f"prior.elsewhere has shape {field.elsewhere.shape}")
    return field


def _check_hinges(space: FeatureSpace, config: MapConfig, stored: int) -> None:
    """Refuse hinges that kernels cannot take, or that make more pairs than are stored."""
    hinges = space.hinges
    if hinges.dtype != np.float64 or hinges.ndim != 2 or hinges.shape[1] != 3:
        raise MapError(f"hinges have shape {hinges.shape} and type {hinges.dtype}")
    if not (np.abs(hinges) <= _FARTHEST).all():
        raise MapError(f"hinges are not finite, or farther than {_FARTHEST:g} m")
    if not math.isclose(space.radius, config.cutoff_radius, rel_tol=1e-12):
        raise MapError(f"radius is {space.radius} m; its kernel has {config.cutoff_radius} m")
    if len(hinges):
        # Listing the pairs of hinges that are not these could take any amount of memory.
        tree = cKDTree(hinges)
        pairs = (int(tree.count_neighbors(tree, 2.0 * space.radius)) - len(hinges)) // 2
        if pairs > stored:
            raise MapError(
                f"{len(hinges)} hinges make {pairs} pairs, but there are {stored} of them"
            )


def _posterior(tensors: Mapping[str, np.ndarray], space: FeatureSpace, count: int) -> Posterior:
    """Return the posterior, if its parts fit together."""
    classes: list[Any] = [None] * count

    def read(k: int) -> None:
        classes[k] = _class(tensors, space, k)

    run_per_class(read, count)  # as they were learned: the number of threads changes bits
    if len(classes[0].members) != space.size:
        raise MapError("class 0, empty, must have all features")
    history = tensors["history"]
    if np.ndim(history) != 1 or not np.isfinite(history).all():
        raise MapError("history is no row of finite numbers")
    return Posterior(tuple(classes), tuple(history.tolist()))


def _class(tensors: Mapping[str, np.ndarray], space: FeatureSpace, k: int) -> Weights:
    members, mean, values = (
        tensors[f"class{k}.{name}"] for name in ("members", "mean", "precision")
    )
    if members.dtype != np.int32 or members.ndim != 1 or members.size == 0:
        raise MapError(f"class{k}.members have type {members.dtype}; they must be a row of int32")
    members = members.astype(np.int64)
    if members[0] < 0 or members[-1] != space.size - 1 or (np.diff(members) <= 0).any():
        raise MapError(f"class{k}.members must rise from 0 at least to the bias, {space.size - 1}")
    own = space.part(members)
    for name, array, size in (("mean", mean, own.size), ("precision", values, len(own.pairs))):
        if array.dtype != np.float64 or array.shape != (size,) or not np.isfinite(array).all():
            raise MapError(
                f"class{k}.{name} has shape {array.shape} and type {array.dtype}, or holds NaN; "
                f"expected finite float64 {(size,)}"
            )
    rows, columns = own.pairs.T
    precision = np.zeros(own.envelope_size)
    precision[own.base[rows] + columns] = values
    _, covariance, log_determinant = inverse(own, precision, mean)
    if not (np.isfinite(covariance).all() and (covariance[own.diagonal] > 0.0).all()):
        raise MapError(f"class{k}.precision has no inverse with positive variances")
    return Weights(members, own, mean, precision, covariance, log_determinant)


def _views(
    tensors: Mapping[str, np.ndarray], count: Any, ranges: Any, classes: int
) -> tuple[Observation, ...]:
    """Return all views; there is one at least, and no tensor belongs to nothing."""
    if not (is_whole(count) and 0 < count <= len(tensors)):
        raise MapError(f"views is {count!r}; a map is learned from one at least")
    if not (isinstance(ranges, list) and len(ranges) == count):
        raise MapError(f"max_range is {ranges!r}; it must be a list of one length per view")
    names = {"hinges", "history", "plane"} | {f"prior.{name}" for name in _PRIOR}
    for k in range(classes):
        names.update(f"class{k}.{name}" for name in ("members", "mean", "precision"))
    for index in range(count):
        names.update(f"view{index}.{part}" for part in (*_VIEW_PARTS, "plane"))
    stray = sorted(set(tensors) - names)
    if stray:
        raise MapError(f"{', '.join(stray)} belong to none of its {count} views")
    return tuple(_view(tensors, i, ranges[i]) for i in range(count))


def _check_labels(views: tuple[Observation, ...], object_ids: tuple[int, ...]) -> None:
    seen = {i for view in views for i in view.object_ids}
    labelled = {int(i) for view in views for i in np.unique(view.labels)}
    if not (seen <= set(object_ids) <= labelled):
        raise MapError(
            f"it is of the objects {object_ids}, and its views show {tuple(sorted(seen))}"
        )


def _plane_row(plane: Plane) -> np.ndarray:
    return np.array([*plane.normal, plane.offset])


def _plane(row: np.ndarray) -> Plane:
    if row.shape != (4,) or not math.isclose(np.linalg.norm(row[:3]), 1.0, abs_tol=1e-9):
        raise MapError(f"a plane is {row.tolist()}; it must be a unit normal and an offset")
    plane = Plane(row[:3], float(row[3]))
    # The constructor scales to unit length, which may move the last bit of a stored normal.
    plane.__setstate__({"normal": row[:3].copy(), "offset": float(row[3])})
    return plane


def _view(tensors: Mapping[str, np.ndarray], index: int, max_range: float) -> Observation:
    parts: dict[str, Any] = {part: tensors.get(f"view{index}.{part}") for part in _VIEW_PARTS}
    for part in _NEEDED_PARTS:
        if parts[part] is None:
            raise MapError(f"view {index} has no {part}")
    row = tensors.get(f"view{index}.plane")
    return Observation(**parts, plane=None if row is None else _plane(row), max_range=max_range)
