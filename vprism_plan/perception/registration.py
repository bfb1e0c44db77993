# SPDX-License-Identifier: BSD-3-Clause
"""Lay one view of a scene on another, by the surfaces that both show."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from vprism_plan._shapes import Chosen, Image, Indices, Matrix, Points, Pose, Values, Vector
from vprism_plan.perception.camera import (
    depth_sigma,
    invert_transform,
    lift,
    project,
    transform_points,
)
from vprism_plan.perception.observation import Observation

_OBJECT_SAMPLES, _OTHER_SAMPLES = 1500, 700  # pixels on smooth surfaces
_STEP, _NEEDED = 2, 13  # pixels between the 5 x 5 that make a normal, and how many of the 25
_STEEP = 1.5  # metres of depth per metre across, of a surface that has a normal
_AROUND = 7  # pixels: beside an outline, the nearest of these is what a point is in front of

_WIDE, _NARROW = (0.06, 0.01), (0.03, 0.006)  # metres: gate and kernel, at first and later
_EARLY, _STEPS = 5, 12
_SHIFT, _TURN = 0.05, np.radians(2.0)  # prior: what nothing shows stays as it was said
_FACING = 0.25  # cosine between a normal and the way to a camera that may see its surface
_CORRELATED = 5.0  # neighbours share their noise: 25 samples count as one
_NOISY = 2.0  # times the sensor's noise: mean distance of objects that are not yet one
_ELSEWHERE = 0.03  # metres


@dataclass(frozen=True, eq=False)
class Samples:
    """What one view offers for a comparison."""

    view: Observation
    pose: Pose  # of its camera, as it is posed or laid on another view
    depth: Image  # metres, 0 where nothing or the robot was seen
    nearest: Image  # least depth around each pixel, 0 where one has none
    points: Points  # of smooth surfaces, world
    normals: Points  # facing the camera
    ids: Indices  # their labels
    noise: Values  # standard deviation of their depth, metres

    def of(self, chosen: Chosen) -> "Samples":
        """Return the same with some of the samples only."""
        parts = (self.points, self.normals, self.ids, self.noise)
        points, normals, ids, noise = (part[chosen] for part in parts)
        return replace(self, points=points, normals=normals, ids=ids, noise=noise)

    def moved(self, T: Pose) -> "Samples":
        """Return the same, laid elsewhere."""
        points, normals = transform_points(T, self.points), self.normals @ T[:3, :3].T
        return replace(self, pose=T @ self.pose, points=points, normals=normals)

    @property
    def center(self) -> Vector:
        """Mean point of the objects; of everything if there are none."""
        chosen = self.points[self.ids > 0] if (self.ids > 0).any() else self.points
        return np.asarray(chosen.mean(axis=0) if len(chosen) else self.pose[:3, 3])


@dataclass(frozen=True, eq=False)
class Motion:
    """The rigid motion that lays one view on another, world frame."""

    T: Pose
    shift: Vector  # what the middle of the view's objects moves by, metres
    covariance: Matrix  # of the shift
    count: int  # pairs of samples it rests on

    @property
    def offset(self) -> float:
        """Length of the shift, metres."""
        return float(np.linalg.norm(self.shift))

    def certain(self, count: int, sigmas: float) -> bool:
        """Whether it rests on enough pairs, and is larger than its standard deviations."""
        way = self.shift / max(self.offset, 1e-12)
        deviation = np.sqrt(way @ self.covariance @ way)
        return self.count >= count and bool(self.offset > sigmas * deviation)


@dataclass(frozen=True, eq=False)
class Look:
    """What a view shows at the pixels onto which the samples of another fall."""

    surface: Points  # what the pixel shows, world
    labels: Indices  # of the pixel
    gap: Values  # how far the surface lies along the sample's normal, metres
    away: Values  # how far it lies at all; infinite without a return, or if the sample faces away
    free: Values  # how far the sample lies before the nearest return around the pixel, metres
    noise: Values  # of depth there, metres

    def same(self, gate: float) -> Chosen:
        """Which samples may be of the surface that is seen there."""
        return (np.abs(self.gap) < gate) & (self.away < 2.5 * gate)

    def in_front(self, margin: float) -> Values:
        """How far (m, along the ray) samples lie in space that was looked through, else 0."""
        return np.where(self.free > margin + 3.0 * self.noise, self.free, 0.0)


# ------------------------------------------------------------------------------------ samples
def samples_of(view: Observation) -> Samples:
    """Return evenly spread samples of a view, more of its objects than of the rest."""
    depth = np.where(view.sees_robot, 0.0, view.depth).astype(np.float64)
    inner = np.zeros(view.shape, dtype=bool)
    middle = (slice(2 * _STEP, -2 * _STEP),) * 2
    inner[middle] = depth[middle] > 0
    objects, others = (
        np.flatnonzero(inner & own)[:: max(1, int((inner & own).sum()) // count)]
        for own, count in ((view.labels > 0, _OBJECT_SAMPLES), (view.labels == 0, _OTHER_SAMPLES))
    )
    row, column = np.divmod(np.concatenate([objects, others]), view.shape[1])
    points, normals, smooth = _normals(depth, view.intrinsics, row, column)
    nearest = ndimage.minimum_filter(depth.astype(np.float32), _AROUND, mode="nearest")
    images = (depth, nearest.astype(np.float64))
    ids, noise = view.labels[row, column], depth_sigma(points[:, 2])
    samples = Samples(view, np.eye(4), *images, points, normals, ids, noise)
    return samples.of(smooth).moved(view.pose)


def _normals(
    depth: Image, intrinsics: Matrix, row: Indices, column: Indices
) -> tuple[Points, Points, Chosen]:
    """Centres and normals (camera frame) of planes through the pixels around some; which fit."""
    down, right = _STEP * (np.indices((5, 5)).reshape(2, 25) - 2)
    around = lift(depth, intrinsics, row[:, None] + down, column[:, None] + right)
    middle = depth[row, column]
    reach = _STEEP * np.hypot(down, right).max() * middle / min(intrinsics[0, 0], intrinsics[1, 1])
    used = (around[..., 2] > 0) & (np.abs(around[..., 2] - middle[:, None]) < reach[:, None])
    count = used.sum(axis=1)
    mean = (around * used[..., None]).sum(axis=1) / count[:, None]
    spread = (around - mean[:, None]) * used[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nij,nik->njk", spread, spread))
    thick = np.sqrt(values[:, 0].clip(0.0) / count)
    facing = np.einsum("ni,ni->n", vectors[:, :, 0], mean)
    normals = -vectors[:, :, 0] * np.sign(facing)[:, None]
    smooth = (count >= _NEEDED) & (thick < 3.0 * depth_sigma(middle))
    return mean, normals, smooth & (np.abs(facing) > _FACING * np.linalg.norm(mean, axis=1))


def look_up(seen: Samples, other: Samples) -> Look:
    """Look the samples of another view up in one."""
    K, points = seen.view.intrinsics, other.points
    pixels, depth = project(transform_points(invert_transform(seen.pose), points), K)
    pixels[depth <= 0.01] = -1.0
    column, row = np.rint(pixels).astype(np.int64).T
    height, width = seen.depth.shape
    hit = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    row, column = np.where(hit, row, 0), np.where(hit, column, 0)
    hit &= seen.depth[row, column] > 0
    surface = transform_points(seen.pose, lift(seen.depth, K, row, column))
    way, to_camera = surface - points, seen.pose[:3, 3] - points
    facing = np.einsum("ni,ni->n", other.normals, to_camera)
    faces = hit & (facing > _FACING * np.linalg.norm(to_camera, axis=1))
    gap = np.einsum("ni,ni->n", other.normals, way)
    away = np.where(faces, np.linalg.norm(way, axis=1), np.inf)
    nearest = np.where(hit, seen.nearest[row, column], 0.0)
    free = np.where(nearest > 0, nearest - depth, 0.0)
    return Look(surface, seen.view.labels[row, column], gap, away, free, depth_sigma(depth))


# ------------------------------------------------------------------ laying one view on another
def lay(
    moving: Samples, fixed: Samples, steps: int = _STEPS, early: int = 0, turn: float = _TURN
) -> Motion:
    """Return the motion that lays one view's surfaces on the other's.

    Point-to-plane iterated closest points (Chen and Medioni, 1992), partners by projection,
    both ways, with a robust kernel, in at most `steps` iterations, of which the `early` ones
    look farther. What the surfaces do not show stays as it is: the motion has a prior, with
    standard deviations of `turn` radians and 5 cm.
    """
    center, strayed, T = moving.center, np.zeros(6), np.eye(4)
    prior = np.diag([turn**-2.0] * 3 + [_SHIFT**-2.0] * 3)
    for step in range(steps):
        gate, kernel = _WIDE if step < early else _NARROW
        laid = moving.moved(T)
        there, back = look_up(fixed, laid), look_up(laid, fixed)
        mine, theirs = there.same(gate), back.same(gate)
        points = np.concatenate([laid.points[mine], back.surface[theirs]])
        normals = np.concatenate([laid.normals[mine], fixed.normals[theirs]])
        error = np.concatenate([there.gap[mine], -back.gap[theirs]])
        noise = np.concatenate([moving.noise[mine], fixed.noise[theirs]])
        weight = (_CORRELATED * noise * (1.0 + (error / kernel) ** 2)) ** -2.0
        rows = np.hstack([np.cross(points - center - strayed[3:], normals), normals])
        information = (rows * weight[:, None]).T @ rows + prior
        change = np.linalg.solve(information, (rows * weight[:, None]).T @ error - prior @ strayed)
        rotation = Rotation.from_rotvec(change[:3]) * Rotation.from_rotvec(strayed[:3])
        strayed = np.concatenate([rotation.as_rotvec(), strayed[3:] + change[3:]])
        T[:3, :3] = rotation.as_matrix()
        T[:3, 3] = center + strayed[3:] - T[:3, :3] @ center
        if step >= early and np.abs(change).max() < 1e-4:
            break
    return Motion(T, strayed[3:], np.linalg.inv(information)[3:, 3:], len(error))


def explained(new: Samples, known: Samples) -> Motion:
    """Return the motion of a view, or none, that leaves its objects nearest to the other's.

    Distances count, not squares, which spread the way of one object that moved over all.
    """
    still = Motion(np.eye(4), np.zeros(3), np.zeros((3, 3)), 0)
    options = [lay(new, known, early=_EARLY), still]
    left = [_disagreement(new.moved(option.T), known) for option in options]
    if len(new.noise) and min(left) > _NOISY * new.noise.mean():
        # Farther off than surfaces find each other across: begin elsewhere as well.
        for way in _ELSEWHERE * np.concatenate([np.eye(3), -np.eye(3)]):
            start = np.eye(4)
            start[:3, 3] = way
            motion = lay(new.moved(start), known)
            options.append(replace(motion, T=motion.T @ start, shift=motion.shift + way))
            left.append(_disagreement(new.moved(options[-1].T), known))
    return options[int(np.argmin(left))]


def _disagreement(new: Samples, known: Samples) -> float:
    """Mean distance between what two views show of the objects, metres, each 3 cm at most."""
    gate, distances = _NARROW[0], []
    for seen, other in ((known, new), (new, known)):
        look = look_up(seen, other)
        same, free = look.same(gate), look.in_front(0.0)
        distance = np.where(same, np.abs(look.gap), np.minimum(free, gate))
        distances.append(distance[(other.ids > 0) & (same | (free > 0))])
    shared = np.concatenate(distances)
    return float(shared.mean()) if len(shared) else 0.0
