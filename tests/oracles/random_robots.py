"""Random kinematic trees: any axis, prismatic and mimic joints, branches, many spheres."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from vprism_plan.robots.kinematics import KinematicArrays


def random_arrays(rng: np.random.Generator, dof: int = 4, reach: float = 0.6) -> KinematicArrays:
    """A tree with `dof` joints and sometimes one that mimics; offsets add up to about `reach`."""
    mimic = bool(rng.random() < 0.4)
    n_frames = 1 + dof + mimic
    parent = np.array([-1, *[max(0, f - 1 - int(rng.random() < 0.25)) for f in range(1, n_frames)]])
    kind = np.array([0, *np.where(rng.random(n_frames - 1) < 0.25, 2, 1)])
    q_index = np.array([-1, *range(dof), *([int(rng.integers(dof))] if mimic else [])])
    mult = np.ones(n_frames)
    offset = np.zeros(n_frames)
    if mimic:
        mult[-1], offset[-1] = rng.uniform(-1.5, 1.5), rng.uniform(-0.2, 0.2)
    axis = rng.normal(size=(n_frames, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    t_off = rng.normal(size=(n_frames, 3))
    t_off *= reach / dof / np.linalg.norm(t_off, axis=1, keepdims=True)
    kind_of = np.array([kind[1 + j] for j in range(dof)])
    continuous = (kind_of == 1) & (rng.random(dof) < 0.3)
    if mimic:  # a joint that another follows does not come back to itself after a turn
        continuous[q_index[-1]] = False
    limit = np.where(kind_of == 2, 0.15, rng.uniform(1.0, 2.8, dof))
    limit = np.where(continuous, np.pi, limit)
    links = [(f, int(rng.integers(1, 5))) for f in range(n_frames) if f == 0 or rng.random() < 0.9]
    counts = np.array([n for _, n in links])
    start = np.concatenate([[0], np.cumsum(counts)])
    centers = rng.normal(scale=0.05, size=(start[-1], 3))
    radii = rng.uniform(0.01, 0.06, start[-1])
    link_center = np.array([centers[a:b].mean(axis=0) for a, b in pairwise(start)])
    link_radius = np.array(
        [
            np.max(np.linalg.norm(centers[a:b] - c, axis=1) + radii[a:b])
            for (a, b), c in zip(pairwise(start), link_center, strict=True)
        ]
    )
    pairs = [(a, b) for a in range(len(links)) for b in range(a + 1, len(links))]
    pairs = [p for p in pairs if rng.random() < 0.4]
    return KinematicArrays(
        base_R=Rotation.random(random_state=rng).as_matrix(),
        base_t=rng.normal(scale=0.1, size=3),
        parent=parent,
        R_off=Rotation.random(n_frames, random_state=rng).as_matrix(),
        t_off=t_off,
        axis=axis,
        kind=kind,
        q_index=q_index,
        q_mult=mult,
        q_offset=offset,
        sphere_frame=np.repeat([f for f, _ in links], counts),
        sphere_center=centers,
        sphere_radius=radii,
        sphere_link=np.repeat(np.arange(len(links)), counts),
        link_start=start,
        link_frame=np.array([f for f, _ in links]),
        link_center=link_center,
        link_radius=link_radius,
        link_fixed=np.array([f == 0 for f, _ in links]),
        link_padding=np.zeros(len(links)),
        link_buffer=np.zeros(len(links)),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        lower=-limit,
        upper=limit,
        continuous=continuous,
    )


def as_robot(arrays: KinematicArrays) -> SimpleNamespace:
    """The names a checker asks a robot for."""
    dof = len(arrays.lower)
    return SimpleNamespace(
        name="random",
        joint_names=tuple(f"joint{j}" for j in range(dof)),
        dof=dof,
        arrays=arrays,
        lower=arrays.lower,
        upper=arrays.upper,
        continuous=arrays.continuous,
        link_names=tuple(f"link{i}" for i in range(len(arrays.link_frame))),
        sphere_links=arrays.sphere_link,
        sphere_radii=arrays.sphere_radius,
        collision_pairs=arrays.pairs,
    )


def random_q(rng: np.random.Generator, arrays: KinematicArrays) -> np.ndarray:
    """A configuration within the limits."""
    return rng.uniform(arrays.lower, arrays.upper)
