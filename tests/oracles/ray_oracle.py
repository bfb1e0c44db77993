"""First hit of rays on triangle meshes, two ways that share nothing with the renderer."""

import mujoco
import numpy as np


def brute_force(origin, directions, meshes):
    """Every ray against every triangle in double precision: (mesh index or -1, parameter)."""
    best, owner = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for index, mesh in enumerate(meshes):
        a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
        e1, e2, s = b - a, c - a, origin - a
        q = np.cross(s, e1)
        for ray, d in enumerate(directions):
            p = np.cross(d, e2)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = 1.0 / (e1 * p).sum(axis=1)
                u, v = (s * p).sum(axis=1) * inverse, (q @ d) * inverse
                t = (e2 * q).sum(axis=1) * inverse
                met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
            if met.any() and t[met].min() < best[ray]:
                best[ray], owner[ray] = t[met].min(), index
    return owner, best


def by_mujoco(origin, directions, meshes):
    """The same by MuJoCo's ray caster, for many rays."""
    spec = mujoco.MjSpec()
    for index, mesh in enumerate(meshes):
        spec.add_mesh(
            name=f"m{index}",
            uservert=np.ascontiguousarray(mesh.vertices).ravel(),
            userface=mesh.faces.astype(np.int32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{index}")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    count = len(directions)
    owner, distance = np.full(count, -1, dtype=np.int32), np.full(count, -1.0)
    mujoco.mj_multiRay(
        model,
        data,
        np.array(origin),
        np.ascontiguousarray(directions).ravel(),
        None,
        True,
        -1,
        owner,
        distance,
        None,
        count,
        100.0,
    )
    return owner, np.where(distance >= 0, distance, np.inf)
