# SPDX-License-Identifier: BSD-3-Clause
"""Every number the map depends on, in one frozen and validated place."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from vprism_plan._arguments import choice, number, whole
from vprism_plan.errors import ConfigError

RaySampling = Literal["stratified", "steps", "whole"]


_POSITIVE = (
    "gamma", "hinge_spacing", "hinge_radius", "prior_logit_variance", "prior_weight_variance",
    "prior_seen_variance", "prior_hidden_variance", "bias_variance", "object_radius", "ray_step",
    "object_resolution", "empty_resolution", "front_distance", "front_resolution",
    "start_variance",
)  # fmt: skip
_NOT_NEGATIVE = (
    "hinge_margin", "hinge_depth", "hinge_reach", "class_reach", "tolerance", "below_plane_margin",
)  # fmt: skip
_WHOLE = {
    "surface_hinges": 0, "iterations": 1, "guessed_iterations": 1,
    "variational_updates": 1, "below_plane_samples": 0,
    "max_points": 1, "max_hinges": 1,
}  # fmt: skip
_OPTIONAL = frozenset(
    {"hinge_depth", "prior_logit_variance", "prior_weight_variance", "prior_occupancy"}
    | {"front_distance", "hinge_reach", "object_resolution", "empty_resolution"}
    | {"prior_hidden_variance", "class_reach"}
)


@dataclass(frozen=True)
class MapConfig:
    """Parameters of a V-PRISM map; `MapConfig.paper()` is Table III of the paper.

    The default is calibrated for planning on generated scenes with known geometry
    (`docs/results/calibration.md` has the numbers): a finer lattice and no other
    hinges, a prior stated as a logit variance, negatives just in front of each observed
    surface, and an empty prior that reads the same whatever the number of objects.
    Lengths are in metres.

    Kernel
        gamma: Gaussian kernel exp(-gamma r^2), 1/m^2; length 1/sqrt(2 gamma).
        kernel_cutoff: kernel values below this are exactly 0.
    Hinge points
        hinge_spacing: edge of the lattice cell, m. It decides how much the answers
            depend on where the lattice happens to lie. Shifted by half a cell, the risk of
            a path 5 mm or more behind a ball moves by at most 0.1 (the default, 1.5 kernel
            lengths) or 0.01 (`fine`, 1.25); of one that just touches, where a millimetre
            decides, by up to 0.4 and 0.1 (`docs/results/lattice.md`).
        hinge_shift: offset of the lattice from multiples of the spacing, m.
        hinge_radius: lattice nodes are kept this near an object's box centre, m ...
        hinge_margin: ... or this near its axis-aligned box, m.
        box_trim: share of an object's points left out of its box at each end of each
            axis. Flying pixels at depth edges otherwise stretch boxes, and with them the
            lattice and the negative samples, by several times (the paper: 0).
        stray_share: object points with fewer neighbours than this share of the object's
            median are flying pixels and not learned from (the paper: 0, keep all).
        hinge_depth: nodes deeper than this under the plane are dropped, m; None keeps all.
        hinge_reach: nodes in space that was seen to be empty are dropped when farther than
            this from every observed object point and not beside hidden space, m; at least
            two kernel lengths, or surfaces move. None keeps all (the paper). A quarter of
            the lattice tells only what the depth image tells, and the fit's cost grows
            with the cube of its nodes.
        class_reach: around a guess of the hidden side an object has the hinges at most this
            far from its box, m; elsewhere its logit is the guess, and only "empty" learns.
            With None, or without a guess, it has all of them (the paper).
        surface_hinges: random surface points taken as hinges, per object. Where the
            lattice is coarse they add detail; where it is fine they add prior variance
            in random places, and lose accuracy.
        max_hinges: more are never built (memory and time grow with them faster than they
            do). Where a scene needs more, spacing and kernel grow together until it does not,
            and the map warns of it; its `config` holds what was used.
    Learning
        iterations: EM iterations at most ...
        guessed_iterations: ... and around a guess of the hidden side, near which it starts.
        variational_updates: alternations of alpha and xi per iteration (the paper: 1).
            They cost no matrix work and only ever raise the bound.
        relaxation: how many times as far as EM's own step every iteration goes (the
            paper: 1). At 1.9 six iterations reach the bound of fourteen; steps that
            lower the bound are taken back.
        start_variance: variance that logits are first taken to have around a guess of the
            hidden side, which starts EM near its end. Without a guess it starts from xi = 1.
        tolerance: stop when the bound rises by less than this share of itself.
        prior_logit_variance: prior variance v of one class's logit, averaged over a
            lattice cell. The weights get v / S, S = (pi / (2 gamma))^(3/2) / spacing^3,
            the mean over a cell of the sum of squared features, so that the prior
            means the same at every spacing.
        prior_weight_variance: the same stated on the weights (the paper). Exactly one
            of the two is set.
        prior_seen_variance, prior_hidden_variance: prior variance of a logit where a prior
            guesses its mean: of nodes in front of what was seen, and of those behind it.
            With None for the latter no prior is asked (the paper).
        prior_depths: between these depths behind what was seen, m, the variance changes
            from the one to the other.
        bias_variance: prior variance of the bias weight. The bias is all that acts
            where no hinge reaches; left free, it learns the mix of the training points
            and then claims to know unseen space. The default pins it to its prior mean.
        prior_occupancy: P(occupied) of a flat posterior, both inside the lattice and
            out of its reach, whatever the number of objects; None leaves the prior
            means at 0, where P(occupied) = 1 - 1/K.
    Negative samples
        object_radius: r_obj, m; negatives are kept this near an object's box centre.
        ray_step: length of a stratum along a camera ray, m; one sample in each.
        ray_sampling: "stratified" draws each sample anywhere in its stratum. The others
            are what the paper compares with: "steps" puts it at the near end of the
            stratum, the same for every ray; "whole" draws one per ray, anywhere between
            camera and surface, near an object or not (as Bayesian Hilbert maps do).
        below_plane_samples: samples in the ball of r_obj around each box centre, of
            which those under the plane are kept.
        below_plane_margin: "under" means at least this far below the plane, m.
        object_resolution, empty_resolution: grid subsampling per label, m; None for none.
        front_distance: extra negatives this far in front of each observed object
            point, m; None for none (the paper).
        front_resolution: grid that thins those, m.
        max_points: empty points above this total are dropped at random.
    """

    gamma: float = 1500.0
    kernel_cutoff: float = 1e-4
    hinge_spacing: float = 0.028
    hinge_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hinge_radius: float = 0.12
    hinge_margin: float = 0.08
    hinge_depth: float | None = 0.05
    hinge_reach: float | None = 0.04
    class_reach: float | None = 0.05
    box_trim: float = 0.01
    stray_share: float = 0.03
    surface_hinges: int = 0
    max_hinges: int = 5000
    iterations: int = 6
    guessed_iterations: int = 4
    variational_updates: int = 3
    relaxation: float = 1.9
    start_variance: float = 10.0
    tolerance: float = 1e-5
    prior_logit_variance: float | None = 20.0
    prior_weight_variance: float | None = None
    prior_seen_variance: float = 10.0
    prior_hidden_variance: float | None = 0.25
    prior_depths: tuple[float, float] = (-0.01, 0.02)
    bias_variance: float = 1e-8
    prior_occupancy: float | None = 0.2
    object_radius: float = 0.25
    ray_step: float = 0.1
    ray_sampling: RaySampling = "stratified"
    below_plane_samples: int = 4000
    below_plane_margin: float = 0.0
    object_resolution: float | None = 0.007
    empty_resolution: float | None = 0.015
    front_distance: float | None = 0.005
    front_resolution: float = 0.007
    max_points: int = 150_000

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            given = f"MapConfig.{name}"
            if value is None and name in _OPTIONAL:
                continue
            if name in _POSITIVE:
                number(given, value, 0.0, above=True)
            elif name in _NOT_NEGATIVE:
                number(given, value, 0.0)
            elif name in _WHOLE:
                whole(given, value, _WHOLE[name])
            elif name in {"kernel_cutoff", "prior_occupancy"}:
                number(given, value, 0.0, 1.0, above=True, below=True)
        number("MapConfig.box_trim", self.box_trim, 0.0, 0.25, below=True)
        number("MapConfig.stray_share", self.stray_share, 0.0, 1.0, below=True)
        number("MapConfig.relaxation", self.relaxation, 1.0, 2.0, below=True)
        choice("MapConfig.ray_sampling", self.ray_sampling, get_args(RaySampling))
        for name, count in (("hinge_shift", 3), ("prior_depths", 2)):
            lengths = tuple(number(f"MapConfig.{name}", v, unit="m") for v in getattr(self, name))
            if len(lengths) != count:
                raise ConfigError(f"MapConfig.{name} is {lengths}; it must be {count} lengths (m)")
            object.__setattr__(self, name, lengths)
        if not self.prior_depths[0] < self.prior_depths[1]:
            raise ConfigError(
                f"MapConfig.prior_depths is {self.prior_depths}; the first must be the smaller"
            )
        if (self.prior_logit_variance is None) == (self.prior_weight_variance is None):
            raise ConfigError(
                "MapConfig takes exactly one of prior_logit_variance "
                f"({self.prior_logit_variance!r}) and prior_weight_variance "
                f"({self.prior_weight_variance!r}); set the other to None"
            )

    @classmethod
    def paper(cls) -> "MapConfig":
        """Return the paper's Table III; what it leaves open is as in the published code.

        Left open by the paper: prior variance (1e4 on every weight, the bias
        included), the hinges' extent (0.15 m around each box centre), the stratum
        (0.1 m). Prior means are 0, so a flat posterior says P(occupied) = 1 - 1/K.
        """
        # Every field by name: another default is not another paper.
        return cls(
            gamma=1000.0,
            kernel_cutoff=1e-5,
            hinge_spacing=0.05,
            hinge_shift=(0.0, 0.0, 0.0),
            hinge_radius=0.15,
            hinge_margin=0.0,
            hinge_depth=None,
            hinge_reach=None,
            class_reach=None,
            box_trim=0.0,
            stray_share=0.0,
            surface_hinges=32,
            max_hinges=6000,
            iterations=3,
            guessed_iterations=3,
            variational_updates=1,
            relaxation=1.0,
            start_variance=1.0,
            tolerance=0.0,
            prior_logit_variance=None,
            prior_weight_variance=1e4,
            prior_seen_variance=10.0,
            prior_hidden_variance=None,
            prior_depths=(-0.01, 0.02),
            bias_variance=1e4,
            prior_occupancy=None,
            object_radius=0.25,
            ray_step=0.1,
            ray_sampling="stratified",
            below_plane_samples=4000,
            below_plane_margin=0.0,
            object_resolution=0.01,
            empty_resolution=0.015,
            front_distance=None,
            front_resolution=0.007,
            max_points=150_000,
        )

    @classmethod
    def fine(cls) -> "MapConfig":
        """Return a lattice whose place hardly matters, for risks that have to be exact.

        A wider kernel (2.2 cm) and a spacing of 1.25 of its lengths instead of 1.5, nearer
        to convergence. It blurs surfaces more than the default (`docs/decisions.md`) and
        takes about three times its fitting time.
        """
        return cls(
            gamma=1000.0,
            kernel_cutoff=1e-5,
            hinge_spacing=0.028,
            hinge_reach=None,
            iterations=10,
            guessed_iterations=10,
            prior_logit_variance=10.0,
            object_resolution=0.01,
            front_resolution=0.01,
        )

    @property
    def kernel_length(self) -> float:
        """Length scale of the kernel, m: 1 / sqrt(2 gamma)."""
        return 1.0 / math.sqrt(2.0 * self.gamma)

    @property
    def cutoff_radius(self) -> float:
        """Distance beyond which a feature is exactly 0, m."""
        return math.sqrt(-math.log(self.kernel_cutoff) / self.gamma)

    @property
    def mean_squared_feature_sum(self) -> float:
        """Mean over a lattice cell of the sum of squared features (see the class)."""
        return (math.pi / (2.0 * self.gamma)) ** 1.5 / self.hinge_spacing**3

    @property
    def mean_feature_sum(self) -> float:
        """Mean over a lattice cell of the sum of features."""
        return (math.pi / self.gamma) ** 1.5 / self.hinge_spacing**3

    @property
    def weight_variance(self) -> float:
        """Prior variance of a hinge weight, from whichever way it was stated."""
        if self.prior_weight_variance is not None:
            return self.prior_weight_variance
        assert self.prior_logit_variance is not None
        return self.prior_logit_variance / self.mean_squared_feature_sum

    @property
    def logit_variance(self) -> float:
        """Prior variance of a logit inside the lattice, from whichever way it was stated."""
        if self.prior_logit_variance is not None:
            return self.prior_logit_variance
        return self.weight_variance * self.mean_squared_feature_sum
