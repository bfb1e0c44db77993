# SPDX-License-Identifier: BSD-3-Clause
"""What labels say that cannot be: a table as an object, fringes, objects without a return.

Segmentation models give masks a few pixels too wide, values that mean "unknown", and objects
of glass through which the camera sees the table. What depth can tell is mended and named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from vprism_plan._shapes import Chosen, Ids, Image, Indices, Pixels, PointImage, Points
from vprism_plan.perception.camera import depth_sigma, inlier_band, lift, pixel_rays
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane, least_squares_plane, refine
from vprism_plan.perception.plane_fitting import standing_on

# What data sets write for "unknown" or "all the rest"; as colours white, and the rim of VOC.
_VOID = (255, 65535, 2**31 - 1, 0xFFFFFF, 0xE0E0C0)
_OUTLINED = 0.5  # share of the other objects' outlines that lies beside an unknown rim
_SIDES = 3  # sides of the image, a tenth of each, that "all the rest" reaches
_SAMPLE = 600  # points of a label that a plane is fitted to
_SCANTY, _PLANAR = 0.01, 0.9  # shares: fewer pixels of the image are no table, nor fewer on a plane
# Metres, of a plane that is no object: so large both ways, or so large and carrying the objects.
_WALL, _TABLE = (0.8, 0.35), (0.3, 0.2)
_CARRIED = 0.8
_TOUCH = 0.03  # metres between a table and the lowest points of what stands on it
_DROP = 0.35  # metres; a surface closer below is what a tray or a box stands on
_MOST, _TABLE_AREA = 0.5, 0.1  # share, m^2
_FOOT = 0.02  # metres around an object's raised points that are its foot
_FEWEST, _AREA = 30, 1e-4  # pixels and m^2 that make an object see-through
_RAISED = 0.002  # metres over the table around it: a plate, thin but there
_RING = 12  # pixels
_LOST = 0.5

Window = tuple[slice, slice]


def drop_background(views: Sequence[Observation], first: int = 0) -> tuple[Observation, ...]:
    """Return the views without labels that are no object; each is named in `warnings`.

    These are void values (255, 65535) that outline the other objects or fill all that they
    leave, and labels whose points lie on one plane far larger than an object, or one that
    the other objects stand on: a wall, the table. They become 0. Call it before the support
    plane is fitted, with the number of views that came before, for the wording.
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

    The plane is in the world frame; `first` views came before, for the wording.
    """
    return _each(views, first, lambda view: _mended(view, plane))


def _each(
    views: Sequence[Observation],
    first: int,
    change: Callable[[Observation], tuple[Observation, list[str]]],
) -> tuple[Observation, ...]:
    """Apply a change to every labelled view, and note what it found in the view's warnings."""
    result = []
    for number, view in enumerate(views, start=first + 1):
        name = f"view {number}: " if first + len(views) > 1 else ""
        changed, found = change(view) if view.labels is not None else (view, [])
        said = dict.fromkeys([*view.warnings, *(name + text for text in found)])
        result.append(replace(changed, warnings=tuple(said)) if found else changed)
    return tuple(result)


