# SPDX-License-Identifier: BSD-3-Clause
"""A robot with links made larger or smaller, and with objects that it carries."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vprism_plan._arguments import number, rigid_pose, whole
from vprism_plan._shapes import Pairs, Points, Spheres, Triangles, Values, Vector
from vprism_plan.errors import RobotError
from vprism_plan.robots.geometry import read_triangles
from vprism_plan.robots.kinematics import (
    Attachment,
    KinematicArrays,
    bounding_ball,
    in_frame,
    only_links,
)
from vprism_plan.robots.pairs import NEVER, touching_pairs
from vprism_plan.robots.sphere_fit import hold_object

_logger = logging.getLogger(__name__)


def padded(
    robot: Any, padding: float | Mapping[str, float], scale: float | Mapping[str, float]
) -> Any:
    """See :meth:`Robot.with_padding`."""
    names = robot.link_names
    pads, scales = _per_link(robot, padding, 0.0, "padding"), _per_link(robot, scale, 1.0, "scale")
    arrays = grown(robot.arrays, scales, pads)
    larger = {name for name, factor in zip(names, scales, strict=True) if factor > 1.0}
    # "Never" was found for links of another size.
    again = [
        pair
        for pair in robot._sampled_pairs
        if robot.disabled_pairs.get(pair) == NEVER and pair & larger
    ]
    added = [sorted(names.index(name) for name in pair) for pair in again]
    arrays = dataclasses.replace(arrays, pairs=_with_pairs(arrays, added))
    geometry, meshes = dict(robot.geometry), dict(robot.meshes)
    for index, name in enumerate(names):
        T, factor, pad = robot.links[name].T, float(scales[index]), float(pads[index])
        about = (robot.arrays.link_center[index] - T[:3, 3]) @ T[:3, :3]
        if name in geometry:
            geometry[name] = tuple(solid.grown(about, factor, pad) for solid in geometry[name])
        if name in meshes and factor != 1.0:
            meshes[name] = tuple(file.scaled(about, factor) for file in meshes[name])
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
    )


def _with_pairs(arrays: KinematicArrays, added: Sequence[Sequence[int]]) -> Pairs:
    """The pairs that are tested, with others added; sorted."""
    both = np.vstack([arrays.pairs, np.array(added, dtype=np.int64).reshape(-1, 2)])
    return np.ascontiguousarray(both[np.lexsort((both[:, 1], both[:, 0]))])


def _per_link(robot: Any, value: Any, default: float, what: str) -> Values:
    """One number per link, from one for all or from a table of links and groups."""
    names = robot.link_names
    if not isinstance(value, Mapping):
        return np.full(len(names), _allowed(value, what, "all links"))
    found: dict[str, float] = {}
    for name in sorted(value, key=lambda key: key in names):
        given = _allowed(value[name], what, repr(name))
        for link in robot.links_of(name):
            own = name in names or link not in found
            found[link] = given if own else max(found[link], given)
    return np.array([found.get(name, default) for name in names], dtype=np.float64)


def _allowed(value: Any, what: str, whose: str) -> float:
    above = what == "scale"
    return number(f"{what} of {whose}", value, 0.0, above=above, error=RobotError)


def grown(arrays: KinematicArrays, scale: Values, padding: Values) -> KinematicArrays:
    """Scale the spheres of each link about the centre of its bounding ball, then pad them.

    What was padding is scaled like the rest and stays padding, up to its old size.
    A scale above 1 gives each sphere the smallest ball that holds it and its scaled image:
    a link with an elbow does not hold itself when it is only blown up from its middle.
    """
    centers, radii = arrays.sphere_center.copy(), arrays.sphere_radius.copy()
    balls = []
    for link, (factor, pad) in enumerate(zip(scale, padding, strict=True)):
        rows = slice(int(arrays.link_start[link]), int(arrays.link_start[link + 1]))
        if factor != 1.0:
            about = arrays.link_center[link]
            centers[rows], radii[rows] = _scaled(centers[rows], radii[rows], about, float(factor))
        radii[rows] += pad
        order = np.argsort(-radii[rows], kind="stable")
        centers[rows], radii[rows] = centers[rows][order], radii[rows][order]
        balls.append(bounding_ball(centers[rows], radii[rows]))
    return dataclasses.replace(
        arrays,
        sphere_center=np.ascontiguousarray(centers),
        sphere_radius=radii,
        link_center=np.array([center for center, _ in balls]),
        link_radius=np.array([radius for _, radius in balls]),
        link_padding=np.minimum(scale, 1.0) * arrays.link_padding + padding,
    )


def _scaled(centers: Points, radii: Values, about: Vector, factor: float) -> tuple[Points, Values]:
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


@dataclass(frozen=True, eq=False)
class Held:
    """Shape of an attached object in its own frame, metres: spheres that hold it, its mesh."""

    spheres: Spheres
    surface: Triangles | None = None

    def triangles(self) -> Triangles:
        """As of a link's `MeshFile`."""
        return np.empty((0, 3, 3)) if self.surface is None else self.surface


