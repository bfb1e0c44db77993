# SPDX-License-Identifier: BSD-3-Clause
"""`python -m experiments` before it computes: what it would replace, where it would write."""

import json
from pathlib import Path

import pytest

from experiments import __main__ as command
from experiments.__main__ import main
from experiments.tables import reconstruction as tables
from experiments.tables import uncertainty
from vprism_plan.errors import ConfigError

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout whose pages are of twelve scenes, and nothing that computes."""
    results = tmp_path / "docs" / "results"
    results.mkdir(parents=True)
    sets = {"sets": {kind: {"scenes": 4} for kind in ("analytic", "ycb", "random")}}
    planning = {"about": {"kinds": {"analytic": 4, "ycb": 4, "random": 4}}}
    for table, page in (
        ("baselines", sets),
        ("uncertainty", sets),
        ("planning", planning),
        ("asked", planning),
    ):
        (results / f"{table}.json").write_text(json.dumps(page))
    monkeypatch.setattr(command, "__file__", str(tmp_path / "experiments" / "__main__.py"))
    return results


@pytest.mark.parametrize(
    ("words", "scenes"),
    [
        (["baselines", "--scenes", "3"], 9),
        (["baselines", "--set", "analytic", "--scenes", "11"], 11),
        (["uncertainty", "--scenes", "1"], 3),
        (["planning", "--scenes", "11"], 11),
        (["asked", "--scenes", "3"], 9),
    ],
)
def test_a_short_run_replaced_the_page_of_a_long_one(words, scenes, checkout, capsys):
    before = {file.name: file.read_bytes() for file in checkout.iterdir()}
    assert main([*words]) == 2
    err = capsys.readouterr().err
    assert f"is of 12 scenes and would be replaced by a report of {scenes};" in err
    assert "--output" in err
    assert len(err.splitlines()) == 1
    assert before == {file.name: file.read_bytes() for file in checkout.iterdir()}


def test_as_many_scenes_or_a_folder_by_name_may_replace_a_page(checkout, monkeypatch):
    ran = []

    def reconstruction(table, methods, asked):
        ran.append(asked["output"])
        return {}, [], []

    monkeypatch.setattr(command, "_reconstruction", reconstruction)
    assert main(["baselines", "--scenes", "4"]) == 0
    assert main(["baselines", "--scenes", "1", "--output", str(checkout)]) == 0
    assert main(["presets", "--scenes", "1"]) == 0  # no page yet
    assert ran == [checkout] * 3


def test_a_page_that_cannot_be_read_is_not_replaced_either(checkout, capsys):
    for text in ("{", "[]", "{}", '{"sets": 3}'):
        (checkout / "baselines.json").write_text(text)
        assert main(["baselines"]) == 2
        assert "is no report" in capsys.readouterr().err


@pytest.mark.parametrize("table", ["baselines", "presets", "sampling"])
def test_the_published_pages_are_guarded(table):
    with pytest.raises(ConfigError, match=r"of \d+ scenes and would be replaced by a report of 3;"):
        command._keep_larger(RESULTS / f"{table}.json", 3)
    command._keep_larger(RESULTS / f"{table}.json", 10**6)


def test_the_printed_command_named_part_of_a_path(tmp_path):
    for kind in ("ycb", "folder"):
        line = command.command_line(
            command.parser().parse_args(
                ["baselines", "--set", kind, "--data", str(tmp_path / "meshes")]
            )
        )
        assert line == f"python -m experiments baselines --set {kind} --data FOLDER"


@pytest.mark.parametrize("where", ["--store", "--output"])
@pytest.mark.parametrize("table", ["baselines", "uncertainty", "planning", "asked"])
def test_a_folder_that_cannot_be_written_was_found_after_the_work(
    where, table, tmp_path, capsys, monkeypatch
):
    for module in (tables, uncertainty):
        monkeypatch.setattr(module.scoring, "prepared", pytest.fail)
    (tmp_path / "file").write_text("in the way")
    folders = {"--store": tmp_path / "s", "--output": tmp_path / "o"}
    folders[where] = tmp_path / "file" / "below"
    words = [table, "--set", "analytic", "--scenes", "1", "--jobs", "1"]
    assert main([*words, *(str(word) for pair in folders.items() for word in pair)]) == 2
    err = capsys.readouterr().err
    assert f"{folders[where]}" in err
    assert "cannot be written" in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_library_finds_it_too(tmp_path):
    (tmp_path / "file").write_text("in the way")
    out = tmp_path / "file" / "out"
    with pytest.raises(ConfigError, match="out cannot be written"):
        tables.run("baselines", kinds=["analytic"], scenes=1, store=tmp_path / "s", output=out)
    with pytest.raises(ConfigError, match="out cannot be written"):
        uncertainty.run(["analytic"], 1, store=tmp_path / "s", output=out)
