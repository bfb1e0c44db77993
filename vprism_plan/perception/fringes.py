# SPDX-License-Identifier: BSD-3-Clause
"""Where a mask is a few pixels too wide: its edge shows the surface beside it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.perception.camera import (
    Chosen,
    Ids,
    Image,
    Indices,
    Pixels,
    PointImage,
    depth_sigma,
    pixel_rays,
)
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

Window = tuple[slice, slice]

# Metres over the support surface, and standard deviations, that are still its own: as where the
# world tells what casts a shadow.
_THIN, _SIGMAS = 0.003, 4.0
WIDE = 4  # pixels that a mask may be too wide
_GAP = 2  # pixels without a return that may lie between a fringe and its object
_STEEP = float(np.tan(np.radians(75.0)))  # neighbours on one surface, as in the segmentation
_NOISE = 2.0  # standard deviations
_STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
# Sensors blur edges, so right masks have fringes here and there: up to 17 % of the lines on
# generated scenes; on real ones half the lines and 14 % of the edge of small objects, but none
# on the table. A mask one pixel too wide has 60 %, and one shifted by a pixel 40 %.
_FEWEST = 10
_ON_TABLE = 0.25
_LINES, _EDGE = 0.35, 0.18


@dataclass(frozen=True, eq=False)
class MaskView:
    """A view, and how its pixels lie to the support surface.

    Attributes:
        labels: (H, W) object ids, 0 = background.
        depth: (H, W) float64 metres, 0 = no return.
        rays: (H, W, 3) points at depth 1 m, camera frame.
        slant: (H, W) change of height over the support surface per metre of depth.
        height: (H, W) metres over the support surface, any value where there is no return.
        on_plane: (H, W) pixels that show the support surface, within the sensor's noise.
        pitch: metres between neighbouring pixels at a depth of 1 m.
    """

    labels: Ids
    depth: Image
    rays: PointImage
    slant: Image
    height: Image
    on_plane: Pixels
    pitch: float

    @classmethod
    def of(cls, view: Observation, plane: Plane, window: Window) -> "MaskView":
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

    def part(self, window: Window) -> "MaskView":
        """Return a window of the images."""
        names = ("labels", "depth", "rays", "slant", "height", "on_plane")
        return replace(self, **{name: getattr(self, name)[window] for name in names})

    def area(self, pixels: Pixels) -> float:
        """Area of level ground that some pixels show, m^2."""
        slant = np.maximum(np.abs(self.slant[pixels]), 1e-3)
        return float((self.depth[pixels] ** 2 / slant).sum()) * self.pitch**2


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines from the edge of a mask inwards; pixels are numbers in a padded, flat image.

    Attributes:
        before: the pixel outside.
        pixels: the first ones inside.
        run: which of them continue the surface outside.
        jump: 1 where a nearer surface of the same label ends the run, -1 a farther, 0 none.
        edge: all pixels at the edge of a mask, also where nothing returned beside it.
    """

    before: Indices
    pixels: Int[np.ndarray, "n most"]
    run: Bool[np.ndarray, "n most"]
    jump: Indices
    edge: Int[np.ndarray, " e"]


def fringe_pixels(view: MaskView) -> tuple[Pixels, Ids]:
    """Return where masks are too wide, and there the label of the surface that shows.

    Lines run inwards from every pixel of a mask's edge. Up to four pixels that continue the
    surface outside the mask, and then a jump in depth to the object itself, are a fringe. A rod
    two pixels wide survives this: what matters is which side of the jump a pixel lies on.

    Empty for objects with so few that their masks may well be right. A fringe before its
    object counts only if it shows another object: the near rim of a plate continues the
    table as well.
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
    labels: Int[np.ndarray, " p"],
    depth: Float[np.ndarray, " p"],
    slant: Float[np.ndarray, " p"],
    width: int,
    pitch: float,
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
    first: Indices,
    second: Indices,
    spacing: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, " p"],
    slant: Float[np.ndarray, " p"],
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


def _too_wide(
    labels: Int[np.ndarray, " p"], on_plane: Bool[np.ndarray, " p"], lines: _Lines, fringed: Chosen
) -> list[int]:
    """Objects that have too many fringed lines for a mask that is right."""
    begin = lines.pixels[:, 0]
    on_table = fringed & (on_plane[lines.pixels] | ~lines.run).all(axis=1)
    clean = (lines.jump == 1) & ~lines.run.any(axis=1)
    wide = []
    for value in np.unique(labels[begin[fringed]]).tolist():
        own = labels[begin] == value
        hits, table_hits = int((own & fringed).sum()), int((own & on_table).sum())
        total = hits + int((own & clean).sum())
        edge, fringe_edge = (
            (labels[lines.edge] == value).sum(),
            len(np.unique(begin[own & fringed])),
        )
        many = hits >= max(_FEWEST, _LINES * total) and fringe_edge >= _EDGE * edge
        if many or table_hits >= max(_FEWEST, _ON_TABLE * total):
            wide.append(value)
    return wide
