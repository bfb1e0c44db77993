# SPDX-License-Identifier: BSD-3-Clause
"""Where to look next: the view that would let a motion through.

What a view is worth is what it changes. In each posterior world it shows some of the voxels that
the motion would touch, and does not show others: those hide behind what stands in that world, or
outside the image. Who sees one of them does not go; who sees none goes if what may still be hidden
is within the bound on risk. Howard, "Information value theory" (IEEE Trans. SSC 2, 1966).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from scipy.special import entr

from vprism_plan._arguments import rigid_pose
from vprism_plan._kernels import sight
from vprism_plan.collision.entropy import voxels_in
from vprism_plan.collision.risk import Setting, count_path
from vprism_plan.errors import ConfigError, PlanningError
from vprism_plan.perception.camera import invert_transform, project, transform_points
from vprism_plan.planning.plan import plan
from vprism_plan.planning.result import PlanResult

_GAP = 1.25  # voxels before a voxel within which nothing hides it: its own neighbours
_NEAREST = 0.05  # metres before a camera from which it sees


@dataclass(frozen=True)
class ViewValue:
    """What one view would do for a motion.

    Attributes:
        utility: expected, of going or not after the view: 1 is reaching the goal, 0 staying,
            and a collision costs what `max_risk` makes it cost. At least what it is without.
        shown: share of the worlds that the motion collides in, of which the view shows it.
        go: probability that the view shows nothing in the way.
        risk: probability of a collision where it shows nothing.
        entropy: of the voxels the motion sweeps, as far as the view would show them, nats.
        baseline: angle at what may be touched between this view and the nearest of the
            map's own, radians.
    """

    utility: float
    shown: float
    go: float
    risk: float
    entropy: float
    baseline: float


@dataclass(frozen=True, eq=False)
class NextView:
    """Views ranked for one motion.

    Attributes:
        plan: the motion as it stands; where it is "exact", no view is needed.
        risk: probability of its collision, by worlds that its search has not seen.
        utility: expected, without another view.
        views: the poses that were given, `T_world_camera` (v, 4, 4).
        intrinsics, shape: of their camera and its images.
        values: of the views, in the order they were given; empty without a motion.
        ranking: their indices, best first.
        best: index of the first; None where no view shows anything that may be touched.
    """

    plan: PlanResult
    risk: float
    utility: float
    views: Float[np.ndarray, "v 4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    shape: tuple[int, int]
    values: tuple[ViewValue, ...]
    ranking: tuple[int, ...]
    best: int | None

    def text(self) -> str:
        """Return what the best view would do, in one line."""
        if not self.values:
            return f"no motion to look for ({self.plan.status}): {self.plan.message}"
        now = f"P(collision) is {self.risk:.2f}"
        if self.best is None:
            return f"{now}; none of {len(self.values)} views shows anything that may be touched"
        value = self.values[self.best]
        return (
            f"{now}; view {self.best} of {len(self.values)} would show {100 * value.shown:.0f} % "
            f"of that, and nothing in the way with probability {value.go:.2f}: then it is "
            f"{value.risk:.2f}"
        )


def next_view(
    checker: Any,
    start: Any,
    goal: Any,
    views: Sequence[Any] | Float[np.ndarray, "v 4 4"],
    *,
    intrinsics: Any = None,
    shape: tuple[int, int] | None = None,
    result: PlanResult | None = None,
    **options: Any,
) -> NextView:
    """Rank views by what each would do for the motion from `start` to `goal`.

    Among equals in `utility` the one comes first that shows the motion's collisions in more worlds,
    then that of the larger `entropy`. The robot is in no view: where a camera on its own link
    stands for a view, see `camera_views`. What a view would tell of places it does not show is not
    counted, nor another motion that it would open. O(views x voxels touched x voxels between).

    Args:
        checker: a `CollisionChecker` with `max_risk` over a `World` with a map.
        start, goal: as for `plan`.
        views: candidate poses of the camera, `T_world_camera` (4, 4) each, optical frame, metres.
        intrinsics: (3, 3) of the camera, pixels, and `shape` (height, width) of its images; those
            of the map's first view if None.
        result: what `plan` said of this query, if it was asked already.
        **options: of `plan`.

    Raises:
        ConfigError: the checker has no bound on risk.
        PlanningError: no views, one that is no pose, or no camera.
    """
    if getattr(checker, "max_risk", None) is None:
        raise ConfigError("next_view weighs risks: give a checker with max_risk, such as 0.1")
    poses = _checked_poses(views)
    seen = checker.world.map.views
    if not seen and (intrinsics is None or shape is None):
        raise PlanningError("the map has no view to take a camera from: give intrinsics and shape")
    K = np.asarray(seen[0].intrinsics if intrinsics is None else intrinsics, dtype=np.float64)
    height, width = seen[0].depth.shape if shape is None else shape
    asked = poses, K, (int(height), int(width))
    found = plan(checker, start, goal, **options) if result is None else result
    path = found.path if found.path is not None else found.approximate_path
    if path is None or found.status not in ("exact", "too_risky"):
        return NextView(found, float("nan"), 0.0, *asked, (), (), None)
    at = checker.risk_setting(held_out=True)
    price = 1.0 / checker.max_risk
    touches = _touches(at, path)
    risk = float(touches.collides.mean())
    values = _values(at, touches, *asked, price)
    order = sorted(
        range(len(values)),
        key=lambda v: (-values[v].utility, -values[v].shown, -values[v].entropy, v),
    )
    best = order[0] if values[order[0]].shown > 0.0 else None
    return NextView(found, risk, max(0.0, 1.0 - price * risk), *asked, values, tuple(order), best)


def camera_views(
    checker: Any, link: str, T_link_camera: Any, configurations: Any
) -> tuple[Float[np.ndarray, "v 4 4"], Int[np.ndarray, " v"]]:
    """Return where a camera on a link would be, `T_world_camera` (v, 4, 4), at those of the
    configurations (n, dof) that the checker accepts, and which these are, (v,)."""
    Q = np.atleast_2d(np.asarray(configurations, dtype=np.float64))
    rows = np.flatnonzero(checker.is_valid_batch(Q))
    mounted = np.asarray(T_link_camera, dtype=np.float64)
    poses = [checker.robot.link_poses(Q[i])[link] @ mounted for i in rows]
    return np.array(poses).reshape(-1, 4, 4), rows


@dataclass(frozen=True, eq=False)
class _Touches:
    """Voxels that a motion sweeps and some world occupies, and the worlds it collides in."""

    index: Int[np.ndarray, "n 3"]  # centres are `resolution * index`, metres
    occupied: Bool[np.ndarray, "n s"]  # by what the motion may not touch
    collides: Bool[np.ndarray, " s"]


def _touches(at: Setting, path: Float[np.ndarray, "t dof"]) -> _Touches:
    worlds, voxel = at.worlds, at.worlds.resolution
    sweep = count_path(at, np.asarray(path, dtype=np.float64), worlds.n_worlds)
    radii, counting = at.radii + sweep.slack, worlds.counting()
    index, occupied = [np.empty((0, 3), np.int64)], [np.empty((0, worlds.n_worlds), np.bool_)]
    for rule, allowed in zip(at.tables, at.certain.rules, strict=True):
        own = at.sphere_tables == rule
        centers = sweep.centers[:, :, own].transpose(0, 2, 1).reshape(-1, 3)
        reach = radii[:, own].reshape(-1)
        near = worlds.touched(centers, reach, allowed).any(axis=1)
        swept = voxels_in(centers[near], reach[near] + 0.5 * voxel, voxel)
        taken = counting[rule][worlds.owners(swept)]
        some = taken.any(axis=1)
        index.append(swept[some])
        occupied.append(taken[some])
    voxels, which = np.unique(np.concatenate(index), axis=0, return_inverse=True)
    together = np.zeros((len(voxels), worlds.n_worlds), np.bool_)
    np.logical_or.at(together, which, np.concatenate(occupied))
    return _Touches(voxels, together, sweep.touched > 0)


def _values(
    at: Setting, touches: _Touches, poses: Float[np.ndarray, "v 4 4"],
    K: Float[np.ndarray, "3 3"], shape: tuple[int, int], price: float,
) -> tuple[ViewValue, ...]:  # fmt: skip
    n_worlds, collides = at.worlds.n_worlds, touches.collides
    points = at.worlds.resolution * touches.index.astype(np.float64)
    sees = _sees(at, points, poses, K, shape)
    occupied = _words(touches.occupied)
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    share = touches.occupied.mean(axis=1)
    doubt = entr(share) + entr(1.0 - share)
    found = []
    for pose, own in zip(poses, sees, strict=True):
        shown = _bits(np.bitwise_or.reduce(own & occupied, axis=0, initial=0), n_worlds) & collides
        visible = np.bitwise_count(own).sum(axis=1) / n_worlds
        go = 1.0 - shown.mean()
        left = float((collides & ~shown).mean())
        found.append(
            ViewValue(
                utility=float(max(0.0, go - price * left)),
                shown=float(shown.sum() / max(1, collides.sum())),
                go=float(go),
                risk=left / go if go > 0.0 else 0.0,
                entropy=float(doubt @ visible),
                baseline=_baseline(at.world.map.views, pose[:3, 3], middle),
            )
        )
    return tuple(found)


def _sees(
    at: Setting, points: Float[np.ndarray, "n 3"], poses: Float[np.ndarray, "v 4 4"],
    K: Float[np.ndarray, "3 3"], shape: tuple[int, int],
) -> UInt64[np.ndarray, "v n w"]:  # fmt: skip
    """Return in which worlds each view sees each point, 64 worlds in a word."""
    world, worlds = at.world, at.worlds
    in_view = np.zeros((len(poses), len(points)), np.bool_)
    for own, pose in zip(in_view, poses, strict=True):
        pixels, depth = project(transform_points(invert_transform(pose), points), K)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels <= np.array(shape[::-1]) - 0.5)
        own[:] = inside.all(axis=1) & (depth > _NEAREST)
    solid = np.zeros(world.field.distance.shape, np.bool_)
    hidden = {"occluded", "unobserved", *(f"object:{i}" for i in world.map.object_ids)}
    for name in world.sources:
        if name not in hidden:
            solid |= world.source_field(name).distance <= 0.0
    row, occupied, first = worlds.drawn()
    sees = np.zeros((len(poses), len(points), worlds.n_worlds // 64), np.uint64)
    sight.lines_of_sight(
        np.ascontiguousarray(poses[:, :3, 3]), points, in_view, solid, world.field.origin,
        float(world.field.spacing), row, _words(occupied > 0), first, worlds.resolution,
        _GAP * worlds.resolution, sees,
    )  # fmt: skip
    return sees


def _baseline(views: Sequence[Any], eye: np.ndarray, middle: np.ndarray) -> float:
    angles = []
    for view in views:
        a, b = eye - middle, view.camera_center - middle
        cosine = (a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
        angles.append(float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return min(angles, default=float("nan"))


def _words(flags: Bool[np.ndarray, "n s"]) -> UInt64[np.ndarray, "n w"]:
    packed = np.packbits(flags, axis=1, bitorder="little")
    return np.ascontiguousarray(packed).view(np.uint64)


def _bits(words: UInt64[np.ndarray, " w"], n: int) -> Bool[np.ndarray, " s"]:
    return np.unpackbits(words.view(np.uint8), bitorder="little")[:n].astype(np.bool_)


def _checked_poses(views: Any) -> Float[np.ndarray, "v 4 4"]:
    if len(views) == 0:
        raise PlanningError("views is empty; give at least one pose T_world_camera (4, 4)")
    return np.array([rigid_pose(f"view {i}", v, error=PlanningError) for i, v in enumerate(views)])
