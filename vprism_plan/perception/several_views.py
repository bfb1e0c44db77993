# SPDX-License-Identifier: BSD-3-Clause
"""Whether several views show one scene: poses that fit, ids that mean the same, nothing moved.

Surfaces that two views share say how far one lies off the other, and which id of one is which
of the other. Where a view looked through free space, nothing can have stood at the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vprism_plan._shapes import Chosen, Image, Indices, Matrix, Points, Pose, Values, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import (
    depth_sigma,
    invert_transform,
    lift,
    project,
    transform_points,
)
from vprism_plan.perception.observation import Observation

# Metres at the objects by which a view may lie off the others: named beyond the first, refused
# beyond the second. Hands and eyes are calibrated to a slight turn, which is no fault.
NAMED_OFFSET, REFUSED_OFFSET = 0.01, 0.05
TOLERATED_TURN = np.radians(1.5)
_NEAREST_VIEWS = 3  # that a view is laid on; more say nothing new
_FEWEST, _SIGMAS = 200, 4.0  # pairs of samples, below which nothing is said

SAME = 0.01  # metres between points of one surface
_VOTES, _CLEAR, _AGREES = 50, 0.7, 0.3
BESIDE = 0.05  # metres between what may be one object
IN_FRONT = 0.015  # metres, and three standard deviations
_MOVED, _CONTRADICTS = 0.15, 0.4  # shares of samples in what another view saw to be free
_MOST_OBJECTS = 0.7
_OBJECT_STEPS, _OBJECT_TURN = 7, np.radians(0.5)
_BETTER = 0.6  # share of the distance between an object's surfaces that a shift leaves
_STILL = 1e-3  # of a pose's elements: a camera that has not moved

# Laying one view on another.
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


def agree(
    views: Sequence[Observation], earlier: Sequence[Observation] = ()
) -> tuple[Observation, ...]:
    """Return views whose ids mean the same as in those before; `warnings` name what is odd.

    Named is where a view, laid on the nearest ones before it by the surfaces that both show,
    lies off them by more than `NAMED_OFFSET` (a turn by `TOLERATED_TURN` apart), and where an
    object stands where another view looked through free space, or has shifted. Ids that clearly
    lie on surfaces of other ids become these; an object that no view before knows keeps its id,
    or gets a free one where that is taken.

    Args:
        views: posed in one world frame, labelled.
        earlier: views that these are to agree with.

    Raises:
        ObservationError: a view lies off another by more than `REFUSED_OFFSET`, or most of
            what they show contradicts.
    """
    if len(views) + len(earlier) < 2:
        return tuple(views)
    known = [samples_of(view) for view in earlier]
    for view in views:
        samples = samples_of(view)
        known.append(_compared(samples, known) if known else samples)
    return tuple(samples.view for samples in known[len(earlier) :])


def _compared(new: Samples, known: Sequence[Samples]) -> Samples:
    """Compare a view with those before it; the numbers of views count from 1."""
    name, found = f"view {len(known) + 1}", []
    laid, nearest, offsets = lay_on(new, known)
    table, text = _other_ids(laid, known)
    found += [f"{name} {text}"] if text else []
    if table:
        labels, ids = renamed(new.view.labels, table), renamed(new.ids, table)
        new = replace(new, view=replace(new.view, labels=labels), ids=ids)
        laid = [replace(samples, ids=ids) for samples in laid]
    if offsets:
        offset, other = max(offsets)
        found.append(
            f"{name} lies {1e3 * offset:.0f} mm off view {other} at the objects: its "
            "T_world_camera is off, or all that both show has moved; calibrate it, or fit the "
            "views apart"
        )
    for index in nearest:
        found += _moved(laid[index], known[index], (name, f"view {index + 1}"))
    said = tuple(dict.fromkeys([*new.view.warnings, *found]))
    return replace(new, view=replace(new.view, warnings=said)) if found else new


def lay_on(
    new: Samples, known: Sequence[Samples], fixed: bool = False, refuse: bool = True
) -> tuple[list[Samples], list[int], list[tuple[float, int]]]:
    """Return a view as laid on each of those before it; the nearest ones, on which it was; and
    how far (m) it lies off which of them. If `fixed`, a camera that has not moved is not off;
    without `refuse`, nothing is.

    Raises:
        ObservationError: see `agree`.
    """
    name = f"view {len(known) + 1}"
    distance = [np.linalg.norm(new.pose[:3, 3] - k.pose[:3, 3]) for k in known]
    nearest = sorted(np.argsort(distance, kind="stable")[:_NEAREST_VIEWS].tolist())
    laid, offsets = [new] * len(known), []
    for index in nearest:
        if fixed and np.abs(new.pose - known[index].pose).max() < _STILL:
            continue
        motion = explained(new, known[index])
        laid[index] = new.moved(motion.T)
        off = _is_off(motion, new.pose[:3, 3])
        if refuse:
            offset = motion.offset if off else 0.0
            _refuse(new, laid[index], known[index], offset, (name, index + 1))
        if off:
            offsets.append((motion.offset, index + 1))
    return laid, nearest, offsets


def _is_off(motion: Motion, camera: Vector) -> bool:
    """Whether it is there for certain, and more than a slight turn of the camera."""
    if motion.offset <= NAMED_OFFSET or not motion.certain(_FEWEST, _SIGMAS):
        return False
    at_camera = np.linalg.norm(transform_points(motion.T, camera) - camera)
    turn = Rotation.from_matrix(motion.T[:3, :3]).magnitude()
    return bool(turn > TOLERATED_TURN or at_camera > NAMED_OFFSET)


# --------------------------------------------------------------------------- contradictions
def _in_free_space(
    new: Samples, known: Samples, margin: float
) -> tuple[tuple[Indices, Values], ...]:
    """Ids of the samples of either view, and how far they lie in what the other saw free."""
    pairs = ((known, new), (new, known))
    return tuple((other.ids, look_up(seen, other).in_front(margin)) for seen, other in pairs)


def _refuse(
    new: Samples, laid: Samples, known: Samples, offset: float, names: tuple[str, int]
) -> None:
    """Raise for a view that cannot be of the same scene as another, as it is posed."""
    remedy = "check that T_world_camera is its pose, in metres, or fit the newer view alone"
    if offset > REFUSED_OFFSET:
        raise ObservationError(
            f"{names[0]} lies {1e3 * offset:.0f} mm off view {names[1]} at the objects, more "
            f"than {1e3 * REFUSED_OFFSET:.0f} mm: {remedy}"
        )
    share = _contradiction(laid, known, REFUSED_OFFSET)
    if share <= _CONTRADICTS and _contradiction(laid, known, IN_FRONT) > _CONTRADICTS:
        # The motion found does not explain it either.
        share = _contradiction(new, known, REFUSED_OFFSET)
    if share > _CONTRADICTS:
        raise ObservationError(
            f"{names[0]} contradicts view {names[1]}: {100 * share:.0f} % of what one shows lies "
            f"{1e3 * REFUSED_OFFSET:.0f} mm and more in front of what the other saw: {remedy}"
        )


def _contradiction(new: Samples, known: Samples, margin: float) -> float:
    """Share of what one view shows in space that the other saw to be free; of objects if in both.

    And if nearly all of them contradict: one that has moved does not make the pose wrong.
    """
    rest, objects = [0.0], []
    for ids, far in _in_free_space(new, known, margin):
        if (ids == 0).sum() >= _FEWEST:
            rest.append(float((far > 0)[ids == 0].mean()))
        shares = np.array([(far > 0)[ids == i].mean() for i in np.unique(ids[ids > 0])])
        contradict = len(shares) > 1 and (shares > _MOVED).mean() > _MOST_OBJECTS
        objects.append(float((far > 0)[ids > 0].mean()) if contradict else 0.0)
    return max(*rest, min(objects))


def _moved(new: Samples, known: Samples, names: tuple[str, str]) -> list[str]:
    """Name the objects that stand elsewhere in two views, or in one of them only."""
    found = []
    remedy = "it has moved between the views; fit those since then alone, or update a map with them"
    free = _in_free_space(new, known, IN_FRONT)
    for i in np.union1d(new.ids[new.ids > 0], known.ids[known.ids > 0]).tolist():
        best = (0.0, 0.0, names)
        for (ids, ahead), order in zip(free, (names, names[::-1]), strict=True):
            own = ahead[ids == i]
            if len(own) >= _VOTES and (own > 0).any():
                best = max(best, (float((own > 0).mean()), float(np.median(own[own > 0])), order))
        share, far, (here, there) = best
        if share > _MOVED:
            found.append(
                f"object {i}: {100 * share:.0f} % of what {here} shows of it stands in space that "
                f"{there} saw to be free, by {1e3 * far:.0f} mm: {remedy}"
            )
            continue
        offset = shift_of(new.of(new.ids == i), known.of(known.ids == i))
        if offset > NAMED_OFFSET:
            found.append(
                f"object {i} lies {1e3 * offset:.0f} mm off in {names[0]} from where "
                f"{names[1]} shows it: {remedy}"
            )
    return found


def shift_of(one: Samples, other: Samples) -> float:
    """Return how far (m) one object lies, for certain, beside where another view shows it."""
    if min(len(one.points), len(other.points)) < _VOTES:
        return 0.0
    motion = lay(one, other, _OBJECT_STEPS, turn=_OBJECT_TURN)  # beside the whole view's
    if not motion.certain(_VOTES, 1.25 * _SIGMAS):
        return 0.0
    # What two sides of an object have in common may leave it free to slide.
    left = _disagreement(one.moved(motion.T), other)
    return motion.offset if left < _BETTER * _disagreement(one, other) else 0.0


# ---------------------------------------------------------------------------------------- ids
def _other_ids(laid: Sequence[Samples], known: Sequence[Samples]) -> tuple[dict[int, int], str]:
    """Ids of a view (as laid on each before) for which those clearly have others; what to say."""
    ids = np.unique(laid[0].ids[laid[0].ids > 0]).tolist()
    points, owner = (np.concatenate([getattr(k, n) for k in known]) for n in ("points", "ids"))
    old = np.unique(owner[owner > 0]).tolist()
    mine, theirs = _shared(laid, known)
    table: dict[int, int] = {}
    for i in ids:
        on = theirs[mine == i]
        if i in old and (on == i).sum() >= _AGREES * max(len(on), 1):
            continue
        values, counts = np.unique(on[np.isin(on, old)], return_counts=True)
        if len(values) and values[np.argmax(counts)] != i:
            best = int(values[np.argmax(counts)])
            shown = int(((theirs == best) & np.isin(mine, ids)).sum())
            if counts.max() >= max(_VOTES, _CLEAR * max(len(on), shown)):
                table[i] = best
    if not table:
        return {}, ""
    for new, before in zip(laid, known, strict=True):
        far = np.concatenate([f[i > 0] for i, f in _in_free_space(new, before, IN_FRONT)])
        if (far > 0).mean() > _MOVED:
            said = ", ".join(f"its {i} lies where theirs shows {j}" for i, j in table.items())
            return {}, (
                f"may number objects otherwise than the views before, or they have moved: {said}; "
                "give the same id to the same object in every view"
            )
    taken = set(table.values())
    vacant = [j for j in old if j not in taken and (j not in ids or j in table)]
    for i in [i for i in ids if i not in table and i in taken]:
        # Its own was given to another: it gets the old one beside it, or a free one.
        tree = cKDTree(laid[0].points[laid[0].ids == i])
        gaps = {j: float(np.min(tree.query(points[owner == j])[0])) for j in vacant}
        near = min(gaps, key=gaps.__getitem__, default=0)
        if near and gaps[near] < BESIDE:
            vacant.remove(near)
            table[i] = near
        else:
            table[i] = max(*ids, *old, *table.values()) + 1
    table = {i: j for i, j in table.items() if i != j}
    said = ", ".join(
        f"its {i} is {j}" if j in old else f"its {i} is new and becomes {j}"
        for i, j in table.items()
    )
    return table, (
        f"numbers objects otherwise than the views before: {said}; it gets their ids, give the "
        "same id to the same object in every view"
    )


def _shared(laid: Sequence[Samples], known: Sequence[Samples]) -> tuple[Indices, Indices]:
    """Labels that a view and those before it give to samples of surfaces that both show."""
    mine, theirs = [], []
    for new, before in zip(laid, known, strict=True):
        there, back = look_up(before, new), look_up(new, before)
        same, same_back = there.same(SAME), back.same(SAME)
        mine += [new.ids[same], back.labels[same_back]]
        theirs += [there.labels[same], before.ids[same_back]]
    return np.concatenate(mine), np.concatenate(theirs)


def renamed(ids: np.ndarray, table: dict[int, int]) -> np.ndarray:
    """Return ids or labels with others in their place."""
    result = ids.copy()
    for i, j in table.items():
        result[ids == i] = j
    return result


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
    free = np.where(view.sees_robot, 0.0, view.free_depth).astype(np.float32)
    nearest = ndimage.minimum_filter(free, _AROUND, mode="nearest")
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
