# SPDX-License-Identifier: BSD-3-Clause
"""Which link pairs need no test where no SRDF says so: sampled, with the reason for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._files import write_text
from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._frames import frame_poses
from vprism_plan.robots._self_collision import random_configurations

ADJACENT, RIGID, ALWAYS, NEVER = "Adjacent", "Rigid", "Always", "Never"
SAMPLES = 10_000
# "Never" asks for so much room in every sample, metres, and after a search for less.
ROOM = 0.05
_CHUNK = 1000
_STARTS, _SCALES = 8, (0.1, 0.05, 0.03, 0.02, 0.01)


def sampled_reasons(
    arrays: KinematicArrays,
    pairs: Int[np.ndarray, "pairs 2"],
    names: Sequence[str],
    samples: int = SAMPLES,
    seed: int = 0,
) -> dict[frozenset[str], str]:
    """Pairs that overlap always, and pairs that never come near each other.

    "Always": the spheres overlap at the joints' zero and in every random configuration. The
    pair does so because of how the links are built, or of how coarse the spheres are;
    testing it would refuse every pose. "Never": the spheres are 5 cm apart in every one, and
    stay so when the joints are moved downhill from the nearest. A sample proves neither:
    a pair that comes near in a corner of the joint space only can be missed, so what is in
    between, and what was nearer just once, stays tested.

    Args:
        arrays: The robot.
        pairs: Indices into `names`.
        names: Links with spheres.
        samples: Random configurations, uniform within the limits.
        seed: Of these.

    Returns:
        Unordered pair of names -> "Always" or "Never".
    """
    rng = np.random.default_rng(seed)
    at_zero = np.clip(np.zeros(len(arrays.lower)), arrays.lower, arrays.upper)
    q = np.vstack([at_zero, random_configurations(arrays, max(samples - 1, 0), rng)])
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


def _named(
    pairs: Int[np.ndarray, "pairs 2"], names: Sequence[str], reason: str
) -> dict[frozenset[str], str]:
    return {frozenset((names[a], names[b])): reason for a, b in pairs}


def pair_gaps(
    arrays: KinematicArrays,
    q: Float[np.ndarray, "n dof"],
    pairs: Int[np.ndarray, "pairs 2"],
) -> Float[np.ndarray, "n pairs"]:
    """Distance between the spheres of two links in each configuration, padding not counted.

    Beyond :data:`ROOM` it is a lower bound: that of the balls around the links' spheres.
    """
    R, t = frame_poses(arrays, q)
    spheres = _placed(R, t, arrays.sphere_frame, arrays.sphere_center)
    balls = _placed(R, t, arrays.link_frame, arrays.link_center)
    gaps = np.linalg.norm(balls[:, pairs[:, 0]] - balls[:, pairs[:, 1]], axis=2)
    gaps -= arrays.link_radius[pairs].sum(axis=1)
    gaps += arrays.link_padding[pairs].sum(axis=1)
    for k in np.flatnonzero((gaps <= ROOM).any(axis=0)):
        near = np.flatnonzero(gaps[:, k] <= ROOM)
        a, b = (slice(arrays.link_start[i], arrays.link_start[i + 1]) for i in pairs[k])
        apart = np.linalg.norm(spheres[near, a][:, :, None] - spheres[near, b][:, None], axis=3)
        apart -= arrays.sphere_radius[a, None] + arrays.sphere_radius[b]
        gaps[near, k] = apart.min(axis=(1, 2)) + arrays.link_padding[pairs[k]].sum()
    return gaps


def _placed(
    R: Float[np.ndarray, "n frames 3 3"],
    t: Float[np.ndarray, "n frames 3"],
    frame: Int[np.ndarray, "m"],
    points: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m 3"]:
    return np.asarray((R[:, frame] @ points[:, :, None])[..., 0] + t[:, frame])


def _least_gaps(
    arrays: KinematicArrays,
    starts: Float[np.ndarray, "pairs starts dof"],
    pairs: Int[np.ndarray, "pairs 2"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "pairs"]:
    """The smallest gaps that random steps downhill from these configurations lead to."""
    span, least = arrays.upper - arrays.lower, np.full(len(pairs), np.inf)
    both = np.array([[0, 1]])
    for k, pair in enumerate(pairs):
        small = _of_links(arrays, pair)
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


def _of_links(arrays: KinematicArrays, links: Int[np.ndarray, "n"]) -> KinematicArrays:
    """Only these links, in this order, and the joints that move them; q stays as it was."""
    frames: set[int] = {0}
    for link in links:
        frame = int(arrays.link_frame[link])
        while frame > 0:
            frames.add(frame)
            frame = int(arrays.parent[frame])
    kept = np.array(sorted(frames))
    place = np.full(len(arrays.parent), -1)
    place[kept] = np.arange(len(kept))
    rows = [np.flatnonzero(arrays.sphere_link == link) for link in links]
    spheres = np.concatenate(rows)
    counts = [len(row) for row in rows]
    return replace(
        arrays,
        parent=np.where(arrays.parent[kept] >= 0, place[arrays.parent[kept]], -1),
        **{
            name: getattr(arrays, name)[kept]
            for name in ("R_off", "t_off", "axis", "kind", "q_index", "q_mult", "q_offset")
        },
        sphere_frame=place[arrays.sphere_frame[spheres]],
        sphere_center=arrays.sphere_center[spheres],
        sphere_radius=arrays.sphere_radius[spheres],
        sphere_link=np.repeat(np.arange(len(links)), counts),
        link_start=np.concatenate([[0], np.cumsum(counts)]),
        link_frame=place[arrays.link_frame[links]],
        **{
            name: getattr(arrays, name)[links]
            for name in ("link_center", "link_radius", "link_fixed", "link_padding")
        },
        pairs=np.empty((0, 2), dtype=np.int64),
    )


def shares_touching(
    arrays: KinematicArrays, pairs: Int[np.ndarray, "pairs 2"], samples: int = 500, seed: int = 0
) -> tuple[Float[np.ndarray, "pairs"], Bool[np.ndarray, "samples"]]:
    """How often each pair's spheres overlap in random configurations, and where any do."""
    q = random_configurations(arrays, samples, np.random.default_rng(seed))
    touching = pair_gaps(arrays, q, pairs) < 0.0
    return touching.mean(axis=0), np.asarray(touching.any(axis=1))


