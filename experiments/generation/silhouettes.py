# SPDX-License-Identifier: BSD-3-Clause
"""How much of each object a view shows: silhouettes, and BOP's figures of them."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool

from experiments.generation.scene import MeshScene
from vprism_plan.errors import MissingDependencyError
from vprism_plan.simulation.camera import Camera

if TYPE_CHECKING:
    import trimesh

_NOWHERE = [-1, -1, -1, -1]  # BOP's box of an object that no pixel shows


def silhouettes(scene: MeshScene) -> tuple[list[Bool[np.ndarray, "h w"]], list[dict[str, Any]]]:
    """Return each object's silhouette in the image, and what BOP's scene_gt_info says of it.

    A silhouette is what the object alone would cover, whatever stands in front of it. The
    figures are those of BOP's toolkit: `px_count_all` and `bbox_obj` count the part outside
    the image too, `px_count_valid` the pixels of the silhouette with depth, boxes are (x, y,
    last x - x, last y - y), and -1 throughout for an object that no pixel shows. What is
    visible is known here (the labels), where the toolkit infers it from the depth image.
    """
    seen = scene.observation
    height, width = scene.camera.height, scene.camera.width
    image = slice(height, 2 * height), slice(width, 2 * width)
    masks, figures = [], []
    for label, body in zip(scene.object_ids, scene.objects, strict=True):
        canvas = _covered(body.mesh(), scene.camera)
        visible = np.asarray(seen.labels) == label
        # A ray that grazes an edge may hit it among the others and miss it alone.
        canvas[image] |= visible
        masks.append(canvas[image])
        everything, shown = int(canvas.sum()), int(visible.sum())
        figures.append(
            {
                "bbox_obj": _box(canvas, (width, height)) if shown else _NOWHERE,
                "bbox_visib": _box(visible, (0, 0)) if shown else _NOWHERE,
                "px_count_all": everything,
                "px_count_valid": int((seen.depth[masks[-1]] > 0).sum()),
                "px_count_visib": shown,
                "visib_fract": shown / everything if everything else 0.0,
            }
        )
    return masks, figures


def _covered(mesh: "trimesh.Trimesh", camera: Camera) -> Bool[np.ndarray, "h3 w3"]:
    """Return which pixels a mesh covers on a canvas of three by three images, ours the middle."""
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        raise MissingDependencyError(
            "silhouettes are rendered with Embree: pip install embreex"
        ) from error
    shift = np.array([[0.0, 0.0, camera.width], [0.0, 0.0, camera.height], [0.0, 0.0, 0.0]])
    canvas = replace(
        camera, intrinsics=camera.intrinsics + shift, width=3 * camera.width,
        height=3 * camera.height,
    )  # fmt: skip
    radius = 0.5 * float(np.linalg.norm(mesh.extents))
    rows, columns = canvas.window(mesh.bounds.mean(axis=0), radius)
    u, v = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3).astype(np.float64)
    rays = pixels @ np.linalg.inv(canvas.intrinsics).T @ camera.T_world_camera[:3, :3].T
    covered = np.zeros((canvas.height, canvas.width), dtype=bool)
    if len(rays):
        origin = np.broadcast_to(camera.center, rays.shape)
        hit = RayMeshIntersector(mesh).intersects_any(origin, rays)
        covered[rows, columns] = np.asarray(hit, dtype=bool).reshape(u.shape)
    return covered


def _box(mask: Bool[np.ndarray, "h w"], origin: tuple[int, int]) -> list[int]:
    """Return BOP's box of a mask, from the pixel (column, row) that is the image's first."""
    y, x = np.nonzero(mask)
    return [
        int(x.min()) - origin[0], int(y.min()) - origin[1],
        int(np.ptp(x)), int(np.ptp(y)),
    ]  # fmt: skip
