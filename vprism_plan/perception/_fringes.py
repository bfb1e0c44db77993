# SPDX-License-Identifier: BSD-3-Clause
"""Where a mask is a few pixels too wide: its edge shows the surface beside it.

Eight lines run inwards from every pixel of a mask's edge. Up to four pixels that continue the
surface outside the mask, and then a jump in depth to the object itself, are a fringe. A rod two
pixels wide survives this: what matters is which side of the jump a pixel lies on.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from vprism_plan.perception.camera import depth_sigma

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

    labels: Int32[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    rays: Float[np.ndarray, "h w 3"]
    slant: Float[np.ndarray, "h w"]
    height: Float[np.ndarray, "h w"]
    on_plane: Bool[np.ndarray, "h w"]
    pitch: float

    def part(self, rows: slice, columns: slice) -> "MaskView":
        """Return a window of the images."""
        window = (rows, columns)
        return MaskView(
            self.labels[window],
            self.depth[window],
            self.rays[window],
            self.slant[window],
            self.height[window],
            self.on_plane[window],
            self.pitch,
        )


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines from the pixel before a mask's edge inwards; pixels are numbers in a padded image.

    Attributes:
        begin: the first pixel inside.
        step: to the next pixel.
        edge: all pixels at the edge of a mask, also where nothing returned beside it.
        run: pixels that continue the surface outside, -1 after the last.
        jump: 1 where a nearer surface of the same label ends the run, -1 a farther, 0 none.
    """

    begin: Int[np.ndarray, " n"]
    step: Int[np.ndarray, " n"]
    edge: Int[np.ndarray, " e"]
    run: Int[np.ndarray, "n wide"]
    jump: Int[np.ndarray, " n"]


