# SPDX-License-Identifier: BSD-3-Clause
"""Which pairs of links are worth testing against each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._frames import Attachment, place_spheres
from vprism_plan.robots._model import RobotModel

_SAMPLES = 300


def candidate_pairs(
    model: RobotModel,
    links: Mapping[str, Attachment],
    collision_links: Sequence[str],
    disabled: Iterable[frozenset[str]],
) -> Int[np.ndarray, "pairs 2"]:
    """All pairs of links, minus those that touch by construction or are disabled.

    Left out are links that no joint moves against each other, links joined by one
    joint (also through links without spheres), and ``disabled`` pairs.

    Returns:
        (P, 2) indices into ``collision_links``, first < second, sorted.
    """
    skipped = set(disabled) | adjacent_pairs(model, set(collision_links))
    pairs = [
        (i, j)
        for i in range(len(collision_links))
        for j in range(i + 1, len(collision_links))
        if links[collision_links[i]].frame != links[collision_links[j]].frame
        and frozenset((collision_links[i], collision_links[j])) not in skipped
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def adjacent_pairs(model: RobotModel, bodies: set[str]) -> set[frozenset[str]]:
    """Each collision link with its nearest ancestor that is one too."""
    above = {joint.child: joint.parent for joint in model.joints}
    pairs = set()
    for link in bodies:
        parent = above.get(link)
        while parent is not None and parent not in bodies:
            parent = above.get(parent)
        if parent is not None:
            pairs.add(frozenset((link, parent)))
    return pairs


def pairs_touching(
    arrays: KinematicArrays, q: Float[np.ndarray, "n dof"], pairs: Int[np.ndarray, "pairs 2"]
) -> Bool[np.ndarray, "n pairs"]:
    """For each configuration and link pair, whether any of their spheres overlap, padding
    not counted."""
    centers = place_spheres(arrays, q)
    touching = np.zeros((len(q), len(pairs)), dtype=bool)
    for k, (a, b) in enumerate(pairs):
        of_a = slice(arrays.link_start[a], arrays.link_start[a + 1])
        of_b = slice(arrays.link_start[b], arrays.link_start[b + 1])
        gap = np.linalg.norm(centers[:, of_a, None] - centers[:, None, of_b], axis=-1)
        reach = arrays.sphere_radius[of_a, None] + arrays.sphere_radius[None, of_b]
        reach -= arrays.link_padding[a] + arrays.link_padding[b]
        touching[:, k] = (gap < reach).any(axis=(1, 2))
    return touching


def touching_pairs(
    arrays: KinematicArrays, q: Float[np.ndarray, "dof"], names: Sequence[str]
) -> set[tuple[str, str]]:
    """Names of the tested pairs whose spheres overlap at one configuration."""
    touching = pairs_touching(arrays, q[None], arrays.pairs)[0]
    return {(names[a], names[b]) for a, b in arrays.pairs[touching]}


def random_configurations(
    arrays: KinematicArrays, n: int, rng: np.random.Generator
) -> Float[np.ndarray, "n dof"]:
    """Uniform configurations within the limits."""
    return rng.uniform(arrays.lower, arrays.upper, size=(n, len(arrays.lower)))


def always_touching(
    arrays: KinematicArrays, pairs: Int[np.ndarray, "pairs 2"]
) -> Bool[np.ndarray, "pairs"]:
    """Pairs whose spheres overlap at the joints' zero and in 300 random configurations."""
    samples = random_configurations(arrays, _SAMPLES, np.random.default_rng(0))
    at_zero = np.clip(np.zeros(len(arrays.lower)), arrays.lower, arrays.upper)
    return np.asarray(pairs_touching(arrays, np.vstack([at_zero, samples]), pairs).all(axis=0))
