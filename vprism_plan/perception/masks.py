# SPDX-License-Identifier: BSD-3-Clause
"""What labels say that cannot be: a table as an object, fringes, objects without a return.

Segmentation models give masks a few pixels too wide, values that mean "unknown", and objects
of glass through which the camera sees the table. What depth can tell is mended and named.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int32
from scipy import ndimage

from vprism_plan.perception._fringes import WIDE, MaskView, fringe_pixels
from vprism_plan.perception.camera import depth_sigma, inlier_band, pixel_rays
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane, least_squares_plane, refine
from vprism_plan.perception.plane_fitting import standing_on

# Values that data sets use for "unknown" or "all the rest".
_VOID = (255, 65535, 2**31 - 1)
_OUTLINED = 0.5  # share of the other objects' outlines that lies beside an unknown rim
_SIDES = 3  # sides of the image, a tenth of each, that "all the rest" reaches
_SAMPLE = 600  # points of a label that a plane is fitted to
_SCANTY = 0.01  # of the image; fewer pixels are no table
_PLANAR = 0.9
_WALL = (0.8, 0.35)  # metres; a plane larger than this both ways is furniture, not an object
_TABLE = (0.3, 0.2)  # metres; so is one of this size that the objects stand on
_CARRIED = 0.8
_TOUCH = 0.03  # metres between a table and the lowest points of what stands on it
_DROP = 0.35  # metres; a surface closer below is what a tray or a box stands on
_MOST = 0.5
_TABLE_AREA = 0.1  # m^2
# Metres over the support surface, and standard deviations, that are still its own: as where the
# world tells what casts a shadow.
_THIN, _SIGMAS = 0.003, 4.0
_FOOT = 0.02  # metres around an object's raised points that are its foot
_FEWEST, _AREA = 30, 1e-4  # pixels and m^2 that make an object see-through
_RAISED = 0.002  # metres over the table around it: a plate, thin but there
_RING = 12  # pixels
_LOST = 0.5


def drop_background(views: Sequence[Observation], first: int = 0) -> tuple[Observation, ...]:
    """Return the views without labels that are no object; each is named in `warnings`.

    These are void values (255, 65535) that outline the other objects or fill all that they
    leave, and labels whose points lie on one plane far larger than an object, or one that
    the other objects stand on: a wall, the table. They become 0. Call it before the support
    plane is fitted: that leaves out what carries a label.

    Args:
        views: labelled or not.
        first: number of views that came before, for the wording.
    """
    return _each(views, first, _without_background)


def mend(views: Sequence[Observation], plane: Plane, first: int = 0) -> tuple[Observation, ...]:
    """Return the views with masks that agree with their depth; `warnings` name what was done.

    - A label that is most of the visible support surface becomes 0.
    - Fringes get the label of the surface that they show (see `_fringes`). Their depth stays.
    - Labelled pixels that show the support surface 2 cm and more away from the object's
      raised points: the object is see-through there, or flat. They keep the label and lose
      the depth, which is not the object's.
    - An object that lacks a return on most of its pixels is named.

    Args:
        views: labelled.
        plane: support surface, world frame.
        first: number of views that came before, for the wording.
    """
    return _each(views, first, lambda view: _mended(view, plane))


Change = Callable[[Observation], tuple[Observation, list[str]]]


def _each(views: Sequence[Observation], first: int, change: Change) -> tuple[Observation, ...]:
    """Apply a change to every view, and note what it found in the view's warnings."""
    result = []
    for number, view in enumerate(views, start=first + 1):
        name = f"view {number}: " if first + len(views) > 1 else ""
        changed, found = change(view) if view.labels is not None else (view, [])
        fresh = [name + text for text in found if name + text not in view.warnings]
        if fresh:
            changed = replace(changed, warnings=(*view.warnings, *fresh))
        result.append(changed)
    return tuple(result)


# ------------------------------------------------------------------ labels that are no object
def _without_background(view: Observation) -> tuple[Observation, list[str]]:
    ids = _ids(view.labels)
    reasons: dict[int, str] = {}
    for value in ids:
        reason = _void(view.labels, ids, value)
        if reason is not None:
            reasons[value] = reason
    for value in ids:
        if value not in reasons:
            reason = _furniture(view, value, list(reasons))
            if reason is not None:
                reasons[value] = reason
    if not reasons:
        return view, []
    labels = np.where(np.isin(view.labels, list(reasons)), 0, view.labels)
    return replace(view, labels=labels), [
        f"label {value} is no object: {reason}; it is taken as background, set it to 0"
        for value, reason in reasons.items()
    ]


