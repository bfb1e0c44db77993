# SPDX-License-Identifier: BSD-3-Clause
"""What has changed on a table between views, and what old views are still worth then.

A view that looks through what an old one showed, or shows something where that one looked
through, speaks of another time. Objects are judged whole: one that is not where it was is taken
out of the old views, its hidden side with it, and before the place to which one has come their
rays end. What is behind that, as the newest view sees it, is hidden.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from vprism_plan._shapes import Indices, Pixels, Points, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import (
    depth_sigma,
    height_sigma,
    invert_transform,
    lift,
    project,
    transform_points,
)
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.several_views import (
    BESIDE,
    IN_FRONT,
    NAMED_OFFSET,
    SAME,
    Samples,
    lay_on,
    renamed,
    samples_of,
    shift_of,
)

_EACH, _FEWEST = 300, 20  # points of an object that are looked up; that make a contradiction
_SHARE, _MOST = 0.15, 0.5  # of its judged points: not quite, and not at all where it was
_OVERLAP, _LEAST = 0.3, 0.1  # shares, of the judged and of all, that views of one have in common
_TOUCHES = 0.02  # metres between what two views show of one object from its two sides
_SIZES, _COLOURS = np.log(2.0), 0.12  # factor, and distance of chromaticities: still one object
_AROUND = 7  # pixels: the nearest of these is what a point is in front of
_FRINGE = 4  # pixels around a mask that are frayed
_CLUTTER, _SPECK = 0.015, 50  # metres over the support surface; pixels that a mask lacks or gains
_SLACK = 0.015  # metres per metre of depth, by which unlabelled things may be off
_BEYOND = 0.8  # metres: as far as an object reaches behind its seen surface
_RAYS, _STEP = 3000, 0.005  # of a shadow at most; metres along them
_HIDDEN = 1e-3  # metres before a camera that cannot be hidden


@dataclass(frozen=True)
class Changes:
    """What an update noticed, by ids.

    Attributes:
        kept: objects that are where they were, or were not seen again.
        moved: objects that were seen elsewhere, and no longer where they were.
        left: objects whose place was seen to be empty, and that are nowhere else; or of which all
            that was seen is too old.
        came: objects that no view before had shown.
        ids: pairs of a label of the newest view as it was given, and the id that it has got.
        retired: all ids that have ever left: no other object gets them.
    """

    kept: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    left: tuple[int, ...] = ()
    came: tuple[int, ...] = ()
    ids: tuple[tuple[int, int], ...] = ()
    retired: tuple[int, ...] = ()

    @classmethod
    def between(
        cls, before: Iterable[int], retired: Iterable[int], after: Iterable[int],
        moved: Iterable[int], given: np.ndarray, got: np.ndarray,
    ) -> "Changes":  # fmt: skip
        """Return what the ids of two maps say, those of objects that moved, and the labels of the
        newest view as they were given and as they are."""
        old, new, shifted = set(before), set(after), set(moved)
        sets = (old & new) - shifted, shifted & old & new, old - new, new - old
        kept, gone, left, came = (tuple(sorted(part)) for part in sets)
        ids = [
            (int(j), int(np.bincount(own).argmax()))
            for j in np.unique(given[given > 0])
            if len(own := got[(given == j) & (got > 0)])
        ]
        return cls(kept, gone, left, came, tuple(ids), tuple(sorted({*retired, *left})))


@dataclass(frozen=True, eq=False)
class Noticed:
    """What views before a new one are worth since.

    Attributes:
        earlier: those before; where nothing has changed, the same ones.
        moved: ids of objects that stand elsewhere.
        table: labels of the new view that are to get other ids.
    """

    earlier: tuple[Observation, ...]
    moved: tuple[int, ...]
    table: dict[int, int]


# ----------------------------------------------------------------------------------- too old
def without_old(
    earlier: Sequence[Observation], now: float | None, seconds: float
) -> tuple[Observation, ...]:
    """Return the views with all that is older than `seconds` before `now` hidden: one view for
    each place of a camera.

    Raises:
        ObservationError: a view does not say when it was taken.
    """
    times = [view.time for view in earlier if view.time is not None]
    if now is None or len(times) < len(earlier):
        raise ObservationError(
            "forget needs to know when every view was taken: give Observation(time=), seconds"
        )
    if not any(
        t < now - seconds and (v.depth > 0).any() for t, v in zip(times, earlier, strict=True)
    ):
        return tuple(earlier)
    kept: list[Observation] = []
    hidden: dict[Any, Observation] = {}
    for time, view in zip(times, earlier, strict=True):
        if time >= now - seconds:
            kept.append(view)
            continue
        place = view.pose.tobytes(), view.intrinsics.tobytes(), view.shape
        clear = np.minimum(view.free_depth, _HIDDEN).astype(np.float32)
        if place in hidden:
            clear = np.maximum(clear, hidden[place].clear)
        nothing = np.zeros(view.shape, np.float32)
        hidden[place] = replace(
            view, depth=nothing, clear=clear, color=None, robot_spheres=None,
            labels=nothing.astype(np.int32),
        )  # fmt: skip
    return (*hidden.values(), *kept)


# ------------------------------------------------------------------------------------ changes
def notice(
    view: Observation, earlier: Sequence[Observation], plane: Plane, retired: Collection[int] = ()
) -> Noticed:
    """Compare a view with those before it, and take out of these what is no longer true.

    Args:
        view: labelled, posed, not yet compared with others.
        earlier: views of the map, their ids those of its objects.
        plane: support surface, world frame.
        retired: ids that no object may get.

    Raises:
        ObservationError: the view lies off the others, or most of what it shows contradicts.
    """
    known = [samples_of(before) for before in earlier]
    found = _compared(samples_of(view), known)
    pairs, moved = dict(found.pairs), set(found.moved)
    pairs |= found.from_another_side(pairs)
    elsewhere = _alike(view, earlier, found.unmatched(pairs), found.vacated(pairs))
    gone = moved | found.vacated(pairs)
    moved |= set(elsewhere.values())
    pairs |= elsewhere
    news = sorted(found.unmatched(pairs))
    taken = {*(i for before in earlier for i in before.object_ids), *retired}
    fresh = max([0, *taken, *found.new]) + 1
    for j in news:
        pairs[j], fresh = (fresh, fresh + 1) if j in taken else (j, fresh)
    stand = {j for j, k in pairs.items() if k in moved or (j in news and found.arrived(j))}
    arrived = np.isin(view.labels, sorted(stand)) & (view.depth > 0)
    for before in earlier:
        arrived |= _strange(view, before, plane)
    edited = tuple(_without(before, gone, view, plane) for before in earlier)
    if arrived.any():
        shadow, spacing = _shadow(view, arrived, plane)
        edited = tuple(_cut(before, shadow, spacing) for before in edited)
    table = {j: k for j, k in pairs.items() if j != k}
    return Noticed(edited, tuple(sorted(moved)), table)


def numbered(view: Observation, table: dict[int, int], earlier: int) -> Observation:
    """Return a view with other ids, which its warnings name; `earlier` came before."""
    if not table:
        return view
    said = ", ".join(f"its {j} is {k}" for j, k in sorted(table.items()))
    text = (
        f"view {earlier + 1} numbers objects otherwise than the views before: {said}; it gets "
        "these ids, give the same id to the same object in every view"
    )
    return replace(view, labels=renamed(view.labels, table), warnings=(*view.warnings, text))


def _compared(new: Samples, known: Sequence[Samples]) -> "_Comparison":
    """Compare a view with those before, as it is posed; or as laid on them, if that leaves fewer
    objects that have changed: then its pose is off."""
    as_posed = _Comparison([new] * len(known), known)
    if not as_posed.contradicted:
        return as_posed
    # Where objects are that were there before, the pose is right, whatever fits better.
    steady = len(as_posed.pairs) - len(as_posed.moved)
    if steady > len(as_posed.moved):
        return as_posed
    laid, nearest, _ = lay_on(new, known, fixed=True, refuse=steady == 0)
    if all(samples is new for samples in laid):
        return as_posed
    as_laid = _Comparison([laid[n] for n in nearest], [known[n] for n in nearest])
    return min(as_posed, as_laid, key=lambda found: found.contradicted)


class _Comparison:
    """Samples of a view, laid on each of those before it, and what they say of each other.

    Attributes:
        new, old: labels of the view, ids of those before.
        pairs: labels whose surfaces lie where those before show one id's, and that id.
        moved: ids of pairs that are not quite where they were.
        contradicted: how many objects are not where they were.
    """

    def __init__(self, laid: Sequence[Samples], known: Sequence[Samples]) -> None:
        self._laid, self._known = laid, known
        self.new = tuple(laid[0].view.object_ids)
        self.old = tuple(sorted({i for before in known for i in before.view.object_ids}))
        # Rows are the new labels, columns the old ids.
        self._votes = np.zeros((len(self.new), len(self.old)))
        self._through, self._arrived = np.zeros(len(self.old)), np.zeros(len(self.new))
        self._points, self._numbers = mine, numbers = _labelled(laid[0].view)
        self._shown = [_labelled(before.view) for before in known]
        theirs = np.zeros(len(self.old))
        for new, before, (points, ids) in zip(laid, known, self._shown, strict=True):
            T = new.pose @ invert_transform(new.view.pose)
            there = _Pixels(before.view, transform_points(T, mine))
            back = _Pixels(new.view, transform_points(invert_transform(T), points))
            self._arrived += self._count(numbers[there.free], self.new)
            self._through += self._count(ids[back.free], self.old)
            theirs += self._count(ids, self.old)
            label = np.concatenate([numbers[there.same], back.labels[back.same]])
            owner = np.concatenate([there.labels[there.same], ids[back.same]])
            for row, j in enumerate(self.new):
                self._votes[row] += self._count(owner[label == j], self.old)
        fewer = np.minimum(self._count(numbers, self.new)[:, None], theirs[None])
        self._enough = np.maximum(_FEWEST, np.maximum(_LEAST * fewer, _OVERLAP * self._judged()))
        self.pairs = self._where_they_were()
        self.moved = {k for j, k in self.pairs.items() if self._disturbed(j, k)}
        news = sum(self.arrived(j) for j in self.unmatched(self.pairs))
        self.contradicted = len(self.moved) + max(len(self.vacated(self.pairs)), news)

    @staticmethod
    def _count(ids: Indices, names: tuple[int, ...]) -> np.ndarray:
        return np.array([(ids == i).sum() for i in names], dtype=float)

    def _judged(self) -> np.ndarray:
        """Samples that say whether two are one: of what is known of either, the fewer."""
        mine = self._votes.sum(axis=1) + self._arrived
        theirs = self._votes.sum(axis=0) + self._through
        return np.minimum(mine[:, None], theirs[None])

    def _where_they_were(self) -> dict[int, int]:
        rows, columns = linear_sum_assignment(-self._votes)
        return {
            self.new[row]: self.old[column]
            for row, column in zip(rows, columns, strict=True)
            if self._votes[row, column] >= self._enough[row, column]
        }

    def unmatched(self, pairs: dict[int, int]) -> set[int]:
        """Labels that have no id yet."""
        return set(self.new) - set(pairs)

    def vacated(self, pairs: dict[int, int]) -> set[int]:
        """Ids that no label has, and through most of which the new view looks."""
        seen = self._votes.sum(axis=0) + self._through
        empty = self._through >= np.maximum(_FEWEST, _MOST * seen)
        return {k for k, gone in zip(self.old, empty, strict=True) if gone} - set(pairs.values())

    def arrived(self, j: int) -> bool:
        """Whether a label stands in what an old view saw to be free."""
        row = self.new.index(j)
        count = self._arrived[row]
        return bool(count >= max(_FEWEST, _SHARE * (count + self._votes[row].sum())))

    def _disturbed(self, j: int, k: int) -> bool:
        """Whether an object that overlaps with what it was is not quite where it was."""
        column = self.old.index(k)
        count = self._through[column]
        gone = count >= max(_FEWEST, _SHARE * (count + self._votes[:, column].sum()))
        return (
            bool(gone)
            or self.arrived(j)
            or any(
                shift_of(new.of(new.ids == j), before.of(before.ids == k)) > NAMED_OFFSET
                for new, before in zip(self._laid, self._known, strict=True)
            )
        )

    def from_another_side(self, pairs: dict[int, int]) -> dict[int, int]:
        """Labels without an id, and ids without a label, that lie side by side: one object of which
        two views show nothing in common. The same number may lie a little farther off."""
        mine = [j for j in sorted(self.unmatched(pairs)) if not self.arrived(j)]
        theirs = sorted(set(self.old) - set(pairs.values()) - self.vacated(pairs))
        cost = np.full((len(mine), len(theirs)), 1.0)
        for column, k in enumerate(theirs):
            tree = cKDTree(np.concatenate([p[ids == k] for p, ids in self._shown]))
            for row, j in enumerate(mine):
                gap = float(np.min(tree.query(self._points[self._numbers == j])[0]))
                if gap < (BESIDE if j == k else _TOUCHES):
                    cost[row, column] = gap - BESIDE * (j == k)
        found = zip(*linear_sum_assignment(cost), strict=True)
        return {mine[row]: theirs[column] for row, column in found if cost[row, column] < 1.0}


def _labelled(view: Observation) -> tuple[Points, Indices]:
    """Return points (m) of every object, at most some hundred of each, and their ids."""
    labels = np.where(view.depth > 0, view.labels, 0)
    inner = ndimage.minimum_filter(labels, 3) == ndimage.maximum_filter(labels, 3)
    chosen = [np.zeros(0, np.int64)]
    for k in view.object_ids:
        own = np.flatnonzero((labels == k) & inner)  # flying pixels are at the edge
        own = own if len(own) >= 2 * _FEWEST else np.flatnonzero(labels == k)
        chosen.append(own[:: 1 + len(own) // _EACH])
    row, column = np.divmod(np.concatenate(chosen), view.shape[1])
    points = lift(view.depth, view.intrinsics, row, column)
    return transform_points(view.pose, points), view.labels[row, column]


class _Pixels:
    """What a view shows at the pixels onto which some points (m) fall.

    Attributes:
        labels: of the pixels.
        same: whether the point is of the surface that is seen there.
        free: whether all that is seen around lies clearly behind the point, by at least so many
            metres for each metre of depth as `slack` says.
    """

    def __init__(self, view: Observation, points: Points, slack: float = 0.0) -> None:
        local = transform_points(invert_transform(view.pose), points)
        pixels, z = project(local, view.intrinsics)
        pixels[z <= _HIDDEN] = -1.0
        column, row = np.rint(pixels).astype(np.int64).T
        height, width = view.shape
        hit = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = np.where(hit, row, 0), np.where(hit, column, 0)
        shown = np.where(view.sees_robot, 0.0, view.free_depth).astype(np.float32)
        nearest = ndimage.minimum_filter(shown, _AROUND, mode="nearest")[row, column]
        noise = 3.0 * depth_sigma(z)
        self.labels = np.where(hit, view.labels[row, column], 0)
        away = np.linalg.norm(lift(view.depth, view.intrinsics, row, column) - local, axis=1)
        self.same = hit & (view.depth[row, column] > 0) & (away < SAME + noise)
        self.free = hit & (nearest - z > IN_FRONT + slack * z + noise)


def _alike(
    view: Observation, earlier: Sequence[Observation], labels: set[int], ids: set[int]
) -> dict[int, int]:
    """Labels that look like an object which is not where it was, by size and colour."""
    if not labels or not ids:
        return {}
    mine, theirs = sorted(labels), sorted(ids)
    looks = [_look([view], j) for j in mine], [_look(earlier, k) for k in theirs]
    cost = np.full((len(mine), len(theirs)), 1e3)
    for row, (size, colour) in enumerate(looks[0]):
        for column, (other, other_colour) in enumerate(looks[1]):
            sizes = abs(np.log(size / other)) / _SIZES
            apart = np.nan_to_num(np.linalg.norm(colour - other_colour)) / _COLOURS
            if max(sizes, apart) < 1.0:
                cost[row, column] = sizes + apart - 0.1 * (mine[row] == theirs[column])
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    return {mine[row]: theirs[column] for row, column in pairs if cost[row, column] < 1e3}


def _look(views: Sequence[Observation], label: int) -> tuple[float, Vector]:
    """Size (m) and chromaticity of an object where most of it is seen; NaN without colour."""
    best = max(views, key=lambda view: int(((view.labels == label) & (view.depth > 0)).sum()))
    own = (best.labels == label) & (best.depth > 0)
    points = best.point_image()[own]
    low, high = np.quantile(points, [0.03, 0.97], axis=0)
    colour = np.full(3, np.nan)
    if best.color is not None:
        mean = best.color[own].mean(axis=0)
        colour = mean / max(float(mean.sum()), 1.0)
    return max(float(np.linalg.norm(high - low)), 1e-3), colour


# -------------------------------------------------------------------------- what views are worth
def _without(before: Observation, gone: set[int], view: Observation, plane: Plane) -> Observation:
    """Return an old view without the surfaces of some ids, and of unlabelled things that a new one
    looks through; their rays stay free up to shortly before them."""
    taken = np.isin(before.labels, sorted(gone)) | _strange(before, view, plane)
    taken |= ndimage.binary_dilation(taken, iterations=_FRINGE) & _clutter(before, plane)
    if not taken.any():
        return before
    clear = before.free_depth.copy()
    clear[taken] = np.maximum(clear[taken] - IN_FRONT, _HIDDEN) * (clear[taken] > 0)
    return replace(
        before, clear=clear, depth=np.where(taken, 0, before.depth),
        labels=np.where(taken, 0, before.labels),
    )  # fmt: skip


def _points(view: Observation, pixels: Pixels) -> Points:
    """Points (m, world) of some pixels."""
    return transform_points(view.pose, lift(view.depth, view.intrinsics, *np.nonzero(pixels)))


def _clutter(view: Observation, plane: Plane) -> Pixels:
    """Pixels of unlabelled things on the support surface."""
    found = (view.labels == 0) & (view.depth > 0) & ~view.sees_robot
    points, depth = _points(view, found), view.depth[found]
    sigma = height_sigma(points - view.camera_center, depth, plane.normal)
    found[found] = plane.signed_distance(points) > np.maximum(_CLUTTER, 4.0 * sigma)
    return found


def _strange(view: Observation, other: Observation, plane: Plane) -> Pixels:
    """Pixels of unlabelled things that stand in what another view saw to be free."""
    found = _clutter(view, plane)
    points = _points(view, found)
    found[found] = _Pixels(other, points, _SLACK).free
    found = ndimage.binary_opening(found, np.ones((3, 3), dtype=bool))
    regions, count = ndimage.label(found)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    return np.asarray(found & (sizes >= _SPECK)[regions])


def _shadow(view: Observation, mask: Pixels, plane: Plane) -> tuple[Points, float]:
    """Points (m) of all that is behind some pixels, down to the support surface, and how far from
    the nearest of them anything else there is."""
    border = [max(8, n // 8) for n in view.shape]
    depth = np.where(mask, view.depth, np.inf)
    # Frayed outlines, and what the image's border cuts off.
    depth = np.pad(depth, [(n, n) for n in border], mode="edge")
    depth = ndimage.minimum_filter(depth, 2 * _FRINGE + 1)
    stride = int(np.ceil(np.sqrt(max(1.0, np.isfinite(depth).sum() / _RAYS))))
    row, column = np.nonzero(np.isfinite(depth[::stride, ::stride]))
    row, column = stride * row, stride * column
    start = depth[row, column] - IN_FRONT
    K = view.intrinsics
    rays = np.column_stack([
        (column - border[1] - K[0, 2]) / K[0, 0], (row - border[0] - K[1, 2]) / K[1, 1],
        np.ones(len(row)),
    ]) @ view.pose[:3, :3].T  # fmt: skip
    sinking = -(rays @ plane.normal)
    height = float(plane.signed_distance(view.camera_center))
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(sinking > 0.0, (height + 0.01) / sinking, np.inf)
    end = np.minimum(start + _BEYOND, np.maximum(floor, start))
    step = max(_STEP, stride * float(end.max(initial=0.0)) / float(min(K[0, 0], K[1, 1])))
    count = np.ceil((end - start) / step).astype(np.int64) + 1
    owner = np.repeat(np.arange(len(count)), count)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    depths = np.minimum(start[owner] + step * index, end[owner])
    longest = float(np.linalg.norm(rays, axis=1).max(initial=1.0))
    return view.camera_center + depths[:, None] * rays[owner], step * longest


def _cut(before: Observation, shadow: Points, spacing: float) -> Observation:
    """Return an old view whose rays are free only up to a shadow, or shortly before it."""
    local = transform_points(invert_transform(before.pose), shadow)
    local = local[local[:, 2] > _HIDDEN]
    if not len(local):
        return before
    pixels, z = project(local, before.intrinsics)
    height, width = before.shape
    focal = float(max(before.intrinsics[0, 0], before.intrinsics[1, 1]))
    near = float(np.quantile(z, 0.001))
    block = int(np.clip(np.ceil(1.5 * focal * spacing / near), 2, 64))
    shape = (-(-height // block) + 2, -(-width // block) + 2)
    at = np.floor(pixels[:, ::-1] / block).astype(np.int64) + 1
    inside = ((at >= 0) & (at < shape)).all(axis=1)
    first = np.full(shape, np.inf)
    np.minimum.at(first, tuple(at[inside].T), z[inside] - spacing - IN_FRONT)
    first = ndimage.minimum_filter(first, 3)[1:-1, 1:-1]
    first = np.repeat(np.repeat(first, block, axis=0), block, axis=1)[:height, :width]
    free = before.free_depth
    clear = np.where(free > 0, np.minimum(free, np.maximum(first, _HIDDEN)), 0.0)
    clear = clear.astype(before.depth.dtype)
    return before if (clear == free).all() else replace(before, clear=clear)
