# SPDX-License-Identifier: BSD-3-Clause
"""Whether several views show one scene: poses that fit, ids that mean the same, nothing moved.

Surfaces that two views share say how far one lies off the other, and which id of one is which
of the other. Where a view looked through free space, nothing can have stood at the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int32
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import (
    depth_sigma,
    invert_transform,
    project,
    transform_points,
)
from vprism_plan.perception.observation import Observation

# Metres at the objects by which a view may lie off the others: named beyond the first, refused
# beyond the second. A turn about its camera of up to `TOLERATED_TURN` is no fault: hands and
# eyes are calibrated no better.
NAMED_OFFSET, REFUSED_OFFSET = 0.01, 0.05
TOLERATED_TURN = np.radians(1.5)
_NEAREST_VIEWS = 3  # that a view is laid on; more say nothing new

# Samples: pixels on smooth surfaces.
_OBJECT_SAMPLES, _OTHER_SAMPLES = 1500, 700
_STEP = 2  # pixels between the 5 x 5 that make a normal
_NEEDED = 13  # of the 25
_STEEP = 1.5  # metres of depth per metre across, of a surface that has a normal
_AROUND = 7  # pixels: beside an outline, the nearest of these is what a point is in front of

# Laying one view on another.
_GATES, _KERNELS = (0.06, 0.03), (0.01, 0.006)  # metres, at first and later
_EARLY, _STEPS, _OBJECT_STEPS = 5, 12, 7
_TURN, _SHIFT = np.radians(2.0), 0.05  # prior: what nothing shows stays as it was said
_OBJECT_TURN = np.radians(0.5)
_FACING = 0.25  # cosine between a normal and the way to a camera that may see its surface
_CORRELATED = 5.0  # neighbours share their noise: 25 samples count as one
_FEWEST = 200  # pairs of samples, below which nothing is said
_SIGMAS = 4.0
_NOISY = 2.0  # times the sensor's noise: mean distance of objects that are not yet one
_ELSEWHERE = 0.03  # metres

# Ids and motions.
_SAME = 0.01  # metres between points of one surface
_VOTES, _CLEAR, _AGREES = 50, 0.7, 0.3
_APART, _BESIDE = 0.10, 0.05  # metres between what can hardly, and what may be one object
_IN_FRONT = 0.015  # metres, and three standard deviations
_MOVED, _CONTRADICTS = 0.15, 0.4  # shares of samples in what another view saw to be free
_MOST_OBJECTS = 0.7


@dataclass(frozen=True, eq=False)
class _Samples:
    """What one view offers for a comparison.

    Attributes:
        view: the observation.
        depth: (H, W) metres, 0 where nothing or the robot was seen.
        nearest: (H, W) least depth around each pixel, 0 where one has none.
        points, normals: (N, 3) of smooth surfaces, world; normals face the camera.
        ids: (N,) their labels.
    """

    view: Observation
    depth: Float[np.ndarray, "h w"]
    nearest: Float[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    ids: Int32[np.ndarray, " n"]

    def of(self, object_id: int) -> "_Samples":
        """Return the same with one object's samples only."""
        own = self.ids == object_id
        return replace(self, points=self.points[own], normals=self.normals[own], ids=self.ids[own])