def _ids(labels: Int32[np.ndarray, "h w"]) -> list[int]:
    """Positive labels, sorted."""
    if labels.max() < 2**16:
        found = np.flatnonzero(np.bincount(labels.ravel()))
    else:
        found = np.unique(labels)
    return [int(i) for i in found if i > 0]


def _void(labels: Int32[np.ndarray, "h w"], ids: list[int], value: int) -> str | None:
    """Say why a label means "unknown" or "the rest", or None."""
    unlabelled = bool((labels == 0).any())
    if len(ids) < 2 or (value not in _VOID and unlabelled):
        return None
    own = labels == value
    sides = (own[0], own[-1], own[:, 0], own[:, -1])
    if sum(float(side.mean()) > 0.1 for side in sides) >= _SIDES:
        return "it fills what the other labels leave, up to the image's border"
    if value not in _VOID:
        return None
    outline = beside = 0
    for here, there in ((labels[:, 1:], labels[:, :-1]), (labels[1:], labels[:-1])):
        for one, other in ((here, there), (there, here)):
            edge = (one > 0) & (one != value) & (other != one)
            outline += int(edge.sum())
            beside += int((edge & (other == value)).sum())
    if outline and beside >= _OUTLINED * outline:
        return f"a void value beside {100 * beside / outline:.0f} % of the other labels' outlines"
    return None


def _furniture(view: Observation, value: int, dropped: list[int]) -> str | None:
    """Say why a label is the table or a wall, or None."""
    seen = (view.labels == value) & (view.depth > 0)
    count = int(seen.sum())
    if count < _SCANTY * seen.size:
        return None
    sample = _some(view, seen)
    spread = np.sqrt(12.0 * np.linalg.eigvalsh(np.cov(sample.T)).clip(0.0))
    if spread[2] < 0.8 * _TABLE[0] or spread[1] < 0.8 * _TABLE[1]:
        return None
    plane, flat = _flat_part(sample)
    if flat.mean() < _PLANAR:
        return None
    length, width = _extents(sample[flat], plane)
    what = (
        f"{100 * flat.mean():.0f} % of its points lie on one plane of {length:.2f} x {width:.2f} m"
    )
    if length > _WALL[0] and width > _WALL[1]:
        return f"{what}, which is a table or a wall"
    if length > _TABLE[0] and width > _TABLE[1] and _upward(view, plane):
        others = (view.labels > 0) & ~np.isin(view.labels, [value, *dropped]) & (view.depth > 0)
        if _carries(plane, sample[flat], _some(view, others)) and _lowest(view, plane, count):
            return f"{what} that the other objects stand on"
    return None


def _carries(
    plane: Plane, on_plane: Float[np.ndarray, "n 3"], objects: Float[np.ndarray, "m 3"]
) -> bool:
    """Whether the objects stand on a patch of a plane, and touch it."""
    if not len(objects):
        return False
    standing = standing_on(plane, on_plane, objects, 0.01)
    touch = float(np.percentile(plane.signed_distance(objects), 5.0))
    return bool(standing.mean() > _CARRIED and touch < _TOUCH)


def _lowest(view: Observation, plane: Plane, count: int) -> bool:
    """Whether `count` pixels on a plane are most of what is on it and close below it.

    Otherwise it is a tray or a box, and what it stands on is in view.
    """
    unlabelled = (view.labels == 0) & (view.depth > 0) & ~view.sees_robot
    points = _some(view, unlabelled)
    if not len(points):
        return True
    height = plane.signed_distance(points)
    alike = (height > -_DROP) & (height < inlier_band(points[:, 2], 0.01))
    return bool(count > _MOST * (count + alike.mean() * unlabelled.sum()))


