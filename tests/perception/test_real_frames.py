# SPDX-License-Identifier: BSD-3-Clause
"""Five RealSense images of real tables: what must hold on each, whatever the sensor did."""

import numpy as np
import pytest

from vprism_plan.perception import align_to_table, fit_plane, load_observation, segment_tabletop

# Objects that a person counts, a stack as one: (fewest, most) clusters that are acceptable.
OBJECTS = {
    "frame0": (10, 10),
    "frame2": (7, 8),
    "frame4": (4, 5),
    "frame6": (7, 8),
    "frame8": (8, 9),
}
# Share of the pixels with a return on the table top, and camera height over it (metres).
TABLE = {
    "frame0": (0.5, 0.697),
    "frame2": (0.7, 0.577),
    "frame4": (0.5, 0.384),
    "frame6": (0.25, 0.651),
    "frame8": (0.3, 0.442),
}


@pytest.fixture(scope="module")
def scenes(real_frames):
    return {
        path.stem.removesuffix("-depth"): segment_tabletop(load_observation(path))
        for path in real_frames
    }


@pytest.mark.parametrize("name", OBJECTS)
def test_table_and_objects(scenes, name):
    obs = scenes[name]
    fewest, most = OBJECTS[name]
    assert fewest <= len(obs.object_ids) <= most
    share, camera_height = TABLE[name]
    height = obs.plane.signed_distance(obs.points()[0])
    assert (np.abs(height) < 0.01).mean() > share
    assert abs(-obs.plane.offset - camera_height) < 0.01
    labels = obs.points()[1]
    for k in obs.object_ids:
        above = height[labels == k]
        assert np.median(above) > 0.01
        assert np.percentile(above, 99) < 0.45
        points = obs.points()[0][labels == k]
        assert np.ptp(points, axis=0).max() < 0.5


@pytest.mark.parametrize("name", OBJECTS)
def test_little_is_removed_and_aligned_table_is_level(scenes, name, real_frames):
    path = next(p for p in real_frames if p.stem.startswith(name))
    raw = load_observation(path)
    removed = (raw.depth > 0) & (scenes[name].depth == 0)
    assert 0 < removed.sum() < 0.01 * removed.size
    aligned = align_to_table(scenes[name])
    points, labels = aligned.points()
    on_table = np.abs(points[:, 2]) < 0.01
    assert abs(np.median(points[on_table, 2])) < 0.002
    np.testing.assert_allclose(points[labels > 0].mean(axis=0)[:2], 0.0, atol=1e-9)
    assert 0.3 < aligned.camera_center[2] < 0.8
    assert aligned.camera_center[0] < -0.2


def test_seed_hardly_matters(real_frames):
    obs = load_observation(real_frames[0])
    first, second = fit_plane(obs, seed=0), fit_plane(obs, seed=9)
    assert first.normal @ second.normal > 1 - 1e-8
    assert abs(first.offset - second.offset) < 1e-4
