# SPDX-License-Identifier: BSD-3-Clause
"""`VPrismMap`: the fitted posterior and the questions it answers."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vprism_plan._kernels import mapping as kernels
from vprism_plan._shapes import Points, Values
from vprism_plan._threads import run_chunked
from vprism_plan.errors import MapError
from vprism_plan.mapping import prediction
from vprism_plan.mapping.changes import Changes
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.em import Posterior, Weights, diagonal_prior
from vprism_plan.mapping.factors import correlate, dense, run_per_class
from vprism_plan.mapping.features import FeatureSpace, block_extent, make_blocks
from vprism_plan.mapping.prior import MOST, PriorField
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

_ON_PLANE = 0.02  # m from the support plane, of points that show an empty table
_SURE = 0.01 - MOST  # log-odds up to which a guess is as sure of nothing as it can be
Logits = Float[np.ndarray, "n k"]
MAX_LOG_ODDS = 40.0  # exp(-40) is 4e-18: nothing a float64 probability could still tell from 0


@dataclass(eq=False, repr=False)
class VPrismMap:
    """A probabilistic segmentation map of a tabletop scene (V-PRISM).

    Class 0 is *empty*, class k >= 1 is the object `object_ids[k - 1]`. Points are in the
    world frame, metres. Made by `fit_map` and `load_map`, never changed afterwards;
    `update` returns a new map.

    Attributes:
        config: the parameters it was fitted with.
        object_ids: labels of the objects, sorted.
        plane: support surface in the world frame; None only of `nothing()`.
        views: every observation that was fitted.
        seed: the seed of the fit.
        warnings: what was odd about the views: sentences with the remedy.
        posterior: Gaussian posterior of the weights (hinges in `space` order).
        space: sorted hinge points and kernel.
        prior: what is added to the kernels' logits: a guess of the hidden side, or None.
        changes: what the last `update` noticed of objects that moved, left or came.
    """

    config: MapConfig
    object_ids: tuple[int, ...]
    plane: Any  # a `Plane`, or None
    views: tuple[Observation, ...]
    space: FeatureSpace
    posterior: Posterior
    seed: int
    warnings: tuple[str, ...] = ()
    prior: PriorField | None = None
    changes: Changes = field(default_factory=Changes)

    def __repr__(self) -> str:
        return (
            f"VPrismMap(object_ids={self.object_ids}, hinge_points={len(self.space.hinges)}, "
            f"views={len(self.views)})"
        )

    @property
    def n_classes(self) -> int:
        """Number of classes K: the objects and "empty"."""
        return len(self.object_ids) + 1

    @cached_property
    def hinge_points(self) -> Float[Tensor, "h 3"]:
        """Hinge points (m, world), float64."""
        return torch.from_numpy(self.space.hinges.copy())

    @property
    def history(self) -> tuple[float, ...]:
        """Evidence lower bound (nats) after every EM iteration; never falls."""
        return self.posterior.history

    @property
    def kernel_length(self) -> float:
        """Length scale of the kernel, m."""
        return self.config.kernel_length

    @property
    def detail(self) -> float:
        """Length over which logits may turn, m: the kernel's, or a voxel of the prior's grids."""
        if self.prior is None:
            return self.kernel_length
        return min(self.kernel_length, self.prior.voxel)

    @property
    def cutoff_radius(self) -> float:
        """Distance from a hinge beyond which it has no say, m."""
        return self.space.radius

    def support_bounds(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return the corners (m) of a box outside which `support` is exactly 0, and the prior's
        grids call everything empty: nothing of the objects is beyond it."""
        if len(self.space.hinges) == 0:
            return np.zeros(3), np.zeros(3)
        lower, upper = self.space.bounds
        if self.prior is None:
            return lower.copy(), upper.copy()
        low, high = self.prior.box
        return np.minimum(lower, low), np.maximum(upper, high)

    @cached_property
    def unsupported_occupancy(self) -> float:
        """P(occupied) where no hinge reaches, so that only the bias weights act."""
        mean, variance = self._bias_moments[0].copy(), self._bias_moments[1]
        if self.prior is not None:
            mean[1:] += float(self.prior.elsewhere.max())
        return float(np.exp(self._normalised(mean[None], variance[None])[0, 1:]).sum())

    def shown(self) -> Float[np.ndarray, "n 3"]:
        """Return the points (m) that were labelled as objects; of an empty table two corners of a
        box, around the middle half of what was seen of it."""
        seen = [view.points() for view in self.views]
        if self.object_ids or self.plane is None or not seen:
            return np.concatenate([np.empty((0, 3)), *(p[labels > 0] for p, labels in seen)])
        points = np.concatenate([p for p, _ in seen])
        points = points[np.abs(self.plane.signed_distance(points)) < _ON_PLANE]
        return np.quantile(points, [0.25, 0.75], axis=0) if len(points) else points

    # ------------------------------------------------------------------ predictions
    def predict_proba(self, points: Any) -> Any:
        """Return P(class | x) for points (N, 3) m: (N, K), every row sums to 1.

        Torch in, torch out (same device and dtype, once differentiable); anything else
        is taken as a numpy array and gives float64 numpy. Normalised approximation of
        section IV-B. MapError on a wrong shape or a value that is not finite.
        """
        log_p = self._log_probabilities(points)
        return log_p.exp().to(points.dtype) if isinstance(log_p, Tensor) else np.exp(log_p)

    def log_proba_and_support(self, points: Any) -> tuple[Any, Any]:
        """Return log P(class | x), (N, K), and the kernel mass, (N,), at points (N, 3) m.

        Arguments as for `predict_proba`. Keeps its digits, and its gradient, where a
        probability has rounded to 0 or 1.
        """
        if isinstance(points, Tensor):
            mean, variance, support = self._torch_moments(points)
            log_p = prediction.class_log_probabilities(mean, variance)
            return log_p.to(points.dtype), support.to(points.dtype)
        moments = self._moments(_checked_points(points))
        return self._normalised(*moments[:2]), moments[2]

    def occupancy(self, points: Any) -> Any:
        """Return P(occupied) = 1 - P(class 0) for points (N, 3) m: (N,)."""
        log_p = self._log_probabilities(points)[:, 1:]  # the sum keeps digits that 1 - p loses
        if isinstance(log_p, Tensor):
            return log_p.exp().sum(dim=1).to(points.dtype)
        return np.exp(log_p).sum(axis=1)

    def entropy(self, points: Any) -> Any:
        """Return the entropy (nats) of the class probabilities at points (N, 3) m: (N,)."""
        log_p = self._log_probabilities(points)
        if isinstance(log_p, Tensor):
            return (0.0 - (log_p.exp() * log_p).sum(dim=1)).to(points.dtype)
        return 0.0 - (np.exp(log_p) * log_p).sum(axis=1)

    def support(self, points: Any) -> Any:
        """Return the kernel mass at points (N, 3) m: the sum of all kernel values, no bias: (N,).

        0 means that the map knows nothing there but its prior.
        """
        if isinstance(points, Tensor):
            return self._torch_moments(points)[2].to(points.dtype)
        return self._moments(_checked_points(points))[2]

    def judges(self, points: Any, min_support: float) -> Bool[np.ndarray, " n"]:
        """Return where the map has more to say of points (N, 3) m than "nobody knows": (N,).

        Where kernels reach (their mass is at least `min_support`), or the package's prior has
        looked: around every object.
        """
        points = np.asarray(points)
        # A hypothesis of the user's own says nothing of what else hides around an object.
        own = self.prior is not None and self.prior.own
        known = np.zeros(len(points), bool) if own else self.informed(points)
        known[~known] = np.asarray(self.support(points[~known])) >= min_support
        return known

    def informed(self, points: Any) -> Bool[np.ndarray, " n"]:
        """Return where P(occupied) of points (N, 3) m says what is there, and not what a flat prior
        says of everything: where a prior has looked, (N,)."""
        points = np.asarray(points)
        return np.zeros(len(points), bool) if self.prior is None else self.prior.covers(points)

    def doubts(self, points: Any) -> Bool[np.ndarray, " n"]:
        """Return where a prior has looked (`informed`) and is not as sure as it can be that
        nothing is there, as it is of all that was seen to be empty, (N,)."""
        points = np.asarray(points)
        if self.prior is None:
            return np.zeros(len(points), bool)
        return self.prior.covers(points) & (self.prior.at(points)[:, 1:].max(axis=1) > _SURE)

    def logit_moments(self, points: Any) -> tuple[Logits, Logits]:
        """Return mean and variance of every class's logit at points (N, 3) m: two (N, K)."""
        mean, variance, _ = self._moments(_checked_points(points))
        return mean, variance

    def occupancy_log_odds(self, points: Any) -> Float[np.ndarray, " n"]:
        """Return log(P(occupied) / P(empty)) at points (N, 3) m, cut off at +-40: (N,)."""
        mean, variance, _ = self._moments(_checked_points(points))
        out = np.empty(len(mean))

        def chunk(piece: slice) -> None:
            kernels.normalised_log_odds(mean, variance, piece.start, piece.stop, MAX_LOG_ODDS, out)

        run_chunked(chunk, len(out), 4096)
        return out

    def sample_weights(self, n: int, seed: int) -> Float[np.ndarray, "n m k"]:
        """Draw n joint samples of all weights: (n, M, K), features in hinge order, bias last.

        The logits of draw s at x are `phi(x) @ result[s]`, and those of `prior`. Weights that a
        class does not have are 0. The same seed gives the same draws. Classes are independent
        under the posterior, features are not.
        """
        if n < 1:
            raise MapError(f"n is {n}; ask for at least 1 draw")
        rng = np.random.default_rng(seed)
        out = np.zeros((n, self.space.size, self.n_classes))
        noise = [rng.standard_normal((own.space.size, n)) for own in self.posterior.classes]

        def draw(k: int) -> None:
            own = self.posterior.classes[k]
            drawn = correlate(own.space, own.precision, noise[k]) + own.mean[:, None]
            out[:, own.members, k] = drawn.T

        run_per_class(draw, self.n_classes)
        return out

    # ------------------------------------------------------------------ learning, files
    def update(
        self, observation: Observation, prior: Any = "shape", forget: float | None = None
    ) -> "VPrismMap":
        """Return a new map that has also seen `observation` (labelled, in the same world frame).

        Where it contradicts the views before, it is right, and they are of another time: objects
        that are seen not to be where they were are taken out of them, and their rays end before
        what has come since; what that hides from the new view is hidden. `changes` says which
        objects moved, left and came. Labels are matched by place, and by size and colour of what
        moved; new objects whose label is another's id get one of their own.

        Args:
            observation: the newest view.
            prior: see below.
            forget: seconds after which evidence is too old: it goes, and its place is hidden. Every
                view needs a `time`.

        Without a prior of the hidden side the old posterior is the prior of the new one; hinge
        points for ground the old map did not reach enter with the configured prior. If the view
        shows objects the map does not know, or the map has a `prior`, whose guess more views
        change, all views are fitted again together; `prior` is then that of `fit_map`: one of your
        own has to be given again.

        Raises:
            ObservationError: the view has no labels or no objects, lies off the others by more
                than 5 cm, or a time is missing.
            MapError: the map was made with a prior of your own, and it is not given.
        """
        from vprism_plan.mapping.fitting import update_map

        return update_map(self, observation, prior, forget)

    def save(self, path: str | Path) -> None:
        """Write the map, views included, to a safetensors file; complete or not at all."""
        from vprism_plan.mapping.serialization import save_map

        save_map(self, path)

    # ------------------------------------------------------------------ inside
    def _moments(self, points: Points) -> tuple[Logits, Logits, Values]:
        """Return logit mean, variance and kernel mass; threads over blocks of near points."""
        n = len(points)
        mean, variance = np.empty((n, self.n_classes)), np.empty((n, self.n_classes))
        mean[:], variance[:] = self._bias_moments
        support, unused = np.zeros(n), np.empty(n)
        lower, upper = self.space.bounds
        inside = np.flatnonzero(((points > lower) & (points < upper)).all(axis=1))
        if len(inside):
            order, block_start = make_blocks(points[inside], block_extent(self.space))
            order = inside[order]
            for k, own in enumerate(self.posterior.classes):
                space, mass = own.space, support if k == 0 else unused

                def chunk(
                    piece: slice, k: int = k, own: Weights = own,
                    space: FeatureSpace = space, mass: np.ndarray = mass,
                ) -> None:  # fmt: skip
                    kernels.point_moments(
                        points, order, block_start, piece.start, piece.stop,
                        *space.kernel_arguments, space.gamma, space.radius**2,
                        own.mean, own.covariance, space.row_first, space.base, k,
                        mean, variance, mass,
                    )  # fmt: skip

                run_chunked(chunk, len(block_start) - 1, 64)
        if self.prior is not None:
            mean += self.prior.at(points)
        return mean, variance, support

    @cached_property
    def _bias_moments(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Mean and variance of every logit where no hinge reaches."""
        classes = self.posterior.classes
        mean = np.array([own.mean[-1] for own in classes])
        return mean, np.array([own.covariance[-1] for own in classes])

    def _log_probabilities(self, points: Any) -> Any:
        """Log P(class | x), (N, K) float64: a tensor for a tensor, else an array."""
        if isinstance(points, Tensor):
            return prediction.class_log_probabilities(*self._torch_moments(points)[:2])
        return self._normalised(*self._moments(_checked_points(points))[:2])

    def _normalised(self, mean: Logits, variance: Logits) -> Logits:
        out = np.empty_like(mean)

        def chunk(piece: slice) -> None:
            kernels.normalised_log_probabilities(mean, variance, piece.start, piece.stop, out)

        run_chunked(chunk, len(out), 4096)
        return out

    def _torch_moments(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return moments and kernel mass, float64, attached to the points' graph."""
        if not points.is_floating_point():
            raise MapError(f"points have dtype {points.dtype}; use float32 or float64")
        _check_shape(tuple(points.shape))
        if not bool(torch.isfinite(points).all()):
            raise MapError("points hold NaN or infinity; every coordinate must be finite (m)")
        kind = points.device.type
        exact = points.to(torch.float32 if kind == "mps" else torch.float64)  # mps has no float64
        if kind != "cpu":
            moments = self._dense_moments(exact)
        elif points.requires_grad and torch.is_grad_enabled():
            moments = prediction.LogitMoments.apply(exact, self.posterior.classes)
        else:
            m = self._moments(exact.detach().contiguous().numpy())
            return torch.from_numpy(m[0]), torch.from_numpy(m[1]), torch.from_numpy(m[2])
        mean, variance, support = moments
        if self.prior is not None:
            mean = mean + self.prior.logits(exact)
        return mean, variance, support

    def _dense_moments(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate on the points' own device with plain torch."""
        arrays = self._device_arrays(points.device, points.dtype)
        return prediction.dense_moments(points, *arrays, self.space.gamma, self.space.radius)

    def _device_arrays(
        self, device: torch.device, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor, Tensor]:
        cache = self.__dict__.setdefault("_arrays_on", {})
        if (device, dtype) not in cache:
            size = self.space.size
            covariance = np.zeros((self.n_classes, size, size))
            for matrix, own in zip(covariance, self.posterior.classes, strict=True):
                matrix[np.ix_(own.members, own.members)] = dense(own.space, own.covariance)
            cache[device, dtype] = tuple(
                torch.from_numpy(np.ascontiguousarray(a)).to(device, dtype)
                for a in (self.space.hinges, self.posterior.mean, covariance)
            )
        return cache[device, dtype]


def nothing(
    config: MapConfig | None = None,
    plane: Plane | None = None,
    views: tuple[Observation, ...] = (),
    seed: int = 0,
    warnings: tuple[str, ...] = (),
) -> VPrismMap:
    """Return a map without objects: every place is empty, and it has no hinge points."""
    config = MapConfig() if config is None else config
    space = FeatureSpace(np.zeros((0, 3)), config.gamma, config.cutoff_radius)
    empty = Posterior(diagonal_prior(space, np.zeros((1, 1)), np.ones(1)), ())
    return VPrismMap(config, (), plane, views, space, empty, seed, warnings)


def _check_shape(shape: tuple[int, ...]) -> None:
    if len(shape) != 2 or shape[1] != 3:
        raise MapError(f"points have shape {shape}; they must be (N, 3), world coordinates in m")


def _checked_points(points: Any) -> Float[np.ndarray, "n 3"]:
    try:
        array = np.require(points, np.float64, ["C", "W"])
    except (TypeError, ValueError) as error:
        raise MapError(f"points cannot be read as numbers: {error}; pass (N, 3) metres") from error
    _check_shape(array.shape)
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise MapError(
            f"points[{row}] is {array[row].tolist()}; every coordinate must be finite (m)"
        )
    return array