def _some(view: Observation, pixels: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
    """Points of evenly spread pixels, camera frame."""
    index = np.flatnonzero(pixels)
    index = index[:: max(1, len(index) // _SAMPLE)]
    row, column = np.divmod(index, pixels.shape[1])
    depth = view.depth.ravel()[index].astype(np.float64)
    K = view.intrinsics
    return np.column_stack(
        [depth * (column - K[0, 2]) / K[0, 0], depth * (row - K[1, 2]) / K[1, 1], depth]
    )


def _flat_part(points: Float[np.ndarray, "n 3"]) -> tuple[Plane, Bool[np.ndarray, " n"]]:
    """Fit a plane to nine tenths of the points or more; return it and which lie on it."""
    band = inlier_band(points[:, 2], 0.01)
    plane = least_squares_plane(points, 1.0 / band**2)
    for _ in range(3):
        distance = np.abs(plane.signed_distance(points))
        near = distance <= np.percentile(distance, 80.0)
        plane = least_squares_plane(points[near], 1.0 / band[near] ** 2)
    plane = refine(plane, points, band)
    return plane, np.abs(plane.signed_distance(points)) < band


def _extents(points: Float[np.ndarray, "n 3"], plane: Plane) -> tuple[float, float]:
    """Length and width of a flat patch (camera frame), metres: of the rectangle as spread out."""
    flat = points @ plane.axes().T
    # Far pixels show more of the surface each.
    area = points[:, 2] ** 3 / np.maximum(np.abs(points @ plane.normal), 1e-6)
    spread = np.linalg.eigvalsh(np.cov(flat.T, aweights=area))
    width, length = np.sqrt(12.0 * np.maximum(spread, 0.0))
    return float(length), float(width)


def _upward(view: Observation, plane: Plane) -> bool:
    """Whether a plane (camera frame) may carry things: level if posed, else no wall."""
    if view.posed:
        return bool(view.pose[2, :3] @ plane.normal > 0.8)
    return bool(-plane.normal[1] > -0.05)


# ------------------------------------------------------------------------ masks against depth
def _mended(view: Observation, plane: Plane) -> tuple[Observation, list[str]]:
    labels, depth = view.labels.copy(), view.depth.copy()
    everywhere = (slice(0, labels.shape[0]), slice(0, labels.shape[1]))
    found: list[str] = []
    if not labels.any():
        return view, found
    whole = _around(labels > 0, _RING)
    image = _mask_view(view, plane, whole)
    for value in _support_labels(image):
        if whole == everywhere or value in _support_labels(_mask_view(view, plane, everywhere)):
            image.labels[image.labels == value] = 0
            found.append(
                f"label {value} is no object: it covers most of the visible support surface; it "
                "is taken as background, set it to 0"
            )
    fringe, surface = fringe_pixels(image)
    ids = _ids(image.labels)
    number = np.where(image.labels > 0, np.searchsorted(ids, image.labels) + 1, 0)
    trimmed, returns = image.labels.copy(), depth[whole]
    too_wide: dict[int, int] = {}
    for value, (rows, columns) in zip(ids, ndimage.find_objects(number), strict=True):
        window = (_grown(rows, _RING), _grown(columns, _RING))
        part = image.part(*window)
        own = part.labels == value
        pixels = int(own.sum())
        through, border = _see_through(part, own, fringe[window])
        edge = fringe[window] & own
        if through.any():
            through |= border
            edge &= ~through
            returns[window][through] = 0.0
            found.append(
                f"object {value}: {100 * through.sum() / pixels:.0f} % of its pixels show the "
                "support surface behind it: it is see-through or flat, or its mask too wide; the "
                "rays through them count as an obstacle, set the label to 0 where nothing stands"
            )
        elif edge.any():
            edge |= border
        if edge.any():
            trimmed[window][edge] = surface[window][edge]
            too_wide[value] = int(edge.sum())
        lost = int((own & (part.depth == 0)).sum())
        if _LOST * pixels < lost < pixels:
            found.append(
                f"object {value}: {100 * lost / pixels:.0f} % of its {pixels} pixels have no "
                "depth return; the rays through them count as an obstacle, take another view if "
                "they are of glass, black or shiny"
            )
    if too_wide:
        found.append(
            f"the masks of objects {list(too_wide)} are too wide or shifted: "
            f"{sum(too_wide.values())} pixels along their outlines show what lies beside them, "
            "and lose the label; check that labels and depth are registered"
        )
    if not found:
        return view, found
    labels[whole] = trimmed
    return replace(view, labels=labels, depth=depth), found


Window = tuple[slice, slice]


def _mask_view(view: Observation, plane: Plane, window: Window) -> MaskView:
    depth = view.depth[window].astype(np.float64)
    K = view.intrinsics.copy()
    K[:2, 2] -= [window[1].start, window[0].start]
    rays = pixel_rays(depth.shape, K)
    slant = rays @ (view.pose[:3, :3].T @ plane.normal)
    height = plane.signed_distance(view.camera_center) + depth * slant
    noise = np.maximum(_THIN, _SIGMAS * depth_sigma(depth) * np.abs(slant))
    on_plane = (depth > 0) & (height < noise) & ~view.sees_robot[window]
    pitch = 1.0 / min(K[0, 0], K[1, 1])
    return MaskView(view.labels[window].copy(), depth, rays, slant, height, on_plane, float(pitch))


def _around(pixels: Bool[np.ndarray, "h w"], margin: int) -> Window:
    """The rows and columns of some pixels and `margin` around them."""
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), min(pixels.shape[0], int(rows[-1]) + 1 + margin)),
        slice(
            max(0, int(columns[0]) - margin), min(pixels.shape[1], int(columns[-1]) + 1 + margin)
        ),
    )


