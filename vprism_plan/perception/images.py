# SPDX-License-Identifier: BSD-3-Clause
"""Depth, labels and colour from files, and what a lens bent in them made straight."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan import _files
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import undistort
from vprism_plan.perception.camera_files import MILLIMETRE, CameraFile
from vprism_plan.perception.labels import label_image
from vprism_plan.perception.observation import Observation, check_intrinsics

MOST_PIXELS = 2**25  # of an image that is read: 33 million
MOST_UNPACKED = 16 * MOST_PIXELS  # bytes of arrays: float64 with labels and colour
# PIL has readers for fifty formats, some of which start other programs.
_FORMATS = ("PNG", "TIFF", "JPEG", "PPM", "BMP")
_WHOLE_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_DEPTH_MODES = (*_WHOLE_MODES, "F")
_LABEL_MODES = (*_WHOLE_MODES, "L", "P", "1", "RGB", "RGBA")
UINT16_MAX = 65535


def read_depth(path: Path) -> np.ndarray:
    """Return depth (H, W) as it is: raw sensor units, 0 also for "no data", or floats."""
    if path.suffix == ".npy":
        return without_no_data(read_array(path))
    remedy = "an 8-bit image has lost the metric depth: export the raw one"
    wanted = f"depth must be a 16-bit or float single-channel PNG or TIFF ({remedy})"
    return without_no_data(_read(path, _DEPTH_MODES, wanted)[0])


def without_no_data(raw: np.ndarray) -> np.ndarray:
    """Return whole sensor units with 0 for the largest that they hold; floats as they are."""
    if raw.dtype.kind not in "iu" or not raw.size:
        return raw
    # 16 bits may arrive in a wider type.
    largest = UINT16_MAX if raw.max() == UINT16_MAX else np.iinfo(raw.dtype).max
    return np.where(raw == largest, 0, raw).astype(raw.dtype)


def metric(raw: np.ndarray, camera: CameraFile, what: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return depth in metres, and what was assumed about its unit."""
    if camera.depth_scale is not None:
        return raw * np.float64(camera.depth_scale), ()
    if raw.dtype.kind == "f":
        return raw, ()
    return raw * MILLIMETRE, (
        f"{what} states no depth_scale: whole numbers are taken as millimetres; give "
        "'depth_scale' in metres per unit",
    )


def read_labels(path: Path) -> Any:
    """Return labels in any form that `label_image` takes."""
    if path.suffix == ".json":
        with _files.reading(path, "readable JSON", ObservationError, _files.MOST_TEXT):
            return json.loads(path.read_text(encoding="utf-8"))
    if path.suffix == ".npy":
        return read_array(path)
    wanted = "labels must be an 8- or 16-bit image of object ids, 0 for background, or of colours"
    pixels, mode = _read(path, _LABEL_MODES, wanted)
    return pixels if mode.startswith("RGB") else pixels.astype(np.int32)


def read_color(path: Path) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB; grey images are repeated, alpha is dropped."""
    raw, mode = _read(path, ("L", "RGB", "RGBA"), "color must be an 8-bit RGB image")
    return np.repeat(raw[..., None], 3, 2) if mode == "L" else np.ascontiguousarray(raw[..., :3])


def read_array(path: Path) -> np.ndarray:
    """Return the array in an .npy file, read without pickle."""
    with _files.reading(path, "a readable .npy without pickle", ObservationError, MOST_UNPACKED):
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ObservationError(f"{path} is no .npy file")
        return array


def _read(path: Path, modes: tuple[str, ...], wanted: str) -> tuple[np.ndarray, str]:
    """Return an image in one of some pixel formats (PIL's modes), and which.

    Of more pages than one it is (N, H, W).
    """
    from PIL import Image, ImageSequence

    if not path.is_file():
        raise ObservationError(f"{path} is missing")
    with (
        _files.reading(path, "a readable image", ObservationError),
        Image.open(path, formats=_FORMATS) as image,
    ):
        pages = getattr(image, "n_frames", 1)
        if image.width * image.height * pages > MOST_PIXELS:
            size = f"{image.width} x {image.height} pixels; at most {MOST_PIXELS:,} are read"
            raise ObservationError(f"{path} is an image of {size}")
        mode = image.mode
        stack = np.stack([np.array(page) for page in ImageSequence.Iterator(image)])
    if mode not in modes:
        raise ObservationError(f"{path} has pixel format {mode}; {wanted}")
    return stack if len(stack) > 1 else stack[0], mode


def straight(given: dict[str, Any], camera: CameraFile) -> Observation:
    """Return the observation of what a lens of this distortion shows."""
    lens, shape = camera.lens, given["depth"].shape
    if lens is not None:
        if given["labels"] is not None:
            labels, found = label_image(given["labels"], shape)
            given |= {"labels": labels, "warnings": given["warnings"] + found}
        intrinsics = check_intrinsics(camera.intrinsics, shape)
        for name in ("depth", "labels", "color"):
            if given.get(name) is not None:
                given[name] = undistort(given[name], lens, intrinsics)
    return Observation(intrinsics=camera.intrinsics, **given)