def attached(
    robot: Any,
    name: str,
    link: str,
    spheres: Any,
    mesh: Any,
    pose: Any,
    touch_links: Sequence[str],
    max_spheres: int,
) -> Any:
    """See :meth:`Robot.attach`."""
    what = f"attached object {name!r}"
    held = _held(what, spheres, mesh, max_spheres)
    if not isinstance(name, str) or not name or name in robot.links or name in robot.groups:
        raise RobotError(f"{what}: an object needs a name of its own, no link's or group's")
    if link not in robot.links:
        raise RobotError(f"{what}: no link {link!r}; links: {sorted(robot.links)}")
    if isinstance(touch_links, str):
        raise RobotError(f"{what}: touch_links is the string {touch_links!r}; give a sequence")
    T = rigid_pose(f"{what}: pose", np.eye(4) if pose is None else pose, error=RobotError)
    carrier = robot.links[link]
    sits = Attachment(carrier.frame, carrier.T @ T, link)
    siblings = [other for other, parent in robot.attached.items() if parent == link]
    reasons = dict.fromkeys(siblings, "Attached to the same link") | {link: "Attached"}
    for entry in touch_links:
        members = (entry,) if entry in robot.links else robot.groups.get(entry)
        for touched in robot.links_of(entry) if members is None else members:
            reasons.setdefault(touched, "Touch link")
    tested = [i for i, other in enumerate(robot.link_names) if other not in reasons]
    below = link
    while below in robot.attached:
        below = robot.attached[below]
    moves = carrier.frame > 0 or (robot.check_locked and below in robot._parts.model.moved)
    arrays = _with_link(robot.arrays, sits, held.spheres, tested, not moves)
    names = (*robot.link_names, name)
    touching = [p for p in touching_pairs(arrays, robot.neutral, names) if name in p]
    if touching:
        _logger.warning(
            "%s touches links in the neutral state: %s; if it may, name them in touch_links",
            what,
            sorted(touching),
        )
    return dataclasses.replace(
        robot,
        link_names=names,
        disabled_pairs=robot.disabled_pairs
        | {frozenset((name, other)): reason for other, reason in reasons.items()},
        arrays=arrays,
        attached=robot.attached | {name: link},
        held=robot.held | {name: held},
        links=robot.links | {name: sits},
    )


def detached(robot: Any, name: str) -> Any:
    """See :meth:`Robot.detach`."""
    if name not in robot.attached:
        raise RobotError(f"{name!r} is not attached; attached: {sorted(robot.attached)}")
    carried = [other for other, parent in robot.attached.items() if parent == name]
    if carried:
        raise RobotError(f"{name!r} carries {carried}; detach them first")
    names = tuple(link for link in robot.link_names if link != name)
    gone = robot.link_names.index(name)
    pairs = robot.arrays.pairs[(robot.arrays.pairs != gone).all(axis=1)]
    arrays = dataclasses.replace(
        only_links(robot.arrays, np.array([robot.link_names.index(link) for link in names])),
        pairs=np.ascontiguousarray(pairs - (pairs > gone)),
    )
    return dataclasses.replace(
        robot,
        link_names=names,
        disabled_pairs={p: why for p, why in robot.disabled_pairs.items() if name not in p},
        arrays=arrays,
        attached={other: link for other, link in robot.attached.items() if other != name},
        held={other: shape for other, shape in robot.held.items() if other != name},
        links={link: sits for link, sits in robot.links.items() if link != name},
    )


def _held(what: str, spheres: Any, mesh: Any, max_spheres: int) -> Held:
    if (spheres is None) == (mesh is None):
        raise RobotError(f"{what}: give either spheres or a mesh")
    if mesh is None:
        return Held(_sphere_rows(spheres, what))
    whole(f"{what}: max_spheres", max_spheres, 1, error=RobotError)
    triangles = read_triangles(mesh, what)
    return Held(hold_object(triangles, max_spheres), triangles)


def _with_link(
    arrays: KinematicArrays, sits: Attachment, rows: Spheres, tested: Sequence[int], fixed: bool
) -> KinematicArrays:
    """Add a link at the end: spheres in its own frame, to be tested against some links."""
    local, radii, center, radius = in_frame(sits, rows)
    index = len(arrays.link_frame)
    return dataclasses.replace(
        arrays,
        sphere_frame=np.append(arrays.sphere_frame, np.full(len(rows), sits.frame)),
        sphere_center=np.vstack([arrays.sphere_center, local]),
        sphere_radius=np.append(arrays.sphere_radius, radii),
        sphere_link=np.append(arrays.sphere_link, np.full(len(rows), index)),
        link_start=np.append(arrays.link_start, len(arrays.sphere_radius) + len(rows)),
        link_frame=np.append(arrays.link_frame, sits.frame),
        link_center=np.vstack([arrays.link_center, center]),
        link_radius=np.append(arrays.link_radius, radius),
        link_fixed=np.append(arrays.link_fixed, fixed),
        link_padding=np.append(arrays.link_padding, 0.0),
        link_buffer=np.append(arrays.link_buffer, 0.0),
        pairs=_with_pairs(arrays, [(other, index) for other in tested]),
    )


def _sphere_rows(spheres: object, what: str) -> Spheres:
    wanted = "give at least one row (x, y, z, radius) in metres"
    try:
        rows = np.array(spheres, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RobotError(f"{what}: spheres are no array of numbers: {error}; {wanted}") from error
    if rows.ndim != 2 or rows.shape[1] != 4 or len(rows) == 0:
        raise RobotError(f"{what}: spheres have shape {rows.shape}; {wanted}")
    bad = np.flatnonzero(~(np.isfinite(rows).all(axis=1) & (rows[:, 3] > 0.0)))
    if len(bad):
        found = f"{what}: sphere {int(bad[0])} is {rows[bad[0]].tolist()}"
        raise RobotError(f"{found}; centre and radius must be finite and the radius positive")
    return rows
