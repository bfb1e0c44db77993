# SPDX-License-Identifier: BSD-3-Clause
"""From observations to a map: samples, hinge points, EM (the paper's figure 2)."""

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import cKDTree

from vprism_plan._arguments import choice, is_whole, number
from vprism_plan._shapes import Indices, Points
from vprism_plan._threads import beside
from vprism_plan.errors import MapError, ObservationError
from vprism_plan.mapping.changes import Changes, notice, numbered, without_old
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.em import (
    Posterior,
    Weights,
    correction_variances,
    diagonal_prior,
    expand_prior,
    fit_weights,
    weight_prior,
)
from vprism_plan.mapping.features import FeatureSpace, block_features, sorted_hinges
from vprism_plan.mapping.hinges import lattice_hinges, local_features, needed_nodes, surface_hinges
from vprism_plan.mapping.posterior import VPrismMap, nothing
from vprism_plan.mapping.prior import (
    FLAT_OCCUPANCY,
    Prior,
    PriorField,
    hidden_depth,
    object_crops,
    prior_field,
    seen_through,
)
from vprism_plan.mapping.training_data import (
    box_centers,
    grid_subsample,
    outside_boxes,
    sample_below_plane,
    sample_in_front,
    sample_rays,
    stray_points,
    sunk_objects,
)
from vprism_plan.perception.camera import backproject, transform_points
from vprism_plan.perception.masks import drop_background
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.plane_fitting import fit_plane
from vprism_plan.perception.sanity import examine
from vprism_plan.perception.several_views import agree

logger = logging.getLogger(__name__)