def fringe_pixels(
    view: MaskView,
) -> tuple[Bool[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Return the pixels of fringes, and for these the label of the surface that they show.

    Empty for objects with so few that their masks may well be right. A fringe before its
    object counts only if it shows another object: the near rim of a plate continues the
    table as well.
    """
    reach = WIDE + _GAP + 1
    padded = MaskView(
        np.pad(view.labels, reach, constant_values=-1),
        np.pad(view.depth, reach),
        np.pad(view.rays, ((reach, reach), (reach, reach), (0, 0))),
        np.pad(view.slant, reach, mode="edge"),
        np.pad(view.height, reach),
        np.pad(view.on_plane, reach),
        view.pitch,
    )
    labels = padded.labels.ravel()
    mask, surface = np.zeros(len(labels), dtype=bool), np.zeros(len(labels), dtype=np.int32)
    wide: set[int] | None = None
    # Twice: the corner between two parts lies behind the fringes of both.
    for _ in range(2):
        lines = _follow(padded)
        beside = labels[lines.begin - lines.step]
        run = lines.run >= 0
        fringed = run[:, 0] & ((lines.jump == 1) | ((lines.jump == -1) & (beside > 0)))
        if wide is None:
            wide = _too_wide(padded, lines, fringed)
        fringed &= np.isin(labels[lines.begin], list(wide))
        if not fringed.any():
            break
        run = run[fringed]
        pixels = lines.run[fringed][run]
        mask[pixels] = True
        before = np.repeat((lines.begin - lines.step)[fringed], run.sum(axis=1))
        # What shows the table is of the table, whatever the pixel beside it is taken for; and
        # the pixel beside it may be a fringe of its own.
        shown = np.where(padded.on_plane.ravel()[pixels] | mask[before], 0, labels[before])
        surface[pixels] = shown
        labels[pixels] = shown
    inside = (slice(reach, -reach), slice(reach, -reach))
    shape = padded.labels.shape
    return mask.reshape(shape)[inside], surface.reshape(shape)[inside]


def _follow(view: MaskView) -> _Lines:
    """Walk from every pixel beside a mask, that has a return, inwards."""
    width = view.labels.shape[1]
    labels, depth, slant = view.labels.ravel(), view.depth.ravel(), view.slant.ravel()
    begins, steps, lengths = [], [], []
    masked = np.flatnonzero(labels > 0)
    own, at_edge = labels[masked], np.zeros(len(masked), dtype=bool)
    for row, column in _STEPS:
        step = row * width + column
        before = masked - step
        other = (labels[before] != own) & (labels[before] >= 0)
        at_edge |= other
        begin = masked[other & (depth[before] > 0)]
        begins.append(begin)
        steps.append(np.full(len(begin), step))
        lengths.append(np.full(len(begin), np.hypot(row, column)))
    begin, step, length = (np.concatenate(part) for part in (begins, steps, lengths))
    run = np.full((len(begin), WIDE), -1, dtype=np.int64)
    count = np.zeros(len(begin), dtype=np.int64)
    jump = np.zeros(len(begin), dtype=np.int64)
    last, since = begin - step, np.zeros(len(begin))
    going = np.arange(len(begin))
    for number in range(WIDE + _GAP):
        pixel = begin[going] + number * step[going]
        same = labels[pixel] == labels[begin[going]]
        going, pixel = going[same], pixel[same]
        since[going] += length[going]
        seen = depth[pixel] > 0
        blank, going, pixel = going[~seen], going[seen], pixel[seen]
        before = last[going]
        linked = _linked(before, pixel, since[going] * view.pitch, depth, slant)
        end = going[~linked]
        jump[end] = np.sign(depth[before] - depth[pixel])[~linked]
        going, pixel = going[linked], pixel[linked]
        room = count[going] < WIDE
        going, pixel = going[room], pixel[room]
        run[going, count[going]] = pixel
        count[going] += 1
        last[going], since[going] = pixel, 0.0
        going = np.concatenate([going, blank])
    return _Lines(begin, step, masked[at_edge & (depth[masked] > 0)], run, jump)


def _linked(
    first: Int[np.ndarray, " n"],
    second: Int[np.ndarray, " n"],
    spacing: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, " p"],
    slant: Float[np.ndarray, " p"],
) -> Bool[np.ndarray, " n"]:
    """Whether two pixels may lie on one surface: a steep one, or a level one seen at a glance."""
    change = depth[second] - depth[first]
    nearer = np.minimum(depth[first], depth[second])
    noise = _NOISE * depth_sigma(nearer)
    steep = np.abs(change) <= spacing * nearer * _STEEP + noise
    with np.errstate(divide="ignore", invalid="ignore"):
        level = depth[first] * (slant[first] / slant[second] - 1.0)
    level = np.where(np.isfinite(level), level, 0.0)
    return np.asarray(steep | (np.abs(change - level) <= 0.5 * np.abs(level) + noise))


def _too_wide(view: MaskView, lines: _Lines, fringed: Bool[np.ndarray, " n"]) -> set[int]:
    """Objects that have too many fringed lines for a mask that is right."""
    labels, on_plane = view.labels.ravel(), view.on_plane.ravel()
    ids, owner = np.unique(labels[lines.begin], return_inverse=True)
    on_table = fringed & (on_plane[lines.run] | (lines.run < 0)).all(axis=1)
    clean = (lines.jump == 1) & (lines.run[:, 0] < 0)
    hits, table_hits, clean_hits = (
        np.bincount(owner[chosen], minlength=len(ids)) for chosen in (fringed, on_table, clean)
    )
    total = np.maximum(hits + clean_hits, 1)
    edge, fringe_edge = (
        np.bincount(np.searchsorted(ids, labels[pixels]), minlength=len(ids))
        for pixels in (
            lines.edge[np.isin(labels[lines.edge], ids)],
            np.unique(lines.begin[fringed]),
        )
    )
    wide = (hits >= _FEWEST) & (hits >= _LINES * total) & (fringe_edge >= _EDGE * edge)
    wide |= (table_hits >= _FEWEST) & (table_hits >= _ON_TABLE * total)
    return set(ids[wide].tolist())
