# SPDX-License-Identifier: BSD-3-Clause
"""What a stored answer is filed under: everything that it depends on, and nothing else."""

from pathlib import Path

import pytest
import trimesh
from oracles.small_scenes import small_scene

from experiments import generation
from experiments.generation import sources
from experiments.generation.sources import YCB_VARIABLE, chosen_folder
from experiments.tables import scoring
from experiments.tables.store import Case, Store
from experiments.tables.sweep import filed_as
from vprism_plan.errors import ConfigError


def meshes(folder, size=0.1, name="box.ply"):
    folder.mkdir(exist_ok=True)
    trimesh.creation.box(extents=(size, size, size)).export(folder / name)
    return folder


def filed(case):
    """Name of the file that an answer is kept in."""
    return Store(Path("x"), filed_as(scoring.score)).path(case).name


def ycb_case(data=None):
    (case,) = scoring.cases("ycb", [1000], ["voxel"], data)
    return case


def test_answers_about_the_usual_meshes_stay_where_they_are(monkeypatch):
    monkeypatch.delenv(YCB_VARIABLE, raising=False)
    names = [filed(scoring.cases(kind, [1000], ["voxel"])[0]) for kind in ("analytic", "ycb")]
    assert names == [
        "analytic-1000-voxel-6feb6fe2a10db0efd1c5.json",
        "ycb-1000-voxel-45c86a6008f15155b6bb.json",
    ]


def test_two_folders_in_the_variable_were_one_question(tmp_path, monkeypatch):
    first, second = meshes(tmp_path / "a"), meshes(tmp_path / "b", size=0.12)
    monkeypatch.delenv(YCB_VARIABLE, raising=False)
    names = {filed(ycb_case())}
    for folder in (first, second):
        monkeypatch.setenv(YCB_VARIABLE, str(folder))
        names.add(filed(ycb_case()))
        assert ycb_case().given == {"data": str(folder)}
    assert len(names) == 3


def test_a_folder_whose_meshes_change_was_the_same_question(tmp_path):
    folder = meshes(tmp_path / "a")
    before = filed(ycb_case(folder))
    assert filed(ycb_case(folder)) == before
    meshes(folder, size=0.11)  # as many bytes
    changed = filed(ycb_case(folder))
    meshes(folder, name="more.ply")
    more = filed(ycb_case(folder))
    (folder / "more.ply").rename(folder / "other.ply")
    assert len({before, changed, more, filed(ycb_case(folder))}) == 4


def test_the_same_meshes_elsewhere_are_the_same_question(tmp_path, monkeypatch):
    first, second = meshes(tmp_path / "a"), meshes(tmp_path / "b")
    (second / "notes.txt").write_text("no mesh")
    assert filed(ycb_case(first)) == filed(ycb_case(second))
    monkeypatch.chdir(tmp_path)
    assert filed(ycb_case(Path("a"))) == filed(ycb_case(first))
    assert ycb_case(Path("a")).given == {"data": str(first)}
    assert str(tmp_path) not in str(ycb_case(first).asked)


def test_only_sets_that_take_a_folder_have_one(tmp_path, monkeypatch):
    monkeypatch.setenv(YCB_VARIABLE, str(tmp_path / "nowhere"))
    for kind in ("analytic", "random", "random-train"):
        assert scoring.data_digest(kind, tmp_path) is None
        assert scoring.whereabouts(kind, tmp_path) == {}
    assert chosen_folder("folder") is None
    with pytest.raises(ConfigError, match="nowhere is not a folder"):
        scoring.data_digest("ycb")
    usual = meshes(tmp_path / "usual")
    monkeypatch.setattr(sources, "_beside", lambda: usual)
    assert scoring.data_digest("ycb", usual) is None
    assert scoring.data_digest("folder", usual) is not None


def test_scenes_are_made_of_the_folder_that_was_asked_for(tmp_path, monkeypatch):
    made = []

    def generate(kind, seed, *, data=None):
        made.append((kind, seed, data))
        return small_scene()

    monkeypatch.setattr(generation, "generate", generate)
    scoring._prepared.cache_clear()
    folder = meshes(tmp_path / "a")
    for case in (ycb_case(folder), ycb_case(folder)):
        scoring.prepared(case)
    meshes(folder, size=0.12)  # in one process, while a scene of the old meshes is kept
    scoring.prepared(ycb_case(folder))
    monkeypatch.delenv(YCB_VARIABLE, raising=False)
    scoring.prepared(ycb_case())
    scoring._prepared.cache_clear()
    assert made == [("ycb", 1000, folder), ("ycb", 1000, folder), ("ycb", 1000, None)]


def test_what_is_given_is_no_part_of_the_question():
    assert filed(Case("x", {"a": 1}, {"data": "here"})) == filed(Case("x", {"a": 1}))
