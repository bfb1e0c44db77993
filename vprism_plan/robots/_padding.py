# SPDX-License-Identifier: BSD-3-Clause
"""Links made larger or smaller: padding in metres, and scale."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.errors import RobotError
from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._frames import bounding_ball
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._matrix import NEVER
from vprism_plan.robots._self_collision import touching_pairs
from vprism_plan.robots._torch_kinematics import TorchKinematics

_logger = logging.getLogger(__name__)


def padded(
    robot: Any, padding: float | Mapping[str, float], scale: float | Mapping[str, float]
) -> Any:
    """See :meth:`Robot.with_padding`."""
    names = robot.link_names
    pads = per_link(padding, 0.0, "padding", names, robot.links_of)
    scales = per_link(scale, 1.0, "scale", names, robot.links_of)
    arrays = grown(robot.arrays, scales, pads)
    larger = {name for name, factor in zip(names, scales, strict=True) if factor > 1.0}
    again = [
        pair
        for pair in robot._sampled_pairs
        if robot.disabled_pairs.get(pair) == NEVER and pair & larger
    ]
    arrays = dataclasses.replace(arrays, pairs=_with_pairs(arrays.pairs, again, names))
    geometry, meshes = dict(robot.geometry), dict(robot.meshes)
    for index, name in enumerate(names):
        T, scale = robot._links[name].T, float(scales[index])
        about = (robot.arrays.link_center[index] - T[:3, 3]) @ T[:3, :3]
        if name in geometry:
            geometry[name] = grown_solids(geometry[name], about, scale, float(pads[index]))
        if name in meshes and scale != 1.0:
            meshes[name] = tuple(file.scaled(about, scale) for file in meshes[name])
    before = touching_pairs(robot.arrays, robot.neutral, names)
    touching = touching_pairs(arrays, robot.neutral, names) - before
    if touching:
        _logger.warning("the scale makes links touch in the neutral state: %s", sorted(touching))
    return dataclasses.replace(
        robot,
        arrays=arrays,
        disabled_pairs={p: why for p, why in robot.disabled_pairs.items() if p not in again},
        geometry=geometry,
        meshes=meshes,
        _torch=TorchKinematics(arrays),
    )


def _with_pairs(
    pairs: Int[np.ndarray, "pairs 2"], again: Sequence[frozenset[str]], names: tuple[str, ...]
) -> Int[np.ndarray, "more 2"]:
    """Pairs with others added: "Never" was found for links of another size."""
    added = [sorted(names.index(name) for name in pair) for pair in again]
    both = np.vstack([pairs, np.array(added, dtype=np.int64).reshape(-1, 2)])
    return np.ascontiguousarray(both[np.lexsort((both[:, 1], both[:, 0]))])


def per_link(
    value: float | Mapping[str, float],
    default: float,
    what: str,
    link_names: tuple[str, ...],
    links_of: Callable[[str], tuple[str, ...]],
) -> Float[np.ndarray, "links"]:
    """One number per link, from one for all or from a table of links and groups.

    A link's own entry outranks that of a group; of several groups the largest value counts.

    Raises:
        RobotError: A name is unknown, or a value is not a number that `what` may have.
    """
    if not isinstance(value, Mapping):
        return np.full(len(link_names), _allowed(value, what, "all links"))
    result = np.full(len(link_names), default)
    named = np.zeros(len(link_names), dtype=bool)
    for name in sorted(value, key=lambda key: key in link_names):
        number = _allowed(value[name], what, repr(name))
        for link in links_of(name):
            index = link_names.index(link)
            together = named[index] and name not in link_names
            result[index] = max(result[index], number) if together else number
            named[index] = True
    return result


def _allowed(value: float, what: str, whose: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise RobotError(f"{what} of {whose} is {value!r}; it must be a number") from error
    if what == "padding" and not (math.isfinite(number) and number >= 0.0):
        raise RobotError(
            f"padding of {whose} is {value!r}; it must be finite metres, 0 or more (to shrink "
            "links, use a scale below 1)"
        )
    if what == "scale" and not (math.isfinite(number) and number > 0.0):
        raise RobotError(f"scale of {whose} is {value!r}; it must be finite and above 0")
    return number


def grown(
    arrays: KinematicArrays,
    scale: Float[np.ndarray, "links"],
    padding: Float[np.ndarray, "links"],
) -> KinematicArrays:
    """Scale the spheres of each link about the centre of its bounding ball, then pad them.

    What was padding before is scaled like the rest and stays padding, in self-collision up
    to its old size: the rest of what a scale above 1 makes of it counts as the link's.

    A scale above 1 gives each sphere the smallest ball that holds it and its scaled image:
    a link with an elbow does not hold itself when it is only blown up from its middle.
    """
    centers, radii = arrays.sphere_center.copy(), arrays.sphere_radius.copy()
    balls = []
    for link, (factor, pad) in enumerate(zip(scale, padding, strict=True)):
        rows = slice(int(arrays.link_start[link]), int(arrays.link_start[link + 1]))
        if factor != 1.0:
            centers[rows], radii[rows] = _scaled(
                centers[rows], radii[rows], arrays.link_center[link], float(factor)
            )
        radii[rows] += pad
        order = np.argsort(-radii[rows], kind="stable")
        centers[rows], radii[rows] = centers[rows][order], radii[rows][order]
        balls.append(bounding_ball(centers[rows], radii[rows]))
    return dataclasses.replace(
        arrays,
        sphere_center=np.ascontiguousarray(centers),
        sphere_radius=radii,
        link_center=np.array([ball[0] for ball in balls]),
        link_radius=np.array([ball[1] for ball in balls]),
        link_padding=np.minimum(scale, 1.0) * arrays.link_padding + padding,
    )


def _scaled(
    centers: Float[np.ndarray, "n 3"],
    radii: Float[np.ndarray, "n"],
    about: Float[np.ndarray, "3"],
    factor: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    arm = centers - about
    image, big = about + factor * arm, factor * radii * (1.0 + 1e-12)
    if factor <= 1.0:
        return image, big
    length = np.linalg.norm(arm, axis=1)
    # From the near end of the sphere to the far end of its image.
    both = 0.5 * (factor * length + big - length + radii)
    way = factor * length + big - both
    apart = (factor - 1.0) * length + radii > big
    scaled = np.where(apart, way / np.where(apart, length, 1.0), factor)
    return about + scaled[:, None] * arm, np.where(apart, both * (1.0 + 1e-12), big)


def grown_solids(
    solids: tuple[PrimitiveGeometry, ...],
    about: Float[np.ndarray, "3"],
    scale: float,
    padding: float,
) -> tuple[PrimitiveGeometry, ...]:
    """The solids of a link scaled about a point of its frame, then padded."""
    result = []
    for solid in solids:
        T = solid.T_link.copy()
        T[:3, 3] = about + scale * (T[:3, 3] - about)
        size = tuple(scale * edge for edge in solid.size)
        result.append(
            PrimitiveGeometry(solid.kind, size, T, padding=scale * solid.padding + padding)
        )
    return tuple(result)
