# SPDX-License-Identifier: BSD-3-Clause
"""Put the world frame on the table."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.plane_fitting import fit_plane, inlier_band


def align_to_table(obs: Observation, *, plane: Plane | None = None, seed: int = 0) -> Observation:
    """Return the observation in a world frame that stands on its support plane.

    World z is the plane's normal and the plane is z = 0. The origin is the foot of the
    objects' mean point (of the plane's own points if the observation is unlabelled).
    World x is the camera's viewing direction laid into the plane, so the camera looks
    along +x; seen from straight above, where that direction vanishes, x is the image's
    upward direction instead. y completes the right-handed frame (left of the view).

    Args:
        obs: posed or unposed; an existing pose is replaced.
        plane: support plane in the world frame of `obs`; default: `obs.plane`, else fitted.
        seed: seed of the plane fit.

    Raises:
        PlaneNotFoundError: no support plane (see `fit_plane`).
        ObservationError: the camera lies in the plane or below it.
    """
    plane = plane or obs.plane or fit_plane(obs, seed=seed)
    in_camera = plane.transformed(invert_transform(obs.pose))
    if in_camera.offset >= -1e-6:
        raise ObservationError(
            f"the camera is {-in_camera.offset:.3g} m above the support plane; it must be on "
            "the side that the plane's normal points to: flip the plane's normal"
        )
    pose = _table_pose(obs, in_camera)
    return replace(obs, T_world_camera=pose, plane=Plane(np.array([0.0, 0.0, 1.0]), 0.0))


def _table_pose(obs: Observation, plane: Plane) -> Float[np.ndarray, "4 4"]:
    """Pose of the camera in the table frame; `plane` is in the camera frame."""
    z = plane.normal
    forward = np.array([0.0, 0.0, 1.0]) - z[2] * z
    if np.linalg.norm(forward) < 0.05:
        image_up = np.array([0.0, -1.0, 0.0])
        forward = image_up - (image_up @ z) * z
    x = forward / np.linalg.norm(forward)
    y = np.cross(z, x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, y, z])
    pose[:3, 3] = -pose[:3, :3] @ _origin(obs, plane)
    return pose


def _origin(obs: Observation, plane: Plane) -> Float[np.ndarray, " 3"]:
    """Origin of the table frame, camera coordinates."""
    unposed = replace(obs, T_world_camera=None, plane=None)
    points, labels = unposed.points()
    chosen = points[labels > 0]
    if not len(chosen):
        points = points[~obs.sees_robot[obs.depth > 0]]
        band = inlier_band(points[:, 2], 0.01)
        chosen = points[np.abs(plane.signed_distance(points)) < band]
    if not len(chosen):
        raise ObservationError(
            "no observed point lies on the given support plane and no object is labelled, so "
            "there is nothing to put the origin under; check the plane's frame and units"
        )
    return plane.project(chosen.mean(axis=0))
