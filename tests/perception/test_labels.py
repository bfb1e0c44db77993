# SPDX-License-Identifier: BSD-3-Clause
"""Labels in every form become the same ids; overlaps go to the smaller mask."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation
from vprism_plan.perception.labels import label_image

SHAPE = (12, 16)
LARGE, SMALL = np.zeros((2, *SHAPE), bool)
LARGE[2:9, 2:12] = True
SMALL[4:6, 4:7] = True
IDS = np.where(SMALL, 2, np.where(LARGE, 1, 0))
STACK = np.stack([LARGE, SMALL])


def encoded(mask, text=False):
    found = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {**found, "counts": found["counts"].decode()} if text else found


def runs(mask):
    """COCO's uncompressed form, by hand: lengths of 0, 1, 0, ... down the columns."""
    flat, counts, last = mask.T.ravel(), [0], False
    for value in flat:
        if value != last:
            counts, last = [*counts, 0], value
        counts[-1] += 1
    return {"size": list(SHAPE), "counts": counts}


def corners(mask):
    rows, columns = np.nonzero(mask)
    (top, bottom), (left, right) = ((int(v.min()), int(v.max()) + 1) for v in (rows, columns))
    return [[left, top, right, top, right, bottom, left, bottom]]


FORMS = {
    "ids": IDS,
    "ids in a list": IDS.tolist(),
    "masks": STACK,
    "masks in a list": list(STACK),
    "masks of 0 and 1": STACK.astype(np.uint8),
    "masks of floats": STACK.astype(np.float32),
    "masks with a channel": STACK[:, None],
    "a tensor of masks": torch.from_numpy(STACK),
    "SAM": [{"segmentation": m, "area": 1, "predicted_iou": 0.9} for m in STACK],
    "SAM, coded": [{"segmentation": encoded(m), "bbox": [0, 0, 1, 1]} for m in STACK],
    "run lengths": [encoded(m) for m in STACK],
    "run lengths as text": [encoded(m, text=True) for m in STACK],
    "run lengths as numbers": [runs(m) for m in STACK],
    "polygons": [{"segmentation": corners(m), "category_id": 5} for m in STACK],
    "a COCO file": {"annotations": [{"segmentation": encoded(m), "image_id": 3} for m in STACK]},
    "masks by id": {1: LARGE, 2: SMALL[None]},
    "masks by ids of JSON": {"1": encoded(LARGE), "2": runs(SMALL)},
    "grey as colours": np.repeat(IDS[..., None], 3, axis=2).astype(np.uint8),
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_is_the_same_labels(name):
    labels, found = label_image(FORMS[name], SHAPE)
    np.testing.assert_array_equal(labels, IDS)
    assert labels.dtype == np.int32
    assert found == ()
    seen = Observation(np.ones(SHAPE), FORMS[name], np.diag([9.0, 9.0, 1.0]))
    assert seen.object_ids == (1, 2)


def test_the_order_of_masks_is_that_of_ids_not_of_painting():
    labels, _ = label_image(STACK[::-1], SHAPE)
    np.testing.assert_array_equal(labels, np.where(SMALL, 1, np.where(LARGE, 2, 0)))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_a_pixel_belongs_to_the_smallest_of_its_masks(seed, count):
    rng = np.random.default_rng(seed)
    stack = rng.random((count, *SHAPE)) < rng.uniform(0.05, 0.9, (count, 1, 1))
    labels, _ = label_image(stack, SHAPE)
    for row, column in np.ndindex(SHAPE):
        own = [i for i in range(count) if stack[i, row, column]]
        smallest = min((int(stack[i].sum()) for i in own), default=0)
        value = labels[row, column]
        assert (value == 0) == (not own)
        assert not own or (value - 1 in own and stack[value - 1].sum() == smallest)


def test_a_covered_mask_is_named():
    labels, (text,) = label_image([SMALL, SMALL], SHAPE)
    assert (labels == 0).sum() == SMALL.size - SMALL.sum()
    assert "lie wholly under smaller ones" in text
    seen = Observation(np.ones(SHAPE), [SMALL, SMALL], np.diag([9.0, 9.0, 1.0]))
    assert text in seen.warnings


def test_colours_are_ids_whatever_else_is_in_the_image():
    palette = np.array([[0, 0, 0], [255, 0, 1], [0, 2, 0]], np.uint8)
    labels, _ = label_image(palette[IDS], SHAPE)
    np.testing.assert_array_equal(np.unique(labels), [0, 0x000200, 0xFF0001])
    alone, _ = label_image(palette[np.where(SMALL, 2, 0)], SHAPE)
    assert set(np.unique(alone)) <= set(np.unique(labels))


def test_background_ids_are_no_objects():
    assert label_image(IDS, SHAPE, 1)[0].max() == 2
    view = Observation(np.ones(SHAPE), STACK, np.diag([9.0, 9.0, 1.0]), background_ids=[1])
    np.testing.assert_array_equal(view.labels, np.where(SMALL, 2, 0))
    # What was named once is not taken again.
    assert replace(view, labels=IDS).object_ids == (1, 2)


def test_nothing_found_is_no_label():
    for nothing in ([], {}, np.zeros((0, *SHAPE), bool)):
        labels, _ = label_image(nothing, SHAPE)
        assert labels.shape == SHAPE
        assert not labels.any()


photo = np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8)
FAULTS = {
    "scores": (STACK * 0.7, "scores > threshold"),
    "another size": ([encoded(LARGE.T)], r"mask 1 is of size \[16, 12\]"),
    "another shape": (STACK[:, :5], r"labels have shape \(2, 5, 16\)"),
    "one of another shape": ([{"segmentation": LARGE}, {"segmentation": LARGE[:3]}], "mask 2"),
    "colours of 16 bits": (np.zeros((*SHAPE, 3), np.uint16), "uint16; it must be uint8"),
    "ids of words": ({"cup": LARGE}, "keys of masks must be object ids"),
    "id 0": ({0: LARGE}, "id of a mask is 0"),
    "two images": (
        {"annotations": [{"image_id": i, "segmentation": encoded(LARGE)} for i in (1, 2)]},
        "annotations are of 2 images",
    ),
    "runs cut short": (
        [{"size": list(SHAPE), "counts": encoded(LARGE)["counts"][:3]}],
        "end before",
    ),
    "too many runs": ([{"size": list(SHAPE), "counts": [500, 3]}], "not a mask in COCO's form"),
    "floats": (IDS + 0.5, "labels are float64"),
    "negative": (IDS - 1, "labels contain -1"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(name):
    value, message = FAULTS[name]
    with pytest.raises(ObservationError, match=message):
        label_image(value, SHAPE)


def test_a_photograph_is_no_label_image():
    with pytest.raises(ObservationError, match=r"1\d\d\d colours, more than 256: is it a photogr"):
        label_image(photo, (40, 40))


@pytest.mark.parametrize("wrong", [[-1], ["a"], [True], [1.5]])
def test_background_ids_must_be_ids(wrong):
    with pytest.raises(ObservationError, match="background_ids"):
        label_image(IDS, SHAPE, wrong)
