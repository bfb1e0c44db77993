# SPDX-License-Identifier: BSD-3-Clause
"""A saved scene keeps the view and the truth apart, and both exact."""

import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import vprism_plan
from vprism_plan.errors import ObservationError
from vprism_plan.perception import load_observation
from vprism_plan.simulation import demo_scene, load_ground_truth, random_scene, save_scene

BUNDLED = Path(vprism_plan.__file__).parent / "data" / "demo_scene"


@pytest.mark.parametrize("name", ["scene", "scene.npz"])
def test_round_trip(tmp_path, name):
    scene = random_scene(4, 3, n_clutter=1)
    save_scene(scene, tmp_path / name)
    seen = load_observation(tmp_path / name)
    np.testing.assert_allclose(seen.depth, scene.observation.depth, atol=1e-6)
    np.testing.assert_array_equal(seen.labels, scene.observation.labels)
    np.testing.assert_allclose(seen.T_world_camera, scene.camera.T_world_camera, atol=1e-12)
    truth = load_ground_truth(tmp_path / name)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    np.testing.assert_array_equal(truth.signed_distance(points), scene.signed_distance(points))
    assert truth.observation.depth.tobytes() == scene.observation.depth.tobytes()


def test_missing_truth_is_named(tmp_path):
    with pytest.raises(ObservationError, match=r"ground_truth\.json does not exist"):
        load_ground_truth(tmp_path)


def test_bundled_scene_is_the_demo_scene_saved(tmp_path):
    """To the last digit but one: processors add three products in their own order."""
    save_scene(demo_scene(), tmp_path / "again")
    names = sorted(p.name for p in BUNDLED.iterdir())
    assert names == sorted(p.name for p in (tmp_path / "again").iterdir())
    assert {"ground_truth.json", "depth.png"} <= set(names)
    for name in names:
        kept, made = ((folder / name) for folder in (BUNDLED, tmp_path / "again"))
        if name.endswith(".json"):
            (form, numbers), (same_form, same_numbers) = (
                _taken_apart(p.read_text()) for p in (kept, made)
            )
            assert form == same_form
            np.testing.assert_allclose(same_numbers, numbers, rtol=1e-14, atol=1e-14)
        else:
            off = np.asarray(PIL.Image.open(kept)) != np.asarray(PIL.Image.open(made))
            assert off.sum() <= 5, name


def _taken_apart(text):
    """A JSON tree without its real numbers, and these, in order."""
    numbers = []
    return json.loads(text, parse_float=lambda digits: numbers.append(float(digits))), numbers
