# SPDX-License-Identifier: BSD-3-Clause
"""Whether several views show one scene: poses that fit, ids that mean the same, nothing moved.

Surfaces that two views share say how far one lies off the other, and which id of one is which
of the other. Where a view looked through free space, nothing can have stood at the time.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vprism_plan._shapes import Values, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import transform_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.registration import Motion, Samples, explained, lay, look_up, samples_of

# Metres at the objects by which a view may lie off the others: named beyond the first, refused
# beyond the second. A slight turn about its camera is no fault: hands and eyes are calibrated
# no better.
NAMED_OFFSET, REFUSED_OFFSET = 0.01, 0.05
TOLERATED_TURN = np.radians(1.5)
_NEAREST_VIEWS = 3  # that a view is laid on; more say nothing new
_FEWEST, _SIGMAS = 200, 4.0  # pairs of samples, below which nothing is said

_SAME = 0.01  # metres between points of one surface
_VOTES, _CLEAR, _AGREES = 50, 0.7, 0.3
_BESIDE = 0.05  # metres between what may be one object
_IN_FRONT = 0.015  # metres, and three standard deviations
_MOVED, _CONTRADICTS = 0.15, 0.4  # shares of samples in what another view saw to be free
_MOST_OBJECTS = 0.7
_OBJECT_STEPS, _OBJECT_TURN = 7, np.radians(0.5)


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
    distance = [np.linalg.norm(new.pose[:3, 3] - k.pose[:3, 3]) for k in known]
    nearest = sorted(np.argsort(distance, kind="stable")[:_NEAREST_VIEWS].tolist())
    laid, offsets = [new] * len(known), []
    for index in nearest:
        motion = explained(new, known[index])
        laid[index] = new.moved(motion.T)
        off = _is_off(motion, new.pose[:3, 3])
        _refuse(new, laid[index], known[index], motion.offset if off else 0.0, (name, index + 1))
        if off:
            offsets.append((motion.offset, index + 1))
    table, text = _other_ids(laid, known)
    found += [f"{name} {text}"] if text else []
    if table:
        labels, ids = _renamed(new.view.labels, table), _renamed(new.ids, table)
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
) -> tuple[tuple[Int[np.ndarray, " n"], Values], ...]:
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
    if share <= _CONTRADICTS and _contradiction(laid, known, _IN_FRONT) > _CONTRADICTS:
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
    remedy = "it has moved between the views; fit those since then alone"
    free = _in_free_space(new, known, _IN_FRONT)
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
        one, other = new.of(new.ids == i), known.of(known.ids == i)
        if min(len(one.points), len(other.points)) < _VOTES:
            continue
        motion = lay(one, other, _OBJECT_STEPS, turn=_OBJECT_TURN)  # beside the whole view's
        if motion.offset > NAMED_OFFSET and motion.certain(_VOTES, 1.25 * _SIGMAS):
            found.append(
                f"object {i} lies {1e3 * motion.offset:.0f} mm off in {names[0]} from where "
                f"{names[1]} shows it: {remedy}"
            )
    return found


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
        far = np.concatenate([f[i > 0] for i, f in _in_free_space(new, before, _IN_FRONT)])
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
        if near and gaps[near] < _BESIDE:
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


def _shared(
    laid: Sequence[Samples], known: Sequence[Samples]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Labels that a view and those before it give to samples of surfaces that both show."""
    mine, theirs = [], []
    for new, before in zip(laid, known, strict=True):
        there, back = look_up(before, new), look_up(new, before)
        same, same_back = there.same(_SAME), back.same(_SAME)
        mine += [new.ids[same], back.labels[same_back]]
        theirs += [there.labels[same], before.ids[same_back]]
    return np.concatenate(mine), np.concatenate(theirs)


def _renamed(ids: Int[np.ndarray, "*shape"], table: dict[int, int]) -> Int[np.ndarray, "*shape"]:
    result = ids.copy()
    for i, j in table.items():
        result[ids == i] = j
    return result
