# SPDX-License-Identifier: BSD-3-Clause
"""From files to the parts of a robot."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from vprism_plan.errors import RobotError
from vprism_plan.robots import _frames, _matrix, _self_collision
from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._mesh_files import PackageDirs
from vprism_plan.robots._model import RobotModel
from vprism_plan.robots._setup import choose_joints, lock_values, rigid_pose
from vprism_plan.robots._sphere_fit import SphereFit
from vprism_plan.robots._spheres import ChosenSpheres, link_spheres
from vprism_plan.robots._srdf import SemanticModel, load_srdf
from vprism_plan.robots._torch_kinematics import TorchKinematics
from vprism_plan.robots._urdf import load_model

_logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Request:
    """What :meth:`Robot.from_urdf` was asked for."""

    path: Path
    srdf: str | Path | None
    spheres: str | Path | Mapping[str, Any] | None
    base_pose: ArrayLike | None
    joints: Sequence[str] | None
    group: str | None
    locked: Mapping[str, float]
    package_dirs: PackageDirs
    fit: SphereFit
    matrix_samples: int


def robot_fields(request: Request) -> tuple[dict[str, Any], dict[str, float]]:
    """The fields of a robot, and the padding that a file of spheres asks for.

    Raises:
        RobotError: See :meth:`Robot.from_urdf`.
    """
    path = request.path
    model = load_model(path, request.package_dirs)
    beside = path.with_suffix(".srdf")
    srdf = beside if request.srdf is None and beside.is_file() else request.srdf
    semantics = SemanticModel() if srdf is None else load_srdf(srdf, model)
    active = choose_joints(model, semantics, request.joints, request.group)
    fixed_values = lock_values(model, semantics, active, request.locked)
    base = rigid_pose(np.eye(4) if request.base_pose is None else request.base_pose)
    chosen = link_spheres(model, path, request.spheres, request.fit)
    nothing = np.empty((0, 2), dtype=np.int64)
    arrays, links = _frames.build_arrays(model, active, fixed_values, chosen.rows, nothing, base)
    names = tuple(chosen.rows)
    pairs = _self_collision.candidate_pairs(model, links, names, semantics.disabled)
    if srdf is None:
        sampled = _sampled(arrays, pairs, names, request.matrix_samples)
    else:
        sampled = _touching_fits(arrays, pairs, chosen)
    disabled = dict(semantics.disabled) | sampled
    for pair, why in _built_so(model, arrays, names).items():
        disabled.setdefault(pair, why)
    kept = [frozenset((names[a], names[b])) not in disabled for a, b in pairs]
    arrays = dataclasses.replace(arrays, pairs=np.ascontiguousarray(pairs[kept]))
    solids = {n: link.primitives for n, link in model.links.items() if link.primitives}
    meshes = {n: link.meshes for n, link in model.links.items() if link.meshes}
    fields = {
        "name": model.name,
        "joint_names": active,
        "locked": fixed_values,
        "velocity_limits": np.array([model.joint_map[j].velocity for j in active]),
        "base_pose": base,
        "link_names": names,
        "geometry": solids,
        "named_states": _states(semantics, active),
        "groups": dict(semantics.group_links),
        "disabled_pairs": disabled,
        "arrays": arrays,
        "_links": links,
        "_torch": TorchKinematics(arrays),
        "links_with_meshes": tuple(meshes),
        "meshes": meshes,
        "geometry_as_read": solids,
        "meshes_as_read": meshes,
        "_sampled_pairs": {pair: _hangs_on(model, fixed_values, pair) for pair in sampled},
        "link_spheres": chosen.rows,
        "sphere_sources": chosen.sources,
        "_file_padding": chosen.padding,
    }
    return fields, chosen.padding


def _states(semantics: SemanticModel, active: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {
        name: np.array([values[joint] for joint in active])
        for name, values in semantics.merged_states().items()
        if all(joint in values for joint in active)
    }


def _sampled(
    arrays: KinematicArrays,
    pairs: Int[np.ndarray, "pairs 2"],
    names: tuple[str, ...],
    samples: int,
) -> dict[frozenset[str], str]:
    """Pairs that random configurations show not to need a test, where there is no SRDF."""
    if samples < 1:
        raise RobotError(f"matrix_samples is {samples}; at least 1 configuration is needed")
    sampled = _matrix.sampled_reasons(arrays, pairs, names, samples)
    always = [tuple(sorted(pair)) for pair, why in sampled.items() if why == _matrix.ALWAYS]
    if always:
        _logger.warning("not tested for self-collision, their spheres always overlap: %s", always)
    return sampled


def _built_so(
    model: RobotModel, arrays: KinematicArrays, names: tuple[str, ...]
) -> dict[frozenset[str], str]:
    """The pairs that are never candidates, SRDF or not, with the reason for each."""
    adjacent = _self_collision.adjacent_pairs(model, set(names))
    reasons = dict.fromkeys(_rigid_pairs(arrays, names), _matrix.RIGID)
    return reasons | dict.fromkeys(sorted(adjacent, key=sorted), _matrix.ADJACENT)


def _hangs_on(model: RobotModel, joints: Collection[str], pair: frozenset[str]) -> bool:
    """Whether any of these joints, or one that mimics it, moves two links against each other."""
    above = {joint.child: joint for joint in model.joints}
    between: set[str] = set()
    for end in pair:
        link = end
        while link in above:
            between ^= {above[link].name}  # what is above both moves neither against the other
            link = above[link].parent
    return any(model.resolve_mimic(name)[0] in joints for name in between)


def _rigid_pairs(arrays: KinematicArrays, names: tuple[str, ...]) -> list[frozenset[str]]:
    frame = arrays.link_frame
    return [
        frozenset((names[a], names[b]))
        for a in range(len(names))
        for b in range(a + 1, len(names))
        if frame[a] == frame[b]
    ]


def _touching_fits(
    arrays: KinematicArrays, pairs: Int[np.ndarray, "pairs 2"], chosen: ChosenSpheres
) -> dict[frozenset[str], str]:
    """Pairs that an SRDF wants tested, and whose fitted spheres overlap in every pose."""
    names = tuple(chosen.rows)
    made = np.array([chosen.sources[name] in ("fitted", "tiled") for name in names])
    fitted = pairs[made[pairs].any(axis=1)]
    touching = fitted[_self_collision.always_touching(arrays, fitted)]
    if len(touching):
        listed = [(names[a], names[b]) for a, b in touching]
        _logger.warning(
            "the SRDF tests pairs whose fitted spheres always overlap; they are not tested: %s; "
            "a smaller tolerance (fit=) may part them",
            listed,
        )
    return {frozenset((names[a], names[b])): _matrix.ALWAYS for a, b in touching}
