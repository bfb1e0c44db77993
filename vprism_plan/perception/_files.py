# SPDX-License-Identifier: BSD-3-Clause
"""Reading and writing images and JSON so that every failure is one clear line."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vprism_plan import _files as _shared
from vprism_plan.errors import ObservationError

MOST_PIXELS = 2**25  # of an image that is read: 33 million
# PIL has readers for fifty formats, some of which start other programs.
_IMAGE_FORMATS = ("PNG", "TIFF", "JPEG", "PPM", "BMP")
_DEPTH_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_UINT16_MAX = 65535
_LABEL_MODES = (*_DEPTH_MODES, "L", "P", "1")


def _read_image(path: Path) -> tuple[np.ndarray, str]:
    from PIL import Image

    if not path.is_file():
        raise ObservationError(f"{path} is missing")
    with (
        _shared.reading(path, "a readable image", ObservationError),
        Image.open(path, formats=_IMAGE_FORMATS) as image,
    ):
        if image.width * image.height > MOST_PIXELS:
            raise ObservationError(
                f"{path} is an image of {image.width} x {image.height} pixels; at most "
                f"{MOST_PIXELS:,} are read"
            )
        return np.array(image), image.mode


def read_depth_image(path: Path) -> np.ndarray:
    """Return raw sensor units (H, W) of a 16-bit single-channel image, 0 = no return.

    The largest value that the pixel type holds means "no data" and becomes 0.
    """
    raw, mode = _read_image(path)
    if mode not in _DEPTH_MODES:
        raise ObservationError(
            f"{path} has pixel format {mode}; depth must be a 16-bit single-channel PNG (an "
            "8-bit image has lost the metric depth: export the raw one)"
        )
    largest = np.iinfo(raw.dtype).max
    if raw.max() == _UINT16_MAX:  # 16 bits may arrive in a wider type
        largest = _UINT16_MAX
    return np.where(raw == largest, 0, raw).astype(raw.dtype)


def read_label_image(path: Path) -> np.ndarray:
    """Return integer ids (H, W) of a single-channel image, palette images by index."""
    raw, mode = _read_image(path)
    if mode not in _LABEL_MODES:
        raise ObservationError(
            f"{path} has pixel format {mode}; labels must be a single-channel 8- or 16-bit "
            "PNG of object ids, 0 for background"
        )
    return raw.astype(np.int32)


def read_color_image(path: Path) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB; grey images are repeated, alpha is dropped."""
    raw, mode = _read_image(path)
    if mode == "L":
        return np.repeat(raw[..., None], 3, axis=2)
    if mode not in ("RGB", "RGBA"):
        raise ObservationError(f"{path} has pixel format {mode}; color must be an 8-bit RGB image")
    return np.ascontiguousarray(raw[..., :3])


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    return _shared.read_json(path, ObservationError)


def number(content: dict[str, Any], key: str, path: Path, default: float | None = None) -> float:
    """Return a finite number from a JSON object, or name what is missing."""
    if key not in content and default is not None:
        return default
    value: Any = content.get(key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and abs(value) <= sys.float_info.max:  # else float() fails on whole numbers
        return float(value)
    found = "is missing" if key not in content else f"is {value!r}"
    raise ObservationError(f"{path}: {key!r} {found}; it must be a finite number")


def positive_number(
    content: dict[str, Any], key: str, path: Path, default: float | None = None
) -> float:
    """Return a finite number above 0 from a JSON object."""
    value = number(content, key, path, default)
    if value <= 0:
        raise ObservationError(f"{path}: {key!r} is {value:g}; it must be positive")
    return value


def matrix(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return a float64 array of the given shape from a flat or nested JSON list."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ObservationError(f"{what} is not a matrix of numbers: {error}") from error
    if array.size != int(np.prod(shape)):
        raise ObservationError(
            f"{what} has {array.size} numbers; it must have {int(np.prod(shape))} ({shape})"
        )
    return array.reshape(shape)


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write through a temporary file beside `path`, so no half-written file ever remains."""
    with _shared.replacing(path) as temporary, temporary.open("wb") as stream:
        write(stream)
