# SPDX-License-Identifier: BSD-3-Clause
"""Household-like shapes, made on the spot: what the shape prior learns from.

Surfaces of revolution (bottles, cans, bowls, cups with handles), round or squeezed, tapered and
bent superquadrics, bent tubes (bananas, hooks, handles), extruded outlines (L-shapes, rings,
plates), flat and open cartons, and unions of these. None is taken from a set that anything is
evaluated on.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator
from shapely import affinity
from shapely.geometry import Point, Polygon, box

from experiments.generation.shapes import Shape, shape_of
from experiments.generation.sources import source
from vprism_plan.errors import ConfigError

_EXTENT = (0.04, 0.26)  # metres of the largest extent; small ones are as likely as large ones
_SEGMENTS = 32
_TRIES = 50
Rng = np.random.Generator


def _profile(rng: Rng, knots: int) -> np.ndarray:
    """Return radii (m) along a height of 1, smooth between random knots."""
    at = np.linspace(0.0, 1.0, knots)
    radius = rng.uniform(0.25, 1.0, knots) ** rng.uniform(0.3, 1.0)
    return np.asarray(PchipInterpolator(at, radius)(np.linspace(0.0, 1.0, 24)))


def _revolved(rng: Rng) -> trimesh.Trimesh:
    """A can, a bottle, a vase: full, with a height of 0.5 to 4 radii."""
    steps = rng.random() < 0.3
    radius = _profile(rng, int(rng.integers(2, 6)))
    if steps:  # shoulders, lids
        radius = np.where(np.linspace(0, 1, 24) > rng.uniform(0.4, 0.9), rng.uniform(0.2, 1.0), 1.0)
    if rng.random() < 0.3:
        radius = np.ones(24)
    height = np.linspace(0.0, rng.uniform(0.5, 4.0), 24)
    line = np.stack([np.r_[0.0, radius, 0.0], np.r_[height[0], height, height[-1]]], axis=1)
    body = trimesh.creation.revolve(line, sections=_SEGMENTS)
    if rng.random() < 0.35:  # flat bottles of mustard, shampoo, detergent
        body.apply_scale([1.0, rng.uniform(0.35, 0.9), 1.0])
    return body


def _swept(rng: Rng) -> trimesh.Trimesh:
    """A tube along a bent line, thinner towards its ends: bananas, hooks, handles, straps."""
    bend = rng.uniform(0.0, 2.2)  # radians from end to end
    angles = np.linspace(-0.5, 0.5, 20) * bend
    step = np.stack([np.sin(angles), np.zeros(20), np.cos(angles)], axis=1) / 19.0
    line = np.cumsum(step, axis=0)
    thick = rng.uniform(0.05, 0.2)
    radius = thick * np.interp(np.linspace(0, 1, 20), np.linspace(0, 1, 5), rng.uniform(0.6, 1, 5))
    ends = np.sin(np.pi * np.linspace(0.04, 0.96, 20)) ** rng.uniform(0.0, 0.6)
    turn = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    across = np.stack([np.cos(angles), np.zeros(20), -np.sin(angles)], axis=1)
    side = rng.uniform(0.6, 1.4) * np.array([0.0, 1.0, 0.0])
    rings = line[:, None] + (radius * ends)[:, None, None] * (
        np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * side
    )
    vertices = np.concatenate([rings.reshape(-1, 3), line[:1], line[-1:]])
    around = (np.arange(16) + 1) % 16
    faces = []
    for k in range(19):
        a, b = 16 * k + np.arange(16), 16 * k + around
        faces += [np.stack([a, b, b + 16], axis=1), np.stack([a, b + 16, a + 16], axis=1)]
    faces.append(np.stack([np.full(16, 320), around, np.arange(16)], axis=1))
    faces.append(np.stack([np.full(16, 321), 304 + np.arange(16), 304 + around], axis=1))
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces))
    trimesh.repair.fix_normals(mesh)
    return mesh


def _hollow(rng: Rng) -> trimesh.Trimesh:
    """A bowl, a cup, a pot: open above, some with a handle."""
    wall = rng.uniform(0.06, 0.15)
    height = rng.uniform(0.4, 2.5)
    outer = np.linspace(rng.uniform(0.5, 1.0), 1.0, 16) ** rng.uniform(0.4, 1.5)
    z = np.linspace(0.0, height, 16)
    inner, inside = np.maximum(outer - wall, 0.05), np.maximum(z, wall)
    line = np.stack(
        [np.r_[0.0, outer, inner[::-1], 0.0], np.r_[0.0, z, inside[::-1], wall]], axis=1
    )
    body = trimesh.creation.revolve(line, sections=_SEGMENTS)
    if rng.random() < 0.5 and height > 0.8:
        size = 0.3 * height
        handle = trimesh.creation.torus(size, rng.uniform(0.08, 0.14), 24, 10)
        handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        keep = handle.slice_plane([0.0, 0, 0], [1.0, 0, 0], cap=True)
        keep.apply_translation([float(outer[8]) - 0.5 * wall, 0.0, 0.5 * height])
        body = trimesh.boolean.union([body, keep])
    return body


def _superquadric(rng: Rng) -> trimesh.Trimesh:
    """A rounded box, an egg, a pillow: tapered and bent."""
    ball = trimesh.creation.icosphere(3)
    v = np.asarray(ball.vertices)
    e = rng.uniform(0.15, 1.0, 2)
    polar = np.arcsin(np.clip(v[:, 2], -1, 1))
    turn = np.arctan2(v[:, 1], v[:, 0])

    def power(value: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(value) * np.abs(value) ** exponent

    flat = power(np.cos(polar), e[0])
    shape = np.stack(
        [flat * power(np.cos(turn), e[1]), flat * power(np.sin(turn), e[1]),
         power(np.sin(polar), e[0])], axis=1)  # fmt: skip
    shape *= rng.uniform(0.25, 1.0, 3)
    along = shape[:, 2] / np.abs(shape[:, 2]).max()
    shape[:, :2] *= (1.0 + rng.uniform(-0.5, 0.5) * along)[:, None]
    shape[:, 0] += rng.choice([0.0, rng.uniform(-0.4, 0.4)]) * along**2
    return trimesh.Trimesh(shape, ball.faces, process=True)


def _outline(rng: Rng) -> Polygon:
    kind = rng.choice(["box", "round", "L", "T", "ring", "star", "U"])
    a, b = rng.uniform(0.4, 1.0, 2)
    if kind == "box":
        return box(-a, -b, a, b)
    if kind == "round":
        return affinity.scale(Point(0, 0).buffer(1.0, 8), a, b)
    if kind == "ring":
        hole = affinity.scale(Point(0, 0).buffer(rng.uniform(0.3, 0.8), 8), a, b)
        return affinity.scale(Point(0, 0).buffer(1.0, 8), a, b).difference(hole)
    thick = rng.uniform(0.2, 0.45)
    if kind in {"L", "T"}:
        middle = -a if kind == "L" else -0.5 * thick
        return box(-a, -b, a, -b + thick).union(box(middle, -b, middle + thick, b))
    if kind == "U":
        inner = box(-a + thick, -b + thick, a - thick, b + 1.0)
        return box(-a, -b, a, b).difference(inner)
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 9))))
    radii = rng.uniform(0.4, 1.0, len(angles))
    return Polygon(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1))


def _extruded(rng: Rng) -> trimesh.Trimesh:
    """An outline with a height: plates, brackets, rings, boxes; corners rounded now and then."""
    outline = _outline(rng)
    if rng.random() < 0.5:
        outline = outline.buffer(-0.05).buffer(0.1).buffer(-0.05)
    if outline.geom_type != "Polygon" or outline.is_empty:
        raise ConfigError("the outline fell apart; draw another")
    return trimesh.creation.extrude_polygon(outline, rng.uniform(0.15, 2.0))


def _carton(rng: Rng) -> trimesh.Trimesh:
    """A box: closed, open above, or with a flap."""
    size = rng.uniform(0.3, 1.0, 3)
    if rng.random() < 0.4:  # crackers, gelatin, books
        size[int(rng.integers(3))] = rng.uniform(0.12, 0.35)
    body = trimesh.creation.box(size)
    kind = rng.choice(["closed", "open", "flap"], p=[0.6, 0.2, 0.2])
    if kind == "open":
        wall = max(0.06, 0.12 * float(size.max()))
        if (size[:2] < 3.0 * wall).any():
            return body
        hole = trimesh.creation.box(size - [2 * wall, 2 * wall, 0.0])
        hole.apply_translation([0.0, 0.0, wall])
        return trimesh.boolean.difference([body, hole])
    if kind == "flap":
        flap = trimesh.creation.box([0.1, size[1], rng.uniform(0.2, 0.5)])
        flap.apply_translation([0.5 * size[0] - 0.05, 0.0, 0.5 * size[2] + 0.1])
        return trimesh.boolean.union([body, flap])
    return body


def _joined(rng: Rng) -> trimesh.Trimesh:
    """Two or three of the others through each other: sprayers, tools, toys."""
    parts = []
    for _ in range(int(rng.integers(2, 4))):
        part = _SINGLE[int(rng.integers(len(_SINGLE)))](rng)
        part.apply_translation(-part.bounds.mean(axis=0))
        part.apply_scale(rng.uniform(0.4, 1.0) / part.extents.max())
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        part.apply_translation(rng.uniform(-0.3, 0.3, 3))
        parts.append(part)
    union = trimesh.boolean.union(parts)
    return max(union.split(), key=lambda piece: piece.volume)


_SINGLE: tuple[Callable[[Rng], Any], ...] = (
    _revolved, _hollow, _superquadric, _extruded, _carton, _swept,
)  # fmt: skip
_FAMILIES = (*_SINGLE, _joined)
_SHARES = (0.23, 0.1, 0.12, 0.15, 0.16, 0.09, 0.15)


class MadeShapes:
    """Draws from all families; the largest extent is 4 to 26 cm."""

    def draw(self, rng: Rng) -> Shape:
        """Return one shape, scaled, in its own frame.

        Raises:
            ConfigError: none of 50 draws was a solid at least 6 mm thick.
        """
        for _ in range(_TRIES):
            family = _FAMILIES[int(rng.choice(len(_FAMILIES), p=_SHARES))]
            try:
                mesh = family(rng)
                shape = shape_of(mesh, family.__name__.strip("_"))
            # Boolean operations and odd outlines fail now and then: another draw will not.
            except (ConfigError, ValueError):
                continue
            low, high = np.log(_EXTENT)
            middle = rng.normal(np.log(0.12), 0.4)
            factor = float(np.exp(np.clip(middle, low, high)) / shape.extents.max())
            if mesh.is_watertight and shape.extents.min() * factor >= 0.006:
                return shape.scaled(factor)
        raise ConfigError(f"none of {_TRIES} draws was a solid")


class TrainingShapes:
    """A quarter procedural objects 000 to 399, a fifth analytic solids, else `MadeShapes`."""

    def __init__(self) -> None:
        self._sources = (source("random-train"), source("analytic"), MadeShapes())

    def draw(self, rng: Rng) -> Shape:
        """Return one shape, scaled, in its own frame."""
        return self._sources[int(rng.choice(3, p=[0.25, 0.2, 0.55]))].draw(rng)