def srdf_text(
    name: str,
    joints: Sequence[str],
    groups: Mapping[str, Sequence[str]],
    states: Mapping[str, Mapping[str, float]],
    locked: Mapping[str, float],
    disabled: Mapping[frozenset[str], str],
) -> str:
    """An SRDF: groups of joints ("arm", "locked") and of links, states, disabled pairs."""
    import xml.etree.ElementTree as ET

    root = ET.Element("robot", {"name": name})
    of_joints = {"arm": list(joints)} | ({"locked": list(locked)} if locked else {})
    for group, members in of_joints.items():
        element = ET.SubElement(root, "group", {"name": group})
        for joint in members:
            ET.SubElement(element, "joint", {"name": joint})
    for group, links in groups.items():
        if group not in of_joints:
            element = ET.SubElement(root, "group", {"name": group})
            for link in links:
                ET.SubElement(element, "link", {"name": link})
    stated = [("arm", state, values) for state, values in states.items()]
    for group, state, values in [*stated, *([("locked", "locked", locked)] if locked else [])]:
        element = ET.SubElement(root, "group_state", {"name": state, "group": group})
        for joint, value in values.items():
            ET.SubElement(element, "joint", {"name": joint, "value": repr(float(value))})
    for pair, reason in sorted(disabled.items(), key=lambda row: sorted(row[0])):
        first, *second = sorted(pair)
        ET.SubElement(
            root,
            "disable_collisions",
            {"link1": first, "link2": second[0] if second else first, "reason": reason},
        )
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def write_srdf_text(path: str | Path, text: str) -> None:
    """Write an SRDF, whole or not at all."""
    write_text(path, '<?xml version="1.0"?>\n' + text)
