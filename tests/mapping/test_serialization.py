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
from vprism_plan.mapping.serialization import FORMAT_VERSION, content_digest


@pytest.fixture(scope="module")
def saved(small_map, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    small_map.save(path)
    return path


def rewrite(saved, path, meta=None, digest=None, **tensors):
    """A map file with some of its content exchanged, and a digest that is right for it."""
    with safe_open(saved, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = json.loads(file.metadata()["vprism_plan"])
    arrays.update(tensors)
    header.update(meta or {})
    arrays = {k: np.ascontiguousarray(v) for k, v in arrays.items() if v is not None}
    text = json.dumps(header)
    digest = content_digest(text, arrays) if digest is None else digest
    save_file(arrays, path, metadata={"vprism_plan": text, "sha256": digest})
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
    with pytest.raises(MapError, match="not a readable map"):
        load_map(cut)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"a": np.zeros(3)}, foreign)
    with pytest.raises(MapError, match="not a map"):
        load_map(foreign)


def test_another_version_and_damage_are_named(saved, tmp_path):
    path = tmp_path / "m.safetensors"
    with pytest.raises(MapError, match="version"):
        load_map(rewrite(saved, path, {"version": FORMAT_VERSION + 1}))
    with pytest.raises(MapError, match="precision"):
        load_map(rewrite(saved, path, **{"class1.precision": np.zeros((3, 3))}))
    nowhere = np.full_like(load_map(saved).posterior.classes[2].mean, np.nan)
    with pytest.raises(MapError, match=r"class2\.mean"):
        load_map(rewrite(saved, path, **{"class2.mean": nowhere}))
    with pytest.raises(MapError, match="damaged"):
        load_map(rewrite(saved, path, hinges=None))
    with pytest.raises(MapError, match="damaged"):
        load_map(rewrite(saved, path, {"config": {"gamma": 3.0}}))


def same_answers(found, expected, query):
    """Whether two maps say the same, bit by bit, of what is there and of what was seen."""
    views = zip(found.views, expected.views, strict=True)
    return (
        (found.object_ids, found.config, found.seed, found.warnings)
        == (expected.object_ids, expected.config, expected.seed, expected.warnings)
        and np.array_equal(found.predict_proba(query), expected.predict_proba(query))
        and np.array_equal(found.plane.normal, expected.plane.normal)
        and found.plane.offset == expected.plane.offset
        and all(
            np.array_equal(getattr(a, part), getattr(b, part))
            for a, b in views
            for part in ("depth", "labels", "intrinsics", "T_world_camera")
        )
    )


def test_any_flipped_bit_is_noticed_or_without_effect(saved, small_map, tmp_path, query):
    whole = bytearray(saved.read_bytes())
    header = 8 + int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    # Most bits are numbers; a header's are names, shapes and what the map is.
    places = [*rng.integers(0, 8 * len(whole), 20), *rng.integers(0, 8 * header, 40)]
    path, loaded = tmp_path / "m.safetensors", 0
    for place in places:
        whole[place // 8] ^= 1 << (place % 8)
        path.write_bytes(whole)
        whole[place // 8] ^= 1 << (place % 8)
        try:
            found = load_map(path)
        except MapError:
            continue
        loaded += 1
        assert same_answers(found, small_map, query), f"bit {place}"
    assert loaded < 10


CRAFTED = {
    "no views": ({"views": 0}, {}, "learned from one"),
    "fewer views": ({"views": 10**12}, {}, "learned from one"),
    "a view too many": ({"views": 2, "max_range": [10.0, 10.0]}, {}, "view 1 has no depth"),
    "a stray tensor": ({}, {"view7.depth": np.ones((2, 2))}, r"view7\.depth belong to none"),
    "ids in no order": ({"object_ids": [2, 1]}, {}, "positive and rise"),
    "an id of 0": ({"object_ids": [0, 1]}, {}, "positive and rise"),
    "an id twice": ({"object_ids": [1, 1]}, {}, "positive and rise"),
    "ids that nobody saw": ({"object_ids": [1, 2, 9]}, {}, "views show"),
    "a radius of another kernel": ({"radius": (0.5).hex()}, {}, "radius"),
    "a seed": ({"seed": -1}, {}, "seed"),
    "warnings": ({"warnings": [3]}, {}, "sentences"),
    "a plane": ({}, {"plane": np.array([0.0, 0.0, 2.0, 0.1])}, "unit normal"),
    "a history": ({}, {"history": np.array([np.nan])}, "history"),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_parts_that_do_not_fit_together_are_named(saved, tmp_path, name):
    meta, tensors, message = CRAFTED[name]
    with pytest.raises(MapError, match=message):
        load_map(rewrite(saved, tmp_path / "m.safetensors", meta, **tensors))


def test_precisions_of_no_posterior_are_refused(saved, tmp_path):
    path = tmp_path / "m.safetensors"
    (own, space) = (load_map(saved).posterior.classes[1], load_map(saved).space)
    rows, columns = own.space.pairs.T
    values = own.precision[own.space.base[rows] + columns]
    with pytest.raises(MapError, match="not positive definite"):
        load_map(rewrite(saved, path, **{"class1.precision": -values}))
    for wrong in ([3, 1, space.size - 1], [-1, space.size - 1], [0, 1]):
        with pytest.raises(MapError, match=r"class1\.members"):
            load_map(rewrite(saved, path, **{"class1.members": np.array(wrong, np.int32)}))
    some = {f"class0.{name}": np.zeros(0, np.int32) for name in ("members", "mean", "precision")}
    with pytest.raises(MapError):
        load_map(rewrite(saved, path, **some))


def test_hinges_whose_pairs_would_fill_the_memory_are_refused(saved, tmp_path):
    same = np.zeros((200_000, 3))  # 2e10 pairs
    with pytest.raises(MapError, match="200000 hinges make"):
        load_map(rewrite(saved, tmp_path / "m.safetensors", hinges=same))
    with pytest.raises(MapError, match="farther than"):
        load_map(rewrite(saved, tmp_path / "m.safetensors", hinges=np.full((5, 3), 1e300)))


def test_a_wrong_digest_is_refused(saved, tmp_path):
    with pytest.raises(MapError, match="SHA-256"):
        load_map(rewrite(saved, tmp_path / "m.safetensors", digest="0" * 64))
