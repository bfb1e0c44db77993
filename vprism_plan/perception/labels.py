# SPDX-License-Identifier: BSD-3-Clause
"""Labels in the forms that segmentation hands over, turned into one image of object ids."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vprism_plan import _files
from vprism_plan._arguments import whole
from vprism_plan._shapes import Ids, Pixels
from vprism_plan.errors import ObservationError

_MOST_COLOURS = 256
_LARGEST = np.iinfo(np.int32).max
_FORMS = (
    "give ids (H, W), masks (N, H, W), colours (H, W, 3), or a list of SAM's or COCO's masks, "
    "registered to the depth"
)


def label_image(
    value: Any, shape: tuple[int, int], background_ids: Any = ()
) -> tuple[Ids, tuple[str, ...]]:
    """Return labels as an image of ids (H, W), 0 = background, and what is odd about them.

    Args:
        value: one of
            - ids (H, W): integers, 0 = background;
            - masks (N, H, W) or (N, 1, H, W): 0 and not 0; mask i (from 0) is object i + 1;
            - a list of masks as SAM and SAM 2 (`segmentation`) or COCO (annotations, run
              lengths, polygons) have them, numbered likewise, or a dict of masks by their ids;
            - colours (H, W, 3 or 4), uint8: the id is 0xRRGGBB, so black is background and
              one colour is one object in every view; grey levels are ids.
            Where masks overlap, the smaller one has the pixel.
        shape: (H, W) of the depth.
        background_ids: ids that are no object; they become 0.

    Raises:
        ObservationError: what is wrong, and what would be valid.
        MissingDependencyError: COCO's forms need the extra `formats`.
    """
    masks = _listed(value)
    found: tuple[str, ...] = ()
    if masks is None:
        array = to_numpy(value, "labels")
        if array.ndim == 4 and array.shape[1] == 1:
            array = array[:, 0]
        if array.ndim == 3 and array.shape[1:] == shape:
            masks = dict(enumerate(array, start=1))
        elif array.ndim == 3 and array.shape[:2] == shape and array.shape[2] in (3, 4):
            array = _of_colours(array)
    if masks is not None:
        labels, found = _painted(masks, shape)
    else:
        labels = _checked(array, shape)
    given = np.atleast_1d(np.array(background_ids, dtype=object))
    if ids := [whole("background_ids", i, error=ObservationError) for i in given]:
        labels[np.isin(labels, ids)] = 0
    return labels, found


def to_numpy(value: Any, name: str) -> np.ndarray:
    """Return a fresh array from an array, nested list or torch tensor (any device)."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    try:
        array = np.array(value)
    except (ValueError, TypeError) as error:
        raise ObservationError(f"{name} is not an array: {error}") from error
    if array.dtype.kind not in "biuf":
        kind = "Python objects" if array.dtype == object else array.dtype
        raise ObservationError(f"{name} holds {kind} ({type(value).__name__}); give numbers")
    return array


def _checked(labels: np.ndarray, shape: tuple[int, int]) -> Ids:
    if labels.shape != shape:
        raise ObservationError(f"labels have shape {labels.shape} but depth {shape}; {_FORMS}")
    if labels.dtype.kind not in "iub":
        wanted = "they must be integers: 0 background, 1, 2, ... objects"
        raise ObservationError(f"labels are {labels.dtype}; {wanted}")
    if labels.min() < 0 or labels.max() > _LARGEST:
        worst = labels.min() if labels.min() < 0 else labels.max()
        wanted = "they must be 0 (background) or positive object ids that fit in int32"
        raise ObservationError(f"labels contain {worst}; {wanted}")
    return np.ascontiguousarray(labels, dtype=np.int32)


def _of_colours(image: np.ndarray) -> np.ndarray:
    """Ids of the colours of an image (H, W, 3 or 4)."""
    if image.dtype != np.uint8:
        raise ObservationError(f"a label image of colours is {image.dtype}; it must be uint8")
    red, green, blue = np.moveaxis(image[..., :3].astype(np.int32), -1, 0)
    if (red == green).all() and (green == blue).all():
        return red
    labels = red << 16 | green << 8 | blue
    if (count := len(np.unique(labels))) > _MOST_COLOURS:
        raise ObservationError(
            f"the label image has {count} colours, more than {_MOST_COLOURS}: is it a photograph, "
            "or smoothed at edges? Save labels as PNG, without JPEG or interpolation"
        )
    return labels