# ------------------------------------------------------------------ labels that are no object
def _without_background(view: Observation) -> tuple[Observation, list[str]]:
    ids = _ids(view.labels)
    reasons: dict[int, str] = {}
    for reason_of in (_void, _furniture):
        for value in ids:
            if value not in reasons and (reason := reason_of(view, value, ids, list(reasons))):
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
    if labels.max() >= 2**16:
        return np.unique(labels[labels > 0]).tolist()
    return [int(i) for i in np.flatnonzero(np.bincount(labels.ravel())) if i > 0]


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
    """Whether `count` pixels are most of what is on a plane and close below: no tray, no box."""
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
    """A box and a ring around it."""
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
    edge and five of a raised part. Of the first there are enough for an object, or none.
    """
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


# ------------------------------------------------------------------------------------ fringes
# Metres over the support surface, and standard deviations, that are still its own: as where the
# world tells what casts a shadow.
_THIN, _SIGMAS = 0.003, 4.0
WIDE = 4  # pixels that a mask may be too wide
_GAP = 2  # pixels without a return that may lie between a fringe and its object
_STEEP = float(np.tan(np.radians(75.0)))  # neighbours on one surface, as in the segmentation
_NOISE = 2.0  # standard deviations
_STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
# Right masks have fringes as well: up to 17 % of the lines on generated scenes; on real ones half
# the lines and 14 % of the edge of small objects, but none on the table. A mask one pixel too
# wide has 60 %, and one shifted by a pixel 40 %.
_FEWEST_LINES, _ON_TABLE, _LINES, _EDGE = 10, 0.25, 0.35, 0.18


@dataclass(frozen=True, eq=False)
class MaskView:
    """A window of a view, and how its pixels lie to the support surface."""

    labels: Ids
    depth: Image  # metres, 0 = no return
    rays: PointImage  # points at depth 1 m, camera frame
    slant: Image  # change of height over the support surface per metre of depth
    height: Image  # metres over the support surface, any value where there is no return
    on_plane: Pixels  # those that show the support surface, within the sensor's noise
    pitch: float  # metres between neighbouring pixels at a depth of 1 m

    @classmethod
    def of(cls, view: Observation, plane: Plane, window: Window) -> MaskView:
        """Return a window of a view so."""
        depth, K = view.depth[window].astype(np.float64), view.intrinsics.copy()
        K[:2, 2] -= [window[1].start, window[0].start]
        rays = pixel_rays(depth.shape, K)
        slant = rays @ (view.pose[:3, :3].T @ plane.normal)
        height = plane.signed_distance(view.camera_center) + depth * slant
        noise = np.maximum(_THIN, _SIGMAS * depth_sigma(depth) * np.abs(slant))
        on_plane = (depth > 0) & (height < noise) & ~view.sees_robot[window]
        pitch = 1.0 / float(min(K[0, 0], K[1, 1]))
        return cls(view.labels[window].copy(), depth, rays, slant, height, on_plane, pitch)

    def part(self, window: Window) -> MaskView:
        """A window of the window."""
        names = ("labels", "depth", "rays", "slant", "height", "on_plane")
        return replace(self, **{name: getattr(self, name)[window] for name in names})

    def area(self, pixels: Pixels) -> float:
        """Area of level ground that some pixels show, m^2."""
        slant = np.maximum(np.abs(self.slant[pixels]), 1e-3)
        return float((self.depth[pixels] ** 2 / slant).sum()) * self.pitch**2


class _Lines(NamedTuple):
    """Lines from the edge of a mask inwards; pixels are numbers in a padded, flat image."""

    before: Indices  # the pixel outside
    pixels: Int[np.ndarray, "n most"]  # the first ones inside
    run: Bool[np.ndarray, "n most"]  # which of them continue the surface outside
    jump: Indices  # 1: a nearer surface of the same label ends the run, -1: a farther, 0: none
    edge: Indices  # all pixels at the edge of a mask, also where nothing returned beside it


def fringe_pixels(view: MaskView) -> tuple[Pixels, Ids]:
    """Return where masks are too wide, and there the label of the surface that shows.

    Lines run inwards from every pixel of a mask's edge. Up to four pixels that continue the
    surface outside the mask, and then a jump in depth to the object itself, are a fringe: what
    matters is which side of the jump a pixel lies on, so a rod two pixels wide survives. One
    before its object counts only if it shows another object: the near rim of a plate continues
    the table as well. Empty for objects with so few that their masks may well be right.
    """
    reach = WIDE + _GAP + 1
    padded = np.pad(view.labels, reach, constant_values=-1)
    labels, width = padded.ravel(), padded.shape[1]
    depth, on_plane = np.pad(view.depth, reach).ravel(), np.pad(view.on_plane, reach).ravel()
    slant = np.pad(view.slant, reach, mode="edge").ravel()
    mask, surface = np.zeros(len(labels), dtype=bool), np.zeros(len(labels), dtype=np.int32)
    wide: list[int] | None = None
    # Twice: the corner between two parts lies behind the fringes of both.
    for _ in range(2):
        lines = _follow(labels, depth, slant, width, view.pitch)
        beside = labels[lines.before]
        fringed = (lines.jump == 1) | ((lines.jump == -1) & (beside > 0))
        fringed &= lines.run.any(axis=1)
        if wide is None:
            wide = _too_wide(labels, on_plane, lines, fringed)
        fringed &= np.isin(labels[lines.pixels[:, 0]], wide)
        if not fringed.any():
            break
        run = lines.run & fringed[:, None]
        pixels, before = lines.pixels[run], np.repeat(lines.before, run.sum(axis=1))
        mask[pixels] = True
        # What shows the table is of the table, whatever the pixel beside it is taken for; and
        # the pixel beside it may be a fringe of its own.
        surface[pixels] = np.where(on_plane[pixels] | mask[before], 0, labels[before])
        labels[pixels] = surface[pixels]
    inside = (slice(reach, -reach), slice(reach, -reach))
    return mask.reshape(padded.shape)[inside], surface.reshape(padded.shape)[inside]


def _follow(
    labels: Indices, depth: np.ndarray, slant: np.ndarray, width: int, pitch: float
) -> _Lines:
    """Walk from every pixel beside a mask, that has a return, inwards."""
    masked = np.flatnonzero(labels > 0)
    steps = np.array([row * width + column for row, column in _STEPS])
    outside = masked - steps[:, None]
    other = (labels[outside] != labels[masked]) & (labels[outside] >= 0)
    direction, line = np.nonzero(other & (depth[outside] > 0))
    step, length = steps[direction], pitch * np.hypot(*np.array(_STEPS)[direction].T)
    before = masked[line] - step
    pixels = masked[line][:, None] + step[:, None] * np.arange(WIDE + _GAP)
    run, jump = np.zeros(pixels.shape, dtype=bool), np.zeros(len(line), dtype=np.int64)
    going, last, since = np.ones(len(line), dtype=bool), before.copy(), np.zeros(len(line))
    for number, pixel in enumerate(pixels.T):
        going &= labels[pixel] == labels[pixels[:, 0]]
        since += length
        seen = going & (depth[pixel] > 0)
        linked = _linked(last, pixel, since, depth, slant)
        jump[seen & ~linked] = np.sign(depth[last] - depth[pixel])[seen & ~linked]
        more = seen & linked & (run.sum(axis=1) < WIDE)
        run[:, number] = more
        last[more], since[more] = pixel[more], 0.0
        going &= more | ~seen
    return _Lines(before, pixels, run, jump, masked[other.any(axis=0) & (depth[masked] > 0)])


def _linked(
    first: Indices, second: Indices, spacing: np.ndarray, depth: np.ndarray, slant: np.ndarray
) -> Chosen:
    """Whether two pixels may lie on one surface: a steep one, or a level one seen at a glance."""
    change = depth[second] - depth[first]
    nearer = np.minimum(depth[first], depth[second])
    noise = _NOISE * depth_sigma(nearer)
    steep = np.abs(change) <= spacing * nearer * _STEEP + noise
    with np.errstate(divide="ignore", invalid="ignore"):
        level = depth[first] * (slant[first] / slant[second] - 1.0)
    level = np.where(np.isfinite(level), level, 0.0)
    return np.asarray(steep | (np.abs(change - level) <= 0.5 * np.abs(level) + noise))


def _too_wide(labels: Indices, on_plane: np.ndarray, lines: _Lines, fringed: Chosen) -> list[int]:
    """Objects that have too many fringed lines for a mask that is right."""
    begin = lines.pixels[:, 0]
    on_table = fringed & (on_plane[lines.pixels] | ~lines.run).all(axis=1)
    clean = (lines.jump == 1) & ~lines.run.any(axis=1)
    wide = []
    for value in np.unique(labels[begin[fringed]]).tolist():
        own = labels[begin] == value
        hits, table_hits = int((own & fringed).sum()), int((own & on_table).sum())
        total = hits + int((own & clean).sum())
        edge = (labels[lines.edge] == value).sum()
        fringe_edge = len(np.unique(begin[own & fringed]))
        many = hits >= max(_FEWEST_LINES, _LINES * total) and fringe_edge >= _EDGE * edge
        if many or table_hits >= max(_FEWEST_LINES, _ON_TABLE * total):
            wide.append(value)
    return wide
