# SPDX-License-Identifier: BSD-3-Clause
"""Which pairs of links are tested against each other, and why others are not."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.random import Generator

from vprism_plan._arguments import whole
from vprism_plan._shapes import Configurations, Pairs, Values
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import KinematicArrays, frame_poses, only_links, place
from vprism_plan.robots.sphere_files import ChosenSpheres
from vprism_plan.robots.srdf import RIGID
from vprism_plan.robots.urdf import RobotModel

Reasons = dict[frozenset[str], str]  # unordered pair of links -> why it is not tested
ADJACENT, ALWAYS, NEVER = "Adjacent", "Always", "Never"
SAMPLES = 10_000
# "Never" asks for so much room in every sample, metres, and after a search for less.
ROOM = 0.05
_CHUNK = 1000
_STARTS, _SCALES = 8, (0.1, 0.05, 0.03, 0.02, 0.01)
_FITTED_SAMPLES = 300
_logger = logging.getLogger(__name__)


def choose_pairs(
    model: RobotModel,
    arrays: KinematicArrays,
    chosen: ChosenSpheres,
    stated: Mapping[frozenset[str], str] | None,
    samples: int,
) -> tuple[Pairs, Reasons, Reasons]:
    """Which pairs of links are tested: all but adjacent, rigid and disabled ones, and those that
    random configurations show to need no test.

    Args:
        model, arrays, chosen: The robot, and its spheres.
        stated: The pairs that an SRDF disables; None where there is no SRDF.
        samples: Random configurations, where there is none.

    Returns:
        The tested pairs, first < second, sorted; all others with the reasons; and of these the
        ones that random configurations showed.
    """
    names = tuple(chosen.rows)
    everything = list(combinations(range(len(names)), 2))
    built = {
        frozenset((names[a], names[b])): RIGID
        for a, b in everything
        if arrays.link_frame[a] == arrays.link_frame[b]
    } | dict.fromkeys(_adjacent(model, set(names)), ADJACENT)
    known = built | dict(stated or {})
    left = [(a, b) for a, b in everything if frozenset((names[a], names[b])) not in known]
    pairs = np.array(left, dtype=np.int64).reshape(-1, 2)
    if stated is not None:
        sampled = _touching_fits(arrays, pairs, chosen)
    else:
        whole("matrix_samples", samples, 1, error=RobotError)
        sampled = sampled_reasons(arrays, pairs, names, samples)
        always = [tuple(sorted(pair)) for pair, why in sampled.items() if why == ALWAYS]
        if always:
            _logger.warning(
                "not tested for self-collision, their spheres always overlap: %s", always
            )
    kept = [frozenset((names[a], names[b])) not in sampled for a, b in pairs]
    return np.ascontiguousarray(pairs[kept]), known | sampled, sampled


def _adjacent(model: RobotModel, bodies: set[str]) -> set[frozenset[str]]:
    """Each collision link with its nearest ancestor that is one too."""
    nearest = ([name for name in model.above(link) if name in bodies][:2] for link in bodies)
    return {frozenset(pair) for pair in nearest if len(pair) == 2}


def _touching_fits(arrays: KinematicArrays, pairs: Pairs, chosen: ChosenSpheres) -> Reasons:
    """Pairs that an SRDF wants tested, and whose fitted spheres overlap in every pose."""
    names = tuple(chosen.rows)
    made = np.array([chosen.sources[name] in ("fitted", "tiled") for name in names])
    fitted = pairs[made[pairs].any(axis=1)]
    q = _zero_and_random(arrays, _FITTED_SAMPLES, np.random.default_rng(0))
    touching = fitted[pairs_touching(arrays, q, fitted).all(axis=0)]
    if len(touching):
        _logger.warning(
            "the SRDF tests pairs whose fitted spheres always overlap; they are not tested: %s; "
            "a smaller tolerance (fit=) may part them",
            [(names[a], names[b]) for a, b in touching],
        )
    return _named(touching, names, ALWAYS)


def hangs_on(model: RobotModel, joints: Collection[str], pair: frozenset[str]) -> bool:
    """Whether any of these joints, or one that mimics it, moves two links against each other."""
    first, second = (set(model.above(link)) for link in pair)
    # What is above both moves neither against the other.
    between = [model.joint_above[link].name for link in first ^ second]
    return any(model.resolve_mimic(name)[0] in joints for name in between)


def sampled_reasons(
    arrays: KinematicArrays, pairs: Pairs, names: Sequence[str], samples: int
) -> Reasons:
    """Pairs that overlap always, and pairs that never come near each other.

    "Always": the spheres overlap at the joints' zero and in every random configuration, because
    of how the links are built or how coarse the spheres are; testing it would refuse every
    pose. "Never": the spheres are 5 cm apart in every one, and stay so when the joints are moved
    downhill from the nearest. A sample proves neither, so what is in between stays tested.
    """
    rng = np.random.default_rng(0)
    q = _zero_and_random(arrays, samples - 1, rng)
    always, far = np.ones(len(pairs), dtype=bool), np.ones(len(pairs), dtype=bool)
    nearest = np.full((len(pairs), _STARTS), np.inf)
    starts = np.zeros((len(pairs), _STARTS, len(arrays.lower)))
    for begin in range(0, len(q), _CHUNK):
        part = q[begin : begin + _CHUNK]
        # What was seen apart once and near once stays tested: nothing more to learn.
        waiting = np.flatnonzero(always | far)
        gaps = pair_gaps(arrays, part, pairs[waiting])
        always[waiting] &= (gaps < 0.0).all(axis=0)
        far[waiting] &= (gaps > ROOM).all(axis=0)
        rows = np.argsort(gaps, axis=0, kind="stable")[:_STARTS].T
        found = np.concatenate([nearest[waiting], gaps.T[np.arange(len(rows))[:, None], rows]], 1)
        order = np.argsort(found, axis=1, kind="stable")[:, :_STARTS]
        candidates = np.concatenate([starts[waiting], part[rows]], axis=1)
        nearest[waiting] = np.take_along_axis(found, order, axis=1)
        starts[waiting] = np.take_along_axis(candidates, order[:, :, None], axis=1)
    apart = np.flatnonzero(far)
    far[apart] = _least_gaps(arrays, starts[apart], pairs[apart], rng) > ROOM
    return _named(pairs[always], names, ALWAYS) | _named(pairs[far], names, NEVER)


def _named(pairs: Pairs, names: Sequence[str], reason: str) -> Reasons:
    return {frozenset((names[a], names[b])): reason for a, b in pairs}


def pair_room(arrays: KinematicArrays, pairs: Pairs) -> Values:
    """Metres by which the gap of each pair exceeds that of its spheres."""
    return np.asarray((arrays.link_padding - arrays.link_buffer)[pairs].sum(axis=1))


def pair_gaps(arrays: KinematicArrays, q: Configurations, pairs: Pairs) -> np.ndarray:
    """Distance between the spheres of two links in each configuration, padding not counted.

    Beyond :data:`ROOM` it is a lower bound: that of the balls around the links' spheres.
    """
    poses = frame_poses(arrays, q)
    spheres = place(poses, arrays.sphere_frame, arrays.sphere_center)
    balls = place(poses, arrays.link_frame, arrays.link_center)
    gaps = np.linalg.norm(balls[:, pairs[:, 0]] - balls[:, pairs[:, 1]], axis=2)
    gaps -= arrays.link_radius[pairs].sum(axis=1)
    room = pair_room(arrays, pairs)
    gaps += room
    for k in np.flatnonzero((gaps <= ROOM).any(axis=0)):
        near = np.flatnonzero(gaps[:, k] <= ROOM)
        a, b = (slice(arrays.link_start[i], arrays.link_start[i + 1]) for i in pairs[k])
        apart = np.linalg.norm(spheres[near, a][:, :, None] - spheres[near, b][:, None], axis=3)
        apart -= arrays.sphere_radius[a, None] + arrays.sphere_radius[b]
        gaps[near, k] = apart.min(axis=(1, 2)) + room[k]
    return gaps


def _least_gaps(
    arrays: KinematicArrays, starts: np.ndarray, pairs: Pairs, rng: Generator
) -> Values:
    """The smallest gaps that random steps downhill from these configurations lead to."""
    span, least = arrays.upper - arrays.lower, np.full(len(pairs), np.inf)
    both = np.array([[0, 1]])
    for k, pair in enumerate(pairs):
        small = only_links(arrays, pair)
        # Every start carries the same steps at once; the nearest is where the next begin.
        best = starts[k, 0]
        for scale in _SCALES:
            steps = scale * span * rng.normal(size=(_STARTS * 8, len(span)))
            around = np.clip(np.vstack([starts[k], best + steps]), arrays.lower, arrays.upper)
            gaps = pair_gaps(small, around, both)[:, 0]
            best = around[int(gaps.argmin())]
            least[k] = min(least[k], float(gaps.min()))
            if least[k] <= ROOM:
                break
    return least


def pairs_touching(arrays: KinematicArrays, q: Configurations, pairs: Pairs) -> np.ndarray:
    """Whether any spheres of each pair overlap in each configuration, padding not counted."""
    return pair_gaps(arrays, q, pairs) < 0.0


def touching_pairs(
    arrays: KinematicArrays, q: Values, names: Sequence[str]
) -> set[tuple[str, str]]:
    """Names of the tested pairs whose spheres overlap at one configuration."""
    touching = pairs_touching(arrays, q[None], arrays.pairs)[0]
    return {(names[a], names[b]) for a, b in arrays.pairs[touching]}


def random_configurations(arrays: KinematicArrays, n: int, rng: Generator) -> Configurations:
    """Uniform configurations within the limits."""
    return rng.uniform(arrays.lower, arrays.upper, size=(n, len(arrays.lower)))


def _zero_and_random(arrays: KinematicArrays, n: int, rng: Generator) -> Configurations:
    """The joints' zero, or the limit next to it, and n random configurations."""
    at_zero = np.clip(np.zeros(len(arrays.lower)), arrays.lower, arrays.upper)
    return np.vstack([at_zero, random_configurations(arrays, n, rng)])