def _grown(part: slice, margin: int) -> slice:
    return slice(max(0, part.start - margin), part.stop + margin)


def _area(image: MaskView, pixels: Bool[np.ndarray, "h w"]) -> float:
    """Area of level ground that some pixels show, m^2."""
    slant = np.maximum(np.abs(image.slant[pixels]), 1e-3)
    return float((image.depth[pixels] ** 2 / slant).sum()) * image.pitch**2


def _support_labels(image: MaskView) -> list[int]:
    """Labels that are the support surface itself: most of it, and little else."""
    shown = image.labels[image.on_plane]
    ids, counts = np.unique(shown, return_counts=True)
    found = []
    for value, count in zip(ids.tolist(), counts.tolist(), strict=True):
        if value == 0 or count < _MOST * len(shown):
            continue
        own = (image.labels == value) & (image.depth > 0)
        if count >= _PLANAR * own.sum() and _area(image, own & image.on_plane) > _TABLE_AREA:
            found.append(value)
    return found


def _see_through(
    image: MaskView, own: Bool[np.ndarray, "h w"], fringe: Bool[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return where an object lets the support surface show, and where only its edge does.

    Both are away from its foot. The second may be a fringe: within four pixels of the mask's
    edge and five of a raised part. Empty if there are too few of the first for an object, or if
    they are raised over the surface around them.
    """
    nothing = np.zeros_like(own)
    shows = own & image.on_plane
    if shows.sum() < _FEWEST:
        return nothing, nothing
    raised = own & (image.depth > 0) & ~image.on_plane
    # A lone pixel is noise; of a line one pixel wide, three lie in every 3 x 3.
    raised &= ndimage.uniform_filter(raised.astype(np.float64), 3, mode="constant") > 2.5 / 9.0
    away = shows.copy()
    away[shows] = _far_from(image, shows, raised)
    near = ndimage.maximum_filter(raised, 2 * WIDE + 3)
    edge = ~ndimage.minimum_filter(own, 2 * WIDE + 1)
    border = away & near & edge
    through = away & ~border & ~fringe
    if through.sum() < _FEWEST or _area(image, through) < _AREA:
        return nothing, border
    around = ndimage.maximum_filter(own, 2 * _RING + 1) & (image.labels == 0) & image.on_plane
    ground = float(np.median(image.height[around])) if around.sum() >= _FEWEST else 0.0
    if np.median(image.height[through]) > ground + _RAISED:
        return nothing, border
    return through, border


def _far_from(
    image: MaskView, shows: Bool[np.ndarray, "h w"], raised: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, " n"]:
    """Which pixels of `shows` lie farther than the foot's reach from every raised one."""
    from scipy.spatial import cKDTree

    points = image.rays * image.depth[..., None]
    # Higher ones are farther away.
    low = raised & (image.height < image.height[shows].max() + _FOOT)
    if not low.any():
        return np.ones(int(shows.sum()), dtype=bool)
    gap, _ = cKDTree(points[low]).query(points[shows], distance_upper_bound=_FOOT)
    return np.asarray(~np.isfinite(gap))
