# SPDX-License-Identifier: BSD-3-Clause
"""A map on disk is the same map, and a file that is not one is refused."""

import json
import os

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from vprism_plan.errors import MapError
from vprism_plan.mapping import load_map
from vprism_plan.mapping.serialization import FORMAT_VERSION


@pytest.fixture(scope="module")
def saved(small_map, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    small_map.save(path)
    return path


def rewrite(saved, path, meta=None, **tensors):
    with safe_open(saved, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = json.loads(file.metadata()["vprism_plan"])
    arrays.update(tensors)
    header.update(meta or {})
    save_file(
        {k: np.ascontiguousarray(v) for k, v in arrays.items() if v is not None},
        path,
        metadata={"vprism_plan": json.dumps(header)},
    )
    return path


def test_a_loaded_map_answers_with_the_same_bits(small_map, saved, query):
    loaded = load_map(saved)
    np.testing.assert_array_equal(loaded.predict_proba(query), small_map.predict_proba(query))
    np.testing.assert_array_equal(loaded.support(query), small_map.support(query))
    np.testing.assert_array_equal(
        loaded.occupancy_log_odds(query), small_map.occupancy_log_odds(query)
    )
    np.testing.assert_array_equal(loaded.sample_weights(2, 0), small_map.sample_weights(2, 0))
    assert loaded.config == small_map.config
    assert loaded.object_ids == small_map.object_ids
    assert loaded.history == small_map.history
    assert loaded.seed == small_map.seed
    assert loaded.unsupported_occupancy == small_map.unsupported_occupancy


def test_views_and_plane_come_along(small_map, saved):
    loaded = load_map(saved)
    np.testing.assert_array_equal(loaded.plane.normal, small_map.plane.normal)
    assert loaded.plane.offset == small_map.plane.offset
    for new, old in zip(loaded.views, small_map.views, strict=True):
        for part in ("depth", "labels", "intrinsics", "T_world_camera", "color"):
            a, b = getattr(new, part), getattr(old, part)
            assert (a is None) == (b is None)
            if a is not None:
                assert a.dtype == b.dtype
                np.testing.assert_array_equal(a, b)


def test_far_depth_of_a_view_is_kept(small_map, saved, tmp_path):
    far = small_map.views[0].depth.copy()
    far[:2] = 15.0
    changed = {"view0.depth": far}
    read = load_map(rewrite(saved, tmp_path / "far.safetensors", {"max_range": [20.0]}, **changed))
    read.save(tmp_path / "again.safetensors")
    (new,) = load_map(tmp_path / "again.safetensors").views
    assert new.max_range == 20.0
    np.testing.assert_array_equal(new.depth, far)
    # A file from before the limit knows none: the map was learned from all that it holds.
    old = rewrite(
        saved, tmp_path / "old.safetensors", {"max_range": [None]}, **{"view0.depth": far}
    )
    np.testing.assert_array_equal(load_map(old).views[0].depth, far)
    with pytest.raises(MapError, match="damaged"):
        load_map(rewrite(saved, tmp_path / "bad.safetensors", {"max_range": [10.0, 10.0]}))


def test_a_loaded_map_can_be_updated(saved, small_map, second_view, query):
    np.testing.assert_array_equal(
        load_map(saved).update(second_view).occupancy(query),
        small_map.update(second_view).occupancy(query),
    )


def test_saving_leaves_one_file_and_replaces_whole(small_map, tmp_path):
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"old")
    small_map.save(path)
    assert os.listdir(tmp_path) == ["m.safetensors"]  # noqa: PTH208
    assert load_map(path).object_ids == small_map.object_ids


def test_a_failed_save_leaves_the_old_file(small_map, tmp_path, monkeypatch):
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"old")

    def full(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr("vprism_plan.mapping.serialization.save_file", full)
    with pytest.raises(OSError, match="no space"):
        small_map.save(path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["m.safetensors"]  # noqa: PTH208


def test_no_folder_no_map(small_map, tmp_path):
    with pytest.raises(MapError, match="folder"):
        small_map.save(tmp_path / "nowhere" / "m.safetensors")


def test_missing_truncated_and_foreign_files(saved, tmp_path):
    with pytest.raises(MapError, match="no map at"):
        load_map(tmp_path / "none.safetensors")
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(saved.read_bytes()[:5000])
    with pytest.raises(MapError, match="cannot be read"):
        load_map(cut)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"a": np.zeros(3)}, foreign)
    with pytest.raises(MapError, match="not a map"):
        load_map(foreign)


def test_another_version_and_damage_are_named(saved, tmp_path):
    path = tmp_path / "m.safetensors"
    with pytest.raises(MapError, match="version"):
        load_map(rewrite(saved, path, {"version": FORMAT_VERSION + 1}))
    with pytest.raises(MapError, match="covariance"):
        load_map(rewrite(saved, path, covariance=np.zeros((3, 3))))
    with pytest.raises(MapError, match="mean"):
        load_map(rewrite(saved, path, mean=np.full_like(load_map(saved).posterior.mean, np.nan)))
    with pytest.raises(MapError, match="damaged"):
        load_map(rewrite(saved, path, hinges=None))
    with pytest.raises(MapError, match="damaged"):
        load_map(rewrite(saved, path, {"config": {"gamma": 3.0}}))