# -------------------------------------------------------------------------------------- masks
def _listed(value: Any) -> dict[int, Any] | None:
    """Return masks by id if the value is a list or dict of such, else None."""
    if isinstance(value, Mapping) and isinstance(value.get("annotations"), list):
        images = {item.get("image_id") for item in value["annotations"] if isinstance(item, dict)}
        if len(images) > 1:
            raise ObservationError(
                f"annotations are of {len(images)} images; give the list of those of this one"
            )
        value = value["annotations"]
    if isinstance(value, Mapping) and not {"counts", "segmentation"} & value.keys():
        try:
            return {whole("id of a mask", int(key), 1): mask for key, mask in value.items()}
        except (TypeError, ValueError) as error:
            raise ObservationError(f"keys of masks must be object ids from 1: {error}") from error
    if isinstance(value, Mapping):
        return {1: value}
    if isinstance(value, list | tuple) and all(isinstance(item, Mapping) for item in value):
        return dict(enumerate(value, start=1))
    return None


def _painted(masks: dict[int, Any], shape: tuple[int, int]) -> tuple[Ids, tuple[str, ...]]:
    """Paint masks from the largest to the smallest."""
    found = {key: _mask(mask, shape, f"mask {key}") for key, mask in masks.items()}
    area = {key: int(mask.sum()) for key, mask in found.items()}
    labels = np.zeros(shape, dtype=np.int32)
    for key in sorted(found, key=lambda key: -area[key]):
        labels[found[key]] = key
    covered = [key for key in found if area[key] and not (labels == key).any()]
    if not covered:
        return labels, ()
    return labels, (
        f"masks {covered} lie wholly under smaller ones and have no pixel left; drop what is part "
        "of an object from the list of masks",
    )


def _mask(value: Any, shape: tuple[int, int], what: str) -> Pixels:
    """Return one mask (H, W) of whatever form."""
    if isinstance(value, Mapping) and "segmentation" in value:
        value = value["segmentation"]
    lengths = isinstance(value, Mapping)
    # An image has as many rows as the depth; what else is a list of lists is polygons.
    rows = value if isinstance(value, list) else []
    if lengths or (rows and (len(rows) != shape[0] or len(rows[0]) != shape[1])):
        return _decoded(value, shape, what)
    mask = to_numpy(value, what)
    mask = mask[0] if mask.ndim == 3 and len(mask) == 1 else mask
    if mask.shape != shape:
        raise ObservationError(f"{what} has shape {mask.shape} but depth {shape}; {_FORMS}")
    if mask.dtype.kind == "f" and not np.isin(mask, (0.0, 1.0)).all():
        raise ObservationError(f"{what} holds {mask.dtype} numbers; give scores > threshold")
    return np.asarray(mask != 0)


def _decoded(value: Any, shape: tuple[int, int], what: str) -> Pixels:
    """Return the mask that run lengths or polygons in COCO's forms describe."""
    coco = _files.optional("pycocotools.mask", "formats", "COCO's run lengths and polygons need")
    height, width = shape
    if isinstance(value, Mapping):
        size = [int(number) for number in value.get("size", ())]
        if size != [height, width]:
            raise ObservationError(f"{what} is of size {size} but depth {shape}; {_FORMS}")
    with _files.reading(what, "a mask in COCO's form", ObservationError):
        coded = value
        if not isinstance(value, Mapping):
            coded = coco.merge(coco.frPyObjects(value, height, width))
        elif isinstance(value.get("counts"), list):
            coded = coco.frPyObjects(value, height, width)
        mask = coco.decode(coded)
        # Runs that end early leave memory as it was: they would fit into one pixel less.
        try:
            coco.decode({"size": [1, height * width - 1], "counts": coded["counts"]})
        except ValueError:
            return np.asarray(mask != 0)
        raise ObservationError(f"{what}: its run lengths end before the last of {shape} pixels")