_COARSEST = 3.0  # times the lattice that was asked for; beyond, a scene is no tabletop
_CROWDED = 50.0  # nodes of the objects' boxes per hinge point of the budget, at most to be listed


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Labelled points of one or several views.

    Attributes:
        points: (N, 3) m, world; thinned.
        classes: (N,) 0 is empty, k is `object_ids[k - 1]`.
        lower, upper: (C, 3) corners of the objects' boxes, m.
        sunk: which objects lie lower than the support plane.
    """

    points: Float[np.ndarray, "n 3"]
    classes: Int64[np.ndarray, " n"]
    lower: Float[np.ndarray, "c 3"]
    upper: Float[np.ndarray, "c 3"]
    sunk: Bool[np.ndarray, " c"]

    @property
    def surface(self) -> Points:
        """The object points among `points`."""
        return self.points[self.classes > 0]


def fit_map(
    observations: Observation | Sequence[Observation],
    config: MapConfig | None = None,
    seed: int = 0,
    prior: Any = "shape",
) -> VPrismMap:
    """Fit a map to one labelled view, or to several views of one scene in one world frame.

    Args:
        observations: views with labels; object ids mean the same in all of them. Where every label
            is 0 the table is empty: the map has no objects, and says so in `warnings`.
        config: parameters; the default is calibrated for planning.
        seed: of all sampling. Same views, config and seed: same bits.
        prior: what is thought of the hidden side: "shape" for the package's own network, None
            for the paper's flat prior (always that of `MapConfig.paper()`), a `MeshPrior`, or
            anything that answers like one.

    Raises:
        ObservationError: no labels (see `segment_tabletop`), or labels of which none is an object.
        PlaneNotFoundError: no support plane is known and none can be fitted.
        MapError: the objects are too large for any lattice, or the seed is none.
    """
    return _fit(observations, MapConfig() if config is None else config, seed, prior)


def _fit(
    observations: Observation | Sequence[Observation],
    config: MapConfig,
    seed: int,
    prior: Any,
    known: Sequence[str] = (),
    plane: Plane | None = None,
    compared: bool = False,
) -> VPrismMap:
    """`fit_map`; `known` are warnings that views gave already, which were examined with `plane`,
    or at least `compared` with one another."""
    views = _views(observations)
    if views and not any(view.labels is None or (view.labels > 0).any() for view in views):
        return _of_empty_table(views, config, seed, known, compared)
    said: tuple[str, ...] = ()
    if plane is None:
        views, plane, said = _examined(views, seed, compared)
    ids = _object_ids(views) or views[0].require_objects()
    ask: Callable[[], Any] = lambda: None  # noqa: E731
    if prior is not None and config.prior_hidden_variance is not None:
        ask = partial(_guessing(prior), views, ids, plane)
    # Nobody else's code is called in a thread that it does not know.
    with beside(ask) if isinstance(prior, str) else nullcontext(ask) as answer:
        problem = _problem(views, ids, plane, config, seed)
        guess = answer()
    config, space, data, field = problem.config, problem.space, problem.data, None
    if guess is not None:

        def empty(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
            low, high = data.lower[data.sunk], data.upper[data.sunk]
            under_table = outside_boxes(points, low, high, config.object_radius)
            under_table &= plane.signed_distance(points) < 0.0
            return under_table | seen_through(points, views)

        field = prior_field(
            guess,
            object_crops(views, ids, plane),
            empty,
            FLAT_OCCUPANCY if config.prior_occupancy is None else config.prior_occupancy,
            own=not isinstance(prior, str),
        )
        depth = hidden_depth(space.hinges, views)
        variance = correction_variances(space, config, depth)
        mean = np.zeros((space.size, len(ids) + 1))
        members = local_features(space.hinges, data.lower, data.upper, config.class_reach)
        weights = diagonal_prior(space, mean, variance, members)
    else:
        weights = weight_prior(space, config, len(ids) + 1)
    posterior = _learn(space, data, weights, config, field)
    return VPrismMap(
        config, ids, plane, views, space, posterior, seed,
        tuple(dict.fromkeys([*known, *said, *problem.warnings])), field,
    )  # fmt: skip


def _of_empty_table(
    views: tuple[Observation, ...],
    config: MapConfig,
    seed: int,
    known: Sequence[str],
    compared: bool,
) -> VPrismMap:
    views, plane, warnings = _examined(views, seed, compared)
    said = (
        "no pixel has an object's label: the map has no objects, and what stands on the support "
        "surface is background, an obstacle; if objects are there, label them (segment_tabletop)"
    )
    return nothing(config, plane, views, seed, tuple(dict.fromkeys([*known, *warnings, said])))


def _guessing(prior: Any) -> Prior:
    """Return the prior that was asked for."""
    if isinstance(prior, str):
        choice("prior", prior, ["shape"], error=MapError)
        from vprism_plan.mapping.shape_network import own_prior

        return own_prior()
    if not callable(prior):
        raise MapError(
            f"prior is a {type(prior).__name__}; give 'shape', None, a MeshPrior, or a function "
            "of (views, object_ids, plane)"
        )
    return cast(Prior, prior)


@dataclass(frozen=True, eq=False)
class LearningProblem:
    """What a map is learned from, and in which features.

    Attributes:
        config: parameters, coarser than asked for where the scene is too large.
        views: the observations.
        object_ids: sorted labels of the objects.
        plane: support surface, world frame.
        data: labelled points.
        space: hinge points and kernel.
        warnings: what was odd about the views.
    """

    config: MapConfig
    views: tuple[Observation, ...]
    object_ids: tuple[int, ...]
    plane: Plane
    data: TrainingData
    space: FeatureSpace
    warnings: tuple[str, ...]


def learning_problem(
    observations: Observation | Sequence[Observation], config: MapConfig, seed: int
) -> LearningProblem:
    """Return the data and features of `fit_map`, for what is compared with it.

    Arguments and errors are those of `fit_map`.
    """
    views, plane, warnings = _examined(_views(observations), seed)
    object_ids = _object_ids(views) or views[0].require_objects()
    problem = _problem(views, object_ids, plane, config, seed)
    return replace(problem, warnings=(*warnings, *problem.warnings))


def _examined(
    views: tuple[Observation, ...], seed: int, compared: bool = False
) -> tuple[tuple[Observation, ...], Plane, tuple[str, ...]]:
    """Return views fit for use, their support plane, and what is odd about them; `compared` is
    that of `examine`."""
    views = _usable(views)
    plane = _support_plane(views, _checked_seed(seed))
    views, warnings = examine(views, plane, compared=compared)
    return views, plane, warnings


def _problem(
    views: tuple[Observation, ...],
    object_ids: tuple[int, ...],
    plane: Plane,
    config: MapConfig,
    seed: int,
) -> LearningProblem:
    """Return the data and features of examined views; warnings only of what was made of them."""
    rng = np.random.default_rng(seed)
    data = training_data(views, object_ids, plane, config, rng)
    hinges, used, coarser = _hinges_within_budget(data, views, plane, config, rng)
    space = FeatureSpace(sorted_hinges(hinges), used.gamma, used.cutoff_radius)
    warnings = (*_without_return(views, object_ids), *coarser)
    return LearningProblem(used, views, object_ids, plane, data, space, warnings)


def _checked_seed(seed: Any) -> int:
    if not (is_whole(seed) and seed >= 0):
        raise MapError(f"seed is {seed!r}; it must be a whole number from 0")
    return int(seed)


def _views(observations: Any) -> tuple[Observation, ...]:
    if isinstance(observations, Observation):
        return (observations,)
    if not isinstance(observations, Iterable):
        raise ObservationError(
            f"got a {type(observations).__name__}; give one Observation or a list of them"
        )
    views = tuple(observations)
    for index, view in enumerate(views):
        if not isinstance(view, Observation):
            raise ObservationError(
                f"view {index} is a {type(view).__name__}; give Observations (load_observation "
                "reads one)"
            )
    return views


def update_map(
    old: VPrismMap, observation: Observation, prior: Any, forget: float | None
) -> VPrismMap:
    """See `VPrismMap.update`."""
    if not isinstance(observation, Observation):
        raise ObservationError(f"update got a {type(observation).__name__}; give one Observation")
    if old.prior is not None and old.prior.own and isinstance(prior, str):
        raise MapError(
            "this map's prior is one of your own; give it again: update(view, prior=...), or "
            "fit_map to ask the package's"
        )
    (observation,) = _usable((observation,), old.views)
    if not old.views:
        return _refitted(old, (observation,), prior)
    before = old.views
    if forget is not None:
        seconds = number("forget", forget, 0.0, unit="seconds", error=MapError)
        before = without_old(before, observation.time, seconds)
    (mended,), found = examine((observation,), old.plane, old.views, compared=True)
    noticed = notice(mended, before, old.plane, old.changes.retired)
    view = numbered(mended, noticed.table, len(before))
    same = len(noticed.earlier) == len(old.views)
    if same and all(a is b for a, b in zip(noticed.earlier, old.views, strict=True)):
        fitted = _updated(old, view, found, prior)
    else:
        # Every view says where the table is, also one that no longer shows it.
        views = tuple(replace(view, plane=old.plane) for view in noticed.earlier)
        fitted = _refitted(old, (*views, view), prior)
    labels = observation.labels, fitted.views[-1].labels
    changes = Changes.between(
        old.object_ids, old.changes.retired, fitted.object_ids, noticed.moved, *labels
    )
    return replace(fitted, changes=changes)


def _refitted(old: VPrismMap, views: tuple[Observation, ...], prior: Any) -> VPrismMap:
    """Fit all views together, as the old map was."""
    logger.info("all %d views are fitted together", len(views))
    guessed = old.prior is not None or not old.object_ids
    return _fit(
        views, old.config, old.seed, prior if guessed else None, old.warnings, compared=True
    )


def _updated(
    old: VPrismMap, observation: Observation, found: Sequence[str], prior: Any
) -> VPrismMap:
    """Fit one more view of the scene as it was; it was examined, and `found` odd in these ways."""
    config, plane = old.config, old.plane
    (observation,) = agree((observation,), old.views)
    found = (*found, *observation.warnings)
    seen = _object_ids((observation,))
    views = (*old.views, observation)
    if old.prior is not None or not seen or not set(seen) <= set(old.object_ids):
        logger.info("all %d views are fitted together", len(views))
        guessed = old.prior is not None or not old.object_ids
        known = (*old.warnings, *found)
        given = observation.plane is not None and all(view.plane is None for view in old.views)
        return _fit(
            views, config, old.seed, prior if guessed else None, known,
            None if given else plane,  # a given one is better than the fitted one
            compared=True,
        )  # fmt: skip
    found = (*found, *_without_return((observation,), old.object_ids))
    rng = np.random.default_rng((old.seed, len(views)))
    data = training_data((observation,), seen, plane, config, rng)
    candidates = new_hinges(data, views, plane, config, rng)
    # New ground is where the old lattice did not reach: nodes it already has stay its own.
    nearest, _ = cKDTree(old.space.hinges).query(candidates)
    added = candidates[nearest > 0.5 * config.hinge_spacing]
    hinges = np.concatenate([old.space.hinges, added])
    if len(hinges) > config.max_hinges:
        logger.info("all %d views are fitted together, on a coarser lattice", len(views))
        return _fit(views, config, old.seed, None, (*old.warnings, *found), plane)
    space = FeatureSpace(sorted_hinges(hinges), config.gamma, config.cutoff_radius)
    class_of = np.array([0, *(old.object_ids.index(i) + 1 for i in seen)])
    fresh = weight_prior(space, config, old.n_classes)
    weights = expand_prior(old.space, old.posterior, space, fresh)
    data = replace(data, classes=class_of[data.classes])
    posterior = _learn(space, data, weights, config, None)
    warnings = tuple(dict.fromkeys([*old.warnings, *found]))
    return VPrismMap(config, old.object_ids, plane, views, space, posterior, old.seed, warnings)


def training_data(
    views: Sequence[Observation],
    object_ids: tuple[int, ...],
    plane: Plane,
    config: MapConfig,
    rng: np.random.Generator,
) -> TrainingData:
    """Observed points, negative samples and their subsampling (section V)."""
    clouds = [_without_strays(*_marked_points(view), config.stray_share) for view in views]
    points = np.concatenate([cloud for cloud, _, _ in clouds])
    labels = np.concatenate([label for _, label, _ in clouds]).astype(np.int64)
    lower, upper = box_centers(points, labels, object_ids, config.box_trim)
    centers = 0.5 * (lower + upper)
    free = points[labels == 0]
    if config.ray_sampling != "whole":  # samples of other rays are near as they are
        free = _near_any(free, centers, config.object_radius)
    empty = [free]
    front: list[np.ndarray] = []
    for view, (cloud, label, ends) in zip(views, clouds, strict=True):
        origin = view.camera_center
        empty.append(
            sample_rays(
                ends, origin, centers, config.object_radius, config.ray_step, rng,
                config.ray_sampling,
            )
        )  # fmt: skip
        if config.front_distance is not None:
            whole = (ends == cloud).all(axis=1)
            seen = sample_in_front(cloud[(label > 0) & whole], origin, config.front_distance)
            front.append(grid_subsample(seen, config.front_resolution))
    below = sample_below_plane(
        plane.normal, plane.offset, centers, config.object_radius,
        config.below_plane_samples, rng, config.below_plane_margin,
    )  # fmt: skip
    sunk = sunk_objects(points, labels, object_ids, plane.normal, plane.offset)
    # What lies lower than the plane has a hidden side of its own: nobody denies that.
    room = config.object_radius
    empty.append(below[outside_boxes(below, lower[sunk], upper[sunk], room)])
    near = grid_subsample(np.concatenate(empty), config.empty_resolution)
    free = np.concatenate([near, *front])
    surfaces = [grid_subsample(points[labels == i], config.object_resolution) for i in object_ids]
    counts = [len(s) for s in surfaces]
    room = max(config.max_points - sum(counts), 1)
    if len(free) > room:
        logger.warning("%d empty points thinned at random to max_points", len(free))
        free = free[np.sort(rng.permutation(len(free))[:room])]
    return TrainingData(
        np.concatenate([free, *surfaces]),
        np.repeat(np.arange(1 + len(object_ids)), [len(free), *counts]),
        lower,
        upper,
        sunk,
    )


def _marked_points(view: Observation) -> tuple[Points, Indices, Points]:
    """One view's points and labels, -1 where it sees the robot, and where its free rays end.

    The ray before such a point is as empty as any other. The point itself says nothing:
    if it should belong to what the robot holds, calling it empty would carve that away. So it
    is with what has gone, and with empty places behind what has come since.
    """
    points, labels = view.points()
    labels = np.where(view.sees_robot[view.depth > 0], -1, labels)
    if view.clear is None:
        return points, labels, points
    kept, gone = view.depth > 0, (view.depth == 0) & (view.clear > 0)
    image = transform_points(view.pose, backproject(view.clear, view.intrinsics))
    cut = (view.clear < view.depth)[kept]
    ends = np.where(cut[:, None], image[kept], points)
    ends = np.where((view.clear > 0)[kept][:, None], ends, view.camera_center)
    labels = np.concatenate([np.where(cut & (labels == 0), -1, labels), np.full(gone.sum(), -1)])
    return np.concatenate([points, image[gone]]), labels, np.concatenate([ends, image[gone]])


def _without_strays(
    points: Points, labels: Indices, ends: Points, share: float
) -> tuple[Points, Indices, Points]:
    """Return one view's points, labels and ends of rays without flying pixels.

    Their rays go as well: they end in the shadow of what they fringe, and samples along
    them would call that shadow empty.
    """
    keep = np.ones(len(points), dtype=bool)
    for label in np.unique(labels[labels > 0]):
        own = labels == label
        keep[own] = ~stray_points(points[own], share)
    if not keep.all():
        logger.info("%d of %d points taken for flying pixels", (~keep).sum(), len(keep))
    return points[keep], labels[keep], ends[keep]


def new_hinges(
    data: TrainingData,
    views: Sequence[Observation],
    plane: Plane,
    config: MapConfig,
    rng: np.random.Generator,
) -> Points:
    """Return lattice and surface hinge points of the training data (m, world)."""
    lattice = lattice_hinges(data.lower, data.upper, plane.normal, plane.offset, config, data.sunk)
    if config.hinge_reach is not None:
        needed = needed_nodes(
            lattice, views, plane, data.surface, config.hinge_spacing, config.hinge_reach
        )
        lower, upper = data.lower[data.sunk], data.upper[data.sunk]
        needed |= ~outside_boxes(lattice, lower, upper, config.hinge_margin)
        lattice = lattice[needed]
    owners, objects = data.classes[data.classes > 0], tuple(range(1, 1 + len(data.lower)))
    surface = surface_hinges(data.surface, owners, objects, config.surface_hinges, rng)
    return np.concatenate([lattice, surface])


def _hinges_within_budget(
    data: TrainingData,
    views: Sequence[Observation],
    plane: Plane,
    config: MapConfig,
    rng: np.random.Generator,
) -> tuple[Points, MapConfig, list[str]]:
    """Return at most `max_hinges` hinge points, the parameters that make so few, and a warning
    where those are not `config`: spacing and kernel grow together, so that the prior stays.

    Raises:
        MapError: no lattice that resolves anything is coarse enough.
    """
    asked, needed = config, 0
    extent = data.upper - data.lower + 2.0 * max(config.hinge_margin, config.hinge_radius)
    while True:
        listed = float((extent / config.hinge_spacing + 1.0).prod(axis=1).sum())
        count, budget = listed, _CROWDED * config.max_hinges
        if listed <= budget:
            hinges = new_hinges(data, views, plane, config, rng)
            count, budget = len(hinges), float(config.max_hinges)
        needed = needed or int(count)
        if count <= budget:
            break
        factor = max(1.02, (count / budget) ** (1.0 / 3.0))
        config = replace(
            config,
            hinge_spacing=factor * config.hinge_spacing,
            gamma=config.gamma / factor**2,
            hinge_reach=None if config.hinge_reach is None else factor * config.hinge_reach,
        )
        if config.hinge_spacing > _COARSEST * asked.hinge_spacing:
            raise MapError(
                f"the scene needs {needed} hinge points, more than max_hinges = "
                f"{config.max_hinges}, and {_size(data)}"
            )
    if config is asked:
        return hinges, config, []
    return hinges, config, [
        f"the scene would need {needed} hinge points, more than max_hinges = {config.max_hinges}: "
        f"they are {1e3 * config.hinge_spacing:.0f} mm apart instead of "
        f"{1e3 * asked.hinge_spacing:.0f}, with kernels of {1e3 * config.kernel_length:.0f} mm "
        f"instead of {1e3 * asked.kernel_length:.0f}, which blurs surfaces and gaps as wide as "
        f"that; {_size(data)}"
    ]  # fmt: skip


def _size(data: TrainingData) -> str:
    size = float((data.upper - data.lower).max())
    return (
        f"its largest object measures {size:.2f} m: if that is wrong, check labels and the "
        "scale of depth (metres), else label less or raise max_hinges"
    )


def _learn(
    space: FeatureSpace, data: TrainingData, weights: tuple[Weights, ...], config: MapConfig,
    field: PriorField | None,
) -> Posterior:  # fmt: skip
    features = block_features(space, data.points)
    logger.info(
        "fitting %d points, %d hinge points, %d classes",
        len(data.points), len(space.hinges), len(weights),
    )  # fmt: skip
    return fit_weights(
        features, data.classes, weights,
        iterations=(
            config.iterations if field is None
            else min(config.iterations, config.guessed_iterations)
        ),
        variational_updates=config.variational_updates,
        relaxation=config.relaxation,
        start_variance=config.start_variance,
        tolerance=config.tolerance,
        offset=None if field is None else field.at(data.points),
    )  # fmt: skip


def _usable(
    views: Sequence[Observation], earlier: Sequence[Observation] = ()
) -> tuple[Observation, ...]:
    """Return views of one world frame, without labels that are no object."""
    if not views:
        raise ObservationError("no observation given; fit_map needs at least one view")
    posed = {view.posed for view in (*earlier, *views)}
    if len(posed) > 1 or (len(views) > 1 and False in posed):
        raise ObservationError(
            "several views need T_world_camera each; without it their frames differ"
        )
    for view in views:
        _ids_in(view)
    kept = drop_background(views, len(earlier))
    for before, after in zip(views, kept, strict=True):
        if before.object_ids:
            after.require_objects()
    return kept


def _object_ids(views: Sequence[Observation]) -> tuple[int, ...]:
    """Labels of the objects."""
    return tuple(sorted({i for view in views for i in _ids_in(view)}))


def _ids_in(view: Observation) -> tuple[int, ...]:
    """Labels of the objects in a view: none where every label is 0, which says that it sees none;
    ObservationError if it has no labels, or those of objects without any depth."""
    if view.labels is not None and not (view.labels > 0).any():
        return ()
    return view.require_objects()


def _without_return(views: Sequence[Observation], object_ids: tuple[int, ...]) -> list[str]:
    """Name the objects that carry a label and are in no map: no pixel of theirs has depth."""
    pixels: dict[int, int] = {}
    for view in views:
        ids, counts = np.unique(view.labels[view.labels > 0], return_counts=True)
        for i, count in zip(ids.tolist(), counts.tolist(), strict=True):
            if i not in object_ids:
                pixels[i] = pixels.get(i, 0) + count
    return [
        f"object {i} is not in the map: none of its {count} pixels has a depth return of its "
        "own; the rays through them count as an obstacle, take another view if it is of glass, "
        "black or shiny"
        for i, count in sorted(pixels.items())
    ]


def _support_plane(views: Sequence[Observation], seed: int) -> Plane:
    for view in views:
        if view.plane is not None:
            return view.plane
    return fit_plane(views[0], seed=seed)


def _near_any(points: Points, centers: Points, radius: float) -> Points:
    """Keep the points within `radius` of a centre."""
    near = np.zeros(len(points), dtype=bool)
    for center in centers:
        away = points - center
        near |= np.einsum("na,na->n", away, away) <= radius**2
    return points[near]