@dataclass(frozen=True, eq=False)
class _Motion:
    """The rigid motion that lays one view on another.

    Attributes:
        turn: (3,) rotation vector about `center`, radians.
        shift: (3,) what `center` moves by, metres.
        center: (3,) world, m.
        covariance: (6, 6) of turn and shift.
        count: pairs of samples it rests on.
    """

    turn: Float[np.ndarray, " 3"]
    shift: Float[np.ndarray, " 3"]
    center: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]
    count: int = 0

    @classmethod
    def none(cls, center: Float[np.ndarray, " 3"]) -> "_Motion":
        """Return no motion."""
        return cls(np.zeros(3), np.zeros(3), center, np.zeros((6, 6)))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The turn as a matrix."""
        return np.asarray(Rotation.from_rotvec(self.turn).as_matrix())

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Move points of the view to where the other has them."""
        return (points - self.center) @ self.rotation.T + self.center + self.shift

    def undo(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Move points of the other view to where this one has them."""
        return (points - self.center - self.shift) @ self.rotation + self.center

    def about(self, center: Float[np.ndarray, " 3"]) -> "_Motion":
        """Return the same motion about another centre, its covariance left out."""
        shift = self.apply(center[None])[0] - center
        return _Motion(self.turn, shift, center, np.zeros((6, 6)))

    @property
    def offset(self) -> float:
        """Length of the shift, metres."""
        return float(np.linalg.norm(self.shift))

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of the offset, along itself, metres."""
        way = self.shift / max(self.offset, 1e-12)
        return float(np.sqrt(way @ self.covariance[3:, 3:] @ way))

    def at_camera(self, camera: Float[np.ndarray, " 3"]) -> float:
        """How far it moves the camera, metres: what its turn about it leaves of the offset."""
        return float(np.linalg.norm(self.shift + np.cross(self.turn, camera - self.center)))


@dataclass(frozen=True, eq=False)
class _Look:
    """What a view shows at the pixels onto which some points fall.

    Attributes:
        hit: the pixel exists and has a return.
        surface: (N, 3) the point it shows, world.
        depth: of the point itself, metres.
        nearest: least depth around the pixel, metres; 0 where unknown.
        labels: of the pixel.
    """

    hit: Bool[np.ndarray, " n"]
    surface: Float[np.ndarray, "n 3"]
    depth: Float[np.ndarray, " n"]
    nearest: Float[np.ndarray, " n"]
    labels: Int32[np.ndarray, " n"]


def agree(
    views: Sequence[Observation], earlier: Sequence[Observation] = ()
) -> tuple[Observation, ...]:
    """Return views whose ids mean the same as in those before; `warnings` name what is odd.

    Each view is compared with all before it:

    - Laid on the nearest ones by the surfaces that both show, it lies off them by more
      than `NAMED_OFFSET`, and turning its camera by `TOLERATED_TURN` does not explain it.
    - Its ids lie on surfaces of other ids. Where that is clear it gets the ids of the
      earlier views; an object that none of them knows keeps its id, or gets a free one
      where that is taken.
    - An object stands where another view looked through free space, or has shifted.

    Args:
        views: posed in one world frame, labelled.
        earlier: views that these are to agree with.

    Raises:
        ObservationError: a view lies off another by more than `REFUSED_OFFSET`, or most of
            what they show contradicts.
    """
    if len(views) + len(earlier) < 2:
        return tuple(views)
    known = [_samples(view) for view in earlier]
    result = []
    for view in views:
        samples = _compared(_samples(view), known) if known else _samples(view)
        known.append(samples)
        result.append(samples.view)
    return tuple(result)


def _compared(new: _Samples, known: Sequence[_Samples]) -> _Samples:
    """Compare a view with those before it; the numbers of views count from 1."""
    number, found = len(known) + 1, []
    distance = [np.linalg.norm(new.view.camera_center - k.view.camera_center) for k in known]
    nearest = sorted(np.argsort(distance, kind="stable")[:_NEAREST_VIEWS].tolist())
    center = _center(new)
    motions = [_Motion.none(center)] * len(known)
    offsets = []
    for index in nearest:
        names = (f"view {number}", f"view {index + 1}")
        motions[index] = motion = _explained(new, known[index], center)
        _refuse(new, known[index], motion, names)
        if _is_off(motion, new.view.camera_center):
            offsets.append((motion.offset, names))
    new, text = _renumbered(new, known, motions)
    found += [f"view {number} {text}"] if text else []
    if offsets:
        offset, (one, other) = max(offsets)
        found.append(
            f"{one} lies {1e3 * offset:.0f} mm off {other} at the objects: its T_world_camera is "
            "off, or all that both show has moved; calibrate it, or fit the views apart"
        )
    for index in nearest:
        found += _moved(new, known[index], motions[index], (f"view {number}", f"view {index + 1}"))
    fresh = [text for text in found if text not in new.view.warnings]
    if not fresh:
        return new
    view = replace(new.view, warnings=(*new.view.warnings, *fresh))
    return replace(new, view=view)


# ------------------------------------------------------------------------------------ samples
def _samples(view: Observation) -> _Samples:
    depth = np.where(view.sees_robot, 0.0, view.depth).astype(np.float64)
    inner = np.zeros(view.shape, dtype=bool)
    margin = 2 * _STEP
    inner[margin:-margin, margin:-margin] = True
    inner &= depth > 0
    chosen = []
    for pixels, count in (
        (inner & (view.labels > 0), _OBJECT_SAMPLES),
        (inner & (view.labels == 0), _OTHER_SAMPLES),
    ):
        index = np.flatnonzero(pixels)
        chosen.append(index[:: max(1, len(index) // count)])
    row, column = np.divmod(np.concatenate(chosen), view.shape[1])
    points, normals, smooth = _normals(depth, view.intrinsics, row, column)
    nearest = ndimage.minimum_filter(depth.astype(np.float32), _AROUND, mode="nearest")
    return _Samples(
        view,
        depth,
        nearest.astype(np.float64),
        transform_points(view.pose, points[smooth]),
        normals[smooth] @ view.pose[:3, :3].T,
        view.labels[row, column][smooth],
    )


def _normals(
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, "3 3"],
    row: Int[np.ndarray, " n"],
    column: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Fit planes to the pixels around some; return points, normals (camera frame), and which fit.

    A pixel at an edge has no plane within the sensor's noise.
    """
    step = _STEP * np.arange(-2, 3)
    down, right = (part.ravel() for part in np.meshgrid(step, step, indexing="ij"))
    around = _lifted(depth, intrinsics, row[:, None] + down, column[:, None] + right)
    middle = depth[row, column]
    reach = _STEEP * step[-1] * np.sqrt(2.0) * middle / min(intrinsics[0, 0], intrinsics[1, 1])
    used = (around[..., 2] > 0) & (np.abs(around[..., 2] - middle[:, None]) < reach[:, None])
    count = used.sum(axis=1)
    mean = (around * used[..., None]).sum(axis=1) / count[:, None]
    spread = (around - mean[:, None]) * used[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nij,nik->njk", spread, spread))
    thick = np.sqrt(values[:, 0].clip(0.0) / count)
    facing = np.einsum("ni,ni->n", vectors[:, :, 0], mean)
    normals = -vectors[:, :, 0] * np.sign(facing)[:, None]
    smooth = (count >= _NEEDED) & (thick < 3.0 * depth_sigma(middle))
    smooth &= np.abs(facing) > _FACING * np.linalg.norm(mean, axis=1)
    return mean, normals, smooth


def _lifted(
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, "3 3"],
    row: Int[np.ndarray, "*shape"],
    column: Int[np.ndarray, "*shape"],
) -> Float[np.ndarray, "*shape 3"]:
    """Points of some pixels, camera frame."""
    z = depth[row, column]
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0] * z
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1] * z
    return np.stack([x, y, z], axis=-1)


def _look(seen: _Samples, points: Float[np.ndarray, "n 3"]) -> _Look:
    view = seen.view
    pixels, depth = project(transform_points(invert_transform(view.pose), points), view.intrinsics)
    height, width = view.shape
    with np.errstate(invalid="ignore"):
        column, row = np.rint(pixels).T
        hit = (depth > 0.01) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    row = np.where(hit, row, 0).astype(np.int64)
    column = np.where(hit, column, 0).astype(np.int64)
    hit &= seen.depth[row, column] > 0
    surface = transform_points(view.pose, _lifted(seen.depth, view.intrinsics, row, column))
    return _Look(hit, surface, depth, seen.nearest[row, column], view.labels[row, column])


def _same_surface(
    seen: _Samples,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    gate: float,
) -> tuple[_Look, Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Look points up in a view: what it shows there, how far along their normals, and whether
    that may be the same surface: within the gate, and facing its camera."""
    look = _look(seen, points)
    way = look.surface - points
    gap = np.einsum("ni,ni->n", normals, way)
    to_camera = seen.view.camera_center - points
    facing = np.einsum("ni,ni->n", normals, to_camera)
    same = look.hit & (facing > _FACING * np.linalg.norm(to_camera, axis=1))
    same &= (np.abs(gap) < gate) & (np.linalg.norm(way, axis=1) < 2.5 * gate)
    return look, gap, same


def _center(samples: _Samples) -> Float[np.ndarray, " 3"]:
    objects = samples.points[samples.ids > 0]
    chosen = objects if len(objects) else samples.points
    return chosen.mean(axis=0) if len(chosen) else samples.view.camera_center


# ------------------------------------------------------------------ laying one view on another
def _lay(
    moving: _Samples,
    fixed: _Samples,
    center: Float[np.ndarray, " 3"],
    *,
    start: _Motion | None = None,
    steps: int = _STEPS,
    turn_prior: float = _TURN,
) -> _Motion:
    """Return the motion that lays one view's surfaces on the other's.

    Point-to-plane iterated closest points (Chen and Medioni, 1992), partners by projection,
    both ways, with a robust kernel. What the surfaces do not show stays as it is: the motion
    has a prior of two degrees and 5 cm.

    Args:
        moving: the view that is moved.
        fixed: the view that it is laid on.
        center: what the motion turns about, world, m.
        start: motion to begin with, and that the prior is about.
        steps: iterations at most.
        turn_prior: radians.
    """
    origin = _Motion.none(center) if start is None else start
    motion = origin
    prior = np.diag([turn_prior**-2.0] * 3 + [_SHIFT**-2.0] * 3)
    for step in range(steps):
        late = int(start is not None or step >= _EARLY)
        rotation = motion.rotation
        points, normals = motion.apply(moving.points), moving.normals @ rotation.T
        _, gap, same = _same_surface(fixed, points, normals, _GATES[late])
        back = motion.undo(fixed.points)
        look, gap_back, same_back = _same_surface(
            moving, back, fixed.normals @ rotation, _GATES[late]
        )
        arm = np.concatenate([points[same], motion.apply(look.surface[same_back])]) - motion.center
        normal = np.concatenate([normals[same], fixed.normals[same_back]])
        error = np.concatenate([gap[same], -gap_back[same_back]])
        depth = np.concatenate(
            [_depth(moving, moving.points[same]), _depth(fixed, fixed.points[same_back])]
        )
        weight = (_CORRELATED * depth_sigma(depth)) ** -2.0
        weight /= (1.0 + (error / _KERNELS[late]) ** 2) ** 2
        rows = np.hstack([np.cross(arm - motion.shift, normal), normal])
        information = (rows * weight[:, None]).T @ rows + prior
        strayed = np.concatenate([motion.turn - origin.turn, motion.shift - origin.shift])
        change = np.linalg.solve(information, (rows * weight[:, None]).T @ error - prior @ strayed)
        turn = Rotation.from_rotvec(change[:3]) * Rotation.from_rotvec(motion.turn)
        motion = replace(
            motion,
            turn=turn.as_rotvec(),
            shift=motion.shift + change[3:],
            covariance=np.linalg.inv(information),
            count=len(error),
        )
        if late and np.abs(change).max() < 1e-4:
            break
    return motion


def _depth(samples: _Samples, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return np.asarray((points - samples.view.camera_center) @ samples.view.pose[:3, 2])


def _explained(new: _Samples, known: _Samples, center: Float[np.ndarray, " 3"]) -> _Motion:
    """Return the motion of a view, or none, that leaves its objects nearest to the other's.

    Distances count, not their squares: if one of three objects was moved, laying the view on
    the other spreads its way over all of them.
    """
    options = [_lay(new, known, center), _Motion.none(center)]
    left = [_disagreement(new, known, option) for option in options]
    noise = float(depth_sigma(_depth(new, new.points)).mean()) if len(new.points) else 0.0
    if min(left) > _NOISY * noise:
        # Farther off than surfaces find each other across: begin elsewhere as well.
        for way in np.concatenate([np.eye(3), -np.eye(3)]):
            start = replace(options[1], shift=_ELSEWHERE * way)
            options.append(_lay(new, known, center, start=start))
            left.append(_disagreement(new, known, options[-1]))
    return options[int(np.argmin(left))]


def _disagreement(new: _Samples, known: _Samples, motion: _Motion) -> float:
    """Mean distance between what two views show of the objects, metres, each 3 cm at most."""
    limit = _GATES[1]
    distances = []
    for seen, other, points, normals in (
        (known, new, motion.apply(new.points), new.normals @ motion.rotation.T),
        (new, known, motion.undo(known.points), known.normals @ motion.rotation),
    ):
        _, gap, same = _same_surface(seen, points, normals, limit)
        free = _in_front(seen, points, 0.0)
        distance = np.where(same, np.abs(gap), np.minimum(free, limit))
        distances.append(distance[(other.ids > 0) & (same | (free > 0))])
    shared = np.concatenate(distances)
    return float(shared.mean()) if len(shared) else 0.0


def _is_off(motion: _Motion, camera: Float[np.ndarray, " 3"]) -> bool:
    """Whether a motion is there for certain, and more than a slight turn of the camera."""
    certain = motion.count >= _FEWEST and motion.offset > _SIGMAS * motion.offset_sigma
    turned = float(np.linalg.norm(motion.turn)) > TOLERATED_TURN
    return (
        certain
        and motion.offset > NAMED_OFFSET
        and (turned or motion.at_camera(camera) > NAMED_OFFSET)
    )


# --------------------------------------------------------------------------- contradictions
def _in_front(
    seen: _Samples, points: Float[np.ndarray, "n 3"], margin: float
) -> Float[np.ndarray, " n"]:
    """How far (m, along the ray) points lie in space that a view looked through, else 0."""
    look = _look(seen, points)
    free = look.nearest - look.depth
    through = look.hit & (look.nearest > 0) & (free > margin + 3.0 * depth_sigma(look.depth))
    return np.where(through, free, 0.0)


def _refuse(new: _Samples, known: _Samples, motion: _Motion, names: tuple[str, str]) -> None:
    """Raise for a view that cannot be of the same scene as another, as it is posed."""
    remedy = "check that T_world_camera is its pose, in metres, or fit the newer view alone"
    if _is_off(motion, new.view.camera_center) and motion.offset > REFUSED_OFFSET:
        raise ObservationError(
            f"{names[0]} lies {1e3 * motion.offset:.0f} mm off {names[1]} at the objects, more "
            f"than {1e3 * REFUSED_OFFSET:.0f} mm: {remedy}"
        )
    still = _Motion.none(motion.center)
    share = _contradiction(new, known, motion, REFUSED_OFFSET)
    if share <= _CONTRADICTS and _contradiction(new, known, motion, _IN_FRONT) > _CONTRADICTS:
        # The motion found does not explain it either.
        share = _contradiction(new, known, still, REFUSED_OFFSET)
    if share > _CONTRADICTS:
        raise ObservationError(
            f"{names[0]} contradicts {names[1]}: {100 * share:.0f} % of what one shows lies "
            f"{1e3 * REFUSED_OFFSET:.0f} mm and more in front of what the other saw: {remedy}"
        )


def _contradiction(new: _Samples, known: _Samples, motion: _Motion, margin: float) -> float:
    """Share of what one view shows in space that the other saw to be free.

    Of the surroundings, in the view where it is more; of objects only if nearly all of them
    contradict, in both views: one that has moved does not make the pose wrong.
    """
    rest, objects = [0.0], []
    for seen, other, points in (
        (known, new, motion.apply(new.points)),
        (new, known, motion.undo(known.points)),
    ):
        free = _in_front(seen, points, margin) > 0
        if (other.ids == 0).sum() >= _FEWEST:
            rest.append(float(free[other.ids == 0].mean()))
        ids = np.unique(other.ids[other.ids > 0])
        shares = [float(free[other.ids == i].mean()) for i in ids]
        contradict = len(ids) > 1 and np.mean(np.array(shares) > _MOVED) > _MOST_OBJECTS
        objects.append(float(free[other.ids > 0].mean()) if contradict else 0.0)
    return max(*rest, min(objects))


def _moved(new: _Samples, known: _Samples, motion: _Motion, names: tuple[str, str]) -> list[str]:
    """Name the objects that stand elsewhere in two views, or in one of them only."""
    found = []
    remedy = "it has moved between the views; fit those since then alone"
    one = _in_front(known, motion.apply(new.points), _IN_FRONT)
    other = _in_front(new, motion.undo(known.points), _IN_FRONT)
    for i in np.union1d(new.ids[new.ids > 0], known.ids[known.ids > 0]).tolist():
        best = (0.0, 0.0, names)
        for free, ids, order in ((one, new.ids, names), (other, known.ids, names[::-1])):
            own = free[ids == i]
            if len(own) >= _VOTES and (own > 0).any():
                best = max(best, (float((own > 0).mean()), float(np.median(own[own > 0])), order))
        share, far, (here, there) = best
        if share > _MOVED:
            found.append(
                f"object {i}: {100 * share:.0f} % of what {here} shows of it stands in space that "
                f"{there} saw to be free, by {1e3 * far:.0f} mm: {remedy}"
            )
            continue
        shift = _own_shift(new.of(i), known.of(i), motion)
        if shift > NAMED_OFFSET:
            found.append(
                f"object {i} lies {1e3 * shift:.0f} mm off in {names[0]} from where {names[1]} "
                f"shows it: {remedy}"
            )
    return found


def _own_shift(new: _Samples, known: _Samples, motion: _Motion) -> float:
    """How far an object has moved beside a motion of the whole view, metres; 0 if uncertain."""
    if min(len(new.points), len(known.points)) < _VOTES:
        return 0.0
    start = motion.about(_center(new))
    laid = _lay(new, known, start.center, start=start, steps=_OBJECT_STEPS, turn_prior=_OBJECT_TURN)
    own = replace(laid, shift=laid.shift - start.shift)
    certain = own.count >= _VOTES and own.offset > 1.25 * _SIGMAS * own.offset_sigma
    return own.offset if certain else 0.0


# ---------------------------------------------------------------------------------------- ids
def _renumbered(
    new: _Samples, known: Sequence[_Samples], motions: Sequence[_Motion]
) -> tuple[_Samples, str]:
    """Give a view the ids of those before it, where they clearly differ; and say so."""
    ids = np.unique(new.ids[new.ids > 0]).tolist()
    old = np.unique(np.concatenate([k.ids[k.ids > 0] for k in known])).tolist()
    votes = _shared(new, known, motions, ids, old)
    rows, columns = votes.sum(axis=1), votes[1:].sum(axis=0)
    mapping: dict[int, int] = {}
    for row, i in enumerate(ids, start=1):
        if i in old and votes[row, old.index(i) + 1] >= _AGREES * max(rows[row], 1):
            continue
        best = int(np.argmax(votes[row, 1:])) + 1 if old else 0
        clear = votes[row, best] >= max(_VOTES, _CLEAR * max(rows[row], columns[best]))
        if best and clear and old[best - 1] != i:
            mapping[i] = old[best - 1]
    if not mapping:
        return new, ""
    if any(
        _object_contradiction(new, before, motion) > _MOVED
        for before, motion in zip(known, motions, strict=True)
    ):
        said = ", ".join(f"its {i} lies where theirs shows {j}" for i, j in mapping.items())
        return new, (
            f"may number objects otherwise than the views before, or they have moved: {said}; "
            "give the same id to the same object in every view"
        )
    mapping |= _left_over(new, known, ids, old, mapping)
    table = {i: j for i, j in mapping.items() if i != j}
    labels = new.view.labels.copy()
    sample_ids = new.ids.copy()
    for i, j in table.items():
        labels[new.view.labels == i] = j
        sample_ids[new.ids == i] = j
    said = ", ".join(
        f"its {i} is {j}" if j in old else f"its {i} is new and becomes {j}"
        for i, j in table.items()
    )
    text = (
        f"numbers objects otherwise than the views before: {said}; it gets their ids, give the "
        "same id to the same object in every view"
    )
    return replace(new, view=replace(new.view, labels=labels), ids=sample_ids), text


def _object_contradiction(new: _Samples, known: _Samples, motion: _Motion) -> float:
    """Share of the objects' samples in space that the other view saw to be free."""
    one = _in_front(known, motion.apply(new.points), _IN_FRONT)[new.ids > 0]
    other = _in_front(new, motion.undo(known.points), _IN_FRONT)[known.ids > 0]
    return float((np.concatenate([one, other]) > 0).mean())


def _shared(
    new: _Samples,
    known: Sequence[_Samples],
    motions: Sequence[_Motion],
    ids: list[int],
    old: list[int],
) -> Int[np.ndarray, "i j"]:
    """Count samples on surfaces that both a view and one before it show, by their ids.

    Row and column 0 are for label 0.
    """
    votes = np.zeros((len(ids) + 1, len(old) + 1), dtype=np.int64)
    for before, motion in zip(known, motions, strict=True):
        normals = new.normals @ motion.rotation.T
        look, _, same = _same_surface(before, motion.apply(new.points), normals, _SAME)
        back, _, same_back = _same_surface(
            new, motion.undo(before.points), before.normals @ motion.rotation, _SAME
        )
        mine = np.concatenate([new.ids[same], back.labels[same_back]])
        theirs = np.concatenate([look.labels[same], before.ids[same_back]])
        row = np.where(np.isin(mine, ids), np.searchsorted(ids, mine) + 1, 0)
        column = np.where(np.isin(theirs, old), np.searchsorted(old, theirs) + 1, 0)
        np.add.at(votes, (row, column), 1)
    return votes


def _left_over(
    new: _Samples,
    known: Sequence[_Samples],
    ids: list[int],
    old: list[int],
    mapping: dict[int, int],
) -> dict[int, int]:
    """Ids for objects whose own was given to another: the old one beside them, or a free one."""
    from scipy.optimize import linear_sum_assignment

    taken = set(mapping.values())
    homeless = [i for i in ids if i not in mapping and i in taken]
    vacant = [j for j in old if j not in taken and (j not in ids or j in mapping)]
    result = {}
    if homeless and vacant:
        gaps = np.array([[_gap(new, known, i, j) for j in vacant] for i in homeless])
        for row, column in zip(*linear_sum_assignment(gaps), strict=True):
            if gaps[row, column] < _BESIDE:
                result[homeless[row]] = vacant[column]
    free = max([*ids, *old]) + 1
    for i in homeless:
        if i not in result:
            result[i] = free
            free += 1
    return result


def _gap(new: _Samples, known: Sequence[_Samples], i: int, j: int) -> float:
    """Least distance between an object of a view and one of the views before it, metres."""
    before = np.concatenate([k.points[k.ids == j] for k in known])
    distance, _ = cKDTree(before).query(new.points[new.ids == i])
    return float(np.min(distance))
