# SPDX-License-Identifier: BSD-3-Clause
"""What labels say that cannot be: a table as an object, fringes, objects without a return.

Segmentation models give masks a few pixels too wide, values that mean "unknown", and objects
of glass through which the camera sees the table. What depth can tell is mended and named.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from vprism_plan.perception.camera import Chosen, Ids, Pixels, Points, inlier_band, lift
from vprism_plan.perception.fringes import WIDE, MaskView, Window, fringe_pixels
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
    - Fringes get the label of the surface that they show: see `fringe_pixels`. Their depth stays.
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
    for reason_of in (_void, _furniture):
        for value in ids:
            reason = "" if value in reasons else reason_of(view, value, ids, list(reasons))
            if reason:
                reasons[value] = reason
    if not reasons:
        return view, []
    labels = np.where(np.isin(view.labels, list(reasons)), 0, view.labels)
    return replace(view, labels=labels), [
        f"label {value} is no object: {reason}; it is taken as background, set it to 0"
        for value, reason in reasons.items()
    ]


def _ids(labels: Ids) -> list[int]:
    """Positive labels, sorted."""
    if labels.max() < 2**16:
        found = np.flatnonzero(np.bincount(labels.ravel()))
    else:
        found = np.unique(labels)
    return [int(i) for i in found if i > 0]


def _void(view: Observation, value: int, ids: list[int], _: list[int]) -> str:
    """Say why a label means "unknown" or "the rest", or nothing."""
    labels = view.labels
    if len(ids) < 2 or (value not in _VOID and (labels == 0).any()):
        return ""
    own = labels == value
    sides = (own[0], own[-1], own[:, 0], own[:, -1])
    if sum(float(side.mean()) > 0.1 for side in sides) >= _SIDES:
        return "it fills what the other labels leave, up to the image's border"
    if value not in _VOID:
        return ""
    outline = beside = 0
    for here, there in ((labels[:, 1:], labels[:, :-1]), (labels[1:], labels[:-1])):
        for one, other in ((here, there), (there, here)):
            edge = (one > 0) & (one != value) & (other != one)
            outline += int(edge.sum())
            beside += int((edge & (other == value)).sum())
    if outline and beside >= _OUTLINED * outline:
        return f"a void value beside {100 * beside / outline:.0f} % of the other labels' outlines"
    return ""


def _furniture(view: Observation, value: int, ids: list[int], dropped: list[int]) -> str:
    """Say why a label is the table or a wall, or nothing."""
    seen = (view.labels == value) & (view.depth > 0)
    count = int(seen.sum())
    if count < _SCANTY * seen.size:
        return ""
    sample = _some(view, seen)
    spread = np.sqrt(12.0 * np.linalg.eigvalsh(np.cov(sample.T)).clip(0.0))
    if spread[2] < 0.8 * _TABLE[0] or spread[1] < 0.8 * _TABLE[1]:
        return ""
    plane, flat = _flat_part(sample)
    if flat.mean() < _PLANAR:
        return ""
    # Length and width of the rectangle as spread out. Far pixels show more of the surface each.
    on = sample[flat]
    area = on[:, 2] ** 3 / np.maximum(np.abs(on @ plane.normal), 1e-6)
    spread = np.linalg.eigvalsh(np.cov((on @ plane.axes().T).T, aweights=area))
    width, length = np.sqrt(12.0 * spread.clip(0.0))
    what = (
        f"{100 * flat.mean():.0f} % of its points lie on one plane of {length:.2f} x {width:.2f} m"
    )
    if length > _WALL[0] and width > _WALL[1]:
        return f"{what}, which is a table or a wall"
    # What carries things is level if posed, else no wall.
    upward = view.pose[2, :3] @ plane.normal > 0.8 if view.posed else -plane.normal[1] > -0.05
    if length > _TABLE[0] and width > _TABLE[1] and upward:
        rest = np.isin(view.labels, [i for i in ids if i != value and i not in dropped])
        others = _some(view, rest & (view.depth > 0))
        touch = np.percentile(plane.signed_distance(others), 5.0) if len(others) else np.inf
        carries = touch < _TOUCH and standing_on(plane, on, others, 0.01).mean() > _CARRIED
        if carries and _lowest(view, plane, count):
            return f"{what} that the other objects stand on"
    return ""


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


def _some(view: Observation, pixels: Pixels) -> Points:
    """Points of evenly spread pixels, camera frame."""
    index = np.flatnonzero(pixels)
    row, column = np.divmod(index[:: max(1, len(index) // _SAMPLE)], pixels.shape[1])
    return lift(view.depth, view.intrinsics, row, column)


def _flat_part(points: Points) -> tuple[Plane, Chosen]:
    """Fit a plane to nine tenths of the points or more; return it and which lie on it."""
    band = inlier_band(points[:, 2], 0.01)
    plane = least_squares_plane(points, 1.0 / band**2)
    for _ in range(3):
        distance = np.abs(plane.signed_distance(points))
        near = distance <= np.percentile(distance, 80.0)
        plane = least_squares_plane(points[near], 1.0 / band[near] ** 2)
    plane = refine(plane, points, band)
    return plane, np.abs(plane.signed_distance(points)) < band


# ------------------------------------------------------------------------ masks against depth
def _mended(view: Observation, plane: Plane) -> tuple[Observation, list[str]]:
    if not view.labels.any():
        return view, []
    labels, depth, found = view.labels.copy(), view.depth.copy(), []
    whole = _around(ndimage.find_objects((labels > 0).astype(np.int8))[0])
    image, returns = MaskView.of(view, plane, whole), depth[whole]
    support = _support_labels(image)
    if support:  # of what is near the objects; now of all
        support = _support_labels(MaskView.of(view, plane, (slice(0, None), slice(0, None))))
    for value in support:
        image.labels[image.labels == value] = 0
        found.append(
            f"label {value} is no object: it covers most of the visible support surface; it "
            "is taken as background, set it to 0"
        )
    fringe, surface = fringe_pixels(image)
    ids, trimmed = _ids(image.labels), image.labels.copy()
    number = np.where(image.labels > 0, np.searchsorted(ids, image.labels) + 1, 0)
    too_wide: dict[int, int] = {}
    for value, box in zip(ids, ndimage.find_objects(number), strict=True):
        window = _around(box)
        part = image.part(window)
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
    labels[whole] = trimmed
    return (replace(view, labels=labels, depth=depth), found) if found else (view, found)


def _around(box: tuple[slice, ...]) -> Window:
    """Rows and columns of some pixels, and a ring around them."""
    rows, columns = (slice(max(0, s.start - _RING), s.stop + _RING) for s in box)
    return rows, columns


def _support_labels(image: MaskView) -> list[int]:
    """Labels that are the support surface itself: most of it, and little else."""
    shown = image.labels[image.on_plane]
    found = []
    for value in _ids(image.labels):
        count = int((shown == value).sum())
        own = (image.labels == value) & (image.depth > 0)
        most = count >= max(_MOST * len(shown), _PLANAR * own.sum(), 1)
        if most and image.area(own & image.on_plane) > _TABLE_AREA:
            found.append(value)
    return found


def _see_through(image: MaskView, own: Pixels, fringe: Pixels) -> tuple[Pixels, Pixels]:
    """Return where an object lets the support surface show, and where only its edge does.

    Both are away from its foot. The second may be a fringe: within four pixels of the mask's
    edge and five of a raised part. Empty if there are too few of the first for an object, or if
    they are raised over the surface around them.
    """
    from scipy.spatial import cKDTree

    nothing = np.zeros_like(own)
    shows = own & image.on_plane
    if shows.sum() < _FEWEST:
        return nothing, nothing
    raised = own & (image.depth > 0) & ~image.on_plane
    # A lone pixel is noise; of a line one pixel wide, three lie in every 3 x 3.
    raised &= ndimage.uniform_filter(raised.astype(np.float64), 3, mode="constant") > 2.5 / 9.0
    away = shows.copy()
    low = raised & (image.height < image.height[shows].max() + _FOOT)  # others are farther away
    if low.any():
        points = image.rays * image.depth[..., None]
        gap, _ = cKDTree(points[low]).query(points[shows], distance_upper_bound=_FOOT)
        away[shows] = ~np.isfinite(gap)
    near = ndimage.maximum_filter(raised, 2 * WIDE + 3)
    border = away & near & ~ndimage.minimum_filter(own, 2 * WIDE + 1)
    through = away & ~border & ~fringe
    if through.sum() < _FEWEST or image.area(through) < _AREA:
        return nothing, border
    around = ndimage.maximum_filter(own, 2 * _RING + 1) & (image.labels == 0) & image.on_plane
    ground = float(np.median(image.height[around])) if around.sum() >= _FEWEST else 0.0
    if np.median(image.height[through]) > ground + _RAISED:
        return nothing, border
    return through, border
