"""numba's on-disk cache: it notices edits of callees, and has a place on any machine."""

import ast
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import vprism_plan._kernels
from vprism_plan._kernels.jit import own_temporary_folder

FOLDER = Path(vprism_plan._kernels.__file__).parent
# `jit` defines no compiled code, so no cache can miss its edits.
FILES = sorted(set(FOLDER.glob("*.py")) - {FOLDER / "jit.py"})


def imported(path):
    """Pairs (module, name) of what a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "vprism_plan" if node.level else str(node.module)
            yield from ((module, alias.name) for alias in node.names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_kernel_files_import_nothing_of_ours_but_kernels(path):
    """The stamp of their cache is a digest of these files, and of no others."""
    ours = [module for module, _ in imported(path) if module.startswith("vprism_plan")]
    assert all(module.startswith("vprism_plan._kernels.") for module in ours)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_kernels_take_the_decorator_that_finds_a_place_for_the_cache(path):
    assert ("numba", "njit") not in set(imported(path))


def test_there_are_kernels_to_look_at():
    assert {path.stem for path in FILES} >= {"checking", "mapping", "world"}


ADDED = """
from vprism_plan._kernels.jit import njit

@njit(cache=True, nogil=True)
def twice(x):
    return 2 * x
"""
ASK = """
import importlib, pathlib, sys
here = pathlib.Path("vprism_plan/_kernels")
for file in sorted(here.glob("*.py")):
    importlib.import_module(f"vprism_plan._kernels.{file.stem}")
from numba import config
from vprism_plan._kernels import added
assert pathlib.Path(added.__file__).is_relative_to(pathlib.Path.cwd())
print(added.twice(21), config.CACHE_DIR, sum(added.twice.stats.cache_hits.values()))
"""


@pytest.fixture
def nowhere(tmp_path):
    """Kernels beside which nothing can be written, and the settings of a user without a home."""
    kernels = tmp_path / "package" / "vprism_plan" / "_kernels"
    shutil.copytree(FOLDER, kernels, ignore=shutil.ignore_patterns("__pycache__"))
    (kernels.parent / "__init__.py").touch()
    (kernels / "added.py").write_text(ADDED)
    # Root is bound by no permission, but cannot make a folder where a file is.
    (kernels / "__pycache__").touch()
    kernels.chmod(0o555)
    (tmp_path / "temporary").mkdir()
    settings = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    settings |= dict.fromkeys(("HOME", "XDG_CACHE_HOME"), "/proc/no/such/home")
    yield tmp_path, settings | {"TMPDIR": str(tmp_path / "temporary"), "PYTHONPATH": "."}
    kernels.chmod(0o755)


def ask(tmp_path, settings):
    """The value of a kernel, numba's folder as it is left, and how often the cache helped."""
    done = subprocess.run(
        [sys.executable, "-c", ASK], cwd=tmp_path / "package", env=settings, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_read_only_package_without_a_home_keeps_its_code_among_the_temporary_files(nowhere):
    tmp_path, settings = nowhere
    assert ask(*nowhere) == ["42", "0"]  # numba's own setting stays empty
    (folder,) = (tmp_path / "temporary").iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert ask(*nowhere) == ["42", "1"]
    chosen = tmp_path / "chosen"
    assert ask(tmp_path, {**settings, "NUMBA_CACHE_DIR": str(chosen)}) == ["42", str(chosen), "0"]
    assert list(chosen.rglob("added.twice*"))


CALLER = """
from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.added import twice

@njit(cache=True, nogil=True)
def twice_and_one(x):
    return twice(x) + 1
"""
CALL = """
from vprism_plan._kernels import caller
print(caller.twice_and_one(21), sum(caller.twice_and_one.stats.cache_hits.values()))
"""


def test_an_edited_callee_is_compiled_into_its_callers(tmp_path):
    """numba's own cache served the old code: it looks at the caller's file alone."""
    kernels = tmp_path / "vprism_plan" / "_kernels"
    kernels.mkdir(parents=True)
    (kernels.parent / "__init__.py").touch()
    (kernels / "__init__.py").touch()
    shutil.copy(FOLDER / "jit.py", kernels)
    (kernels / "caller.py").write_text(CALLER)
    found = []
    for body in (ADDED, ADDED, ADDED.replace("2 * x", "3 * x")):
        (kernels / "added.py").write_text(body)
        found.append(
            subprocess.run(
                [sys.executable, "-c", CALL], cwd=tmp_path, text=True, capture_output=True,
                check=True, env={**os.environ, "PYTHONPATH": "."},
            ).stdout.split()
        )  # fmt: skip
    assert found == [["43", "0"], ["43", "1"], ["64", "0"]]


def test_where_nothing_can_be_written_kernels_are_compiled_without_a_cache(nowhere):
    tmp_path, settings = nowhere
    planted = tmp_path / "temporary" / f"vprism_plan-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    assert ask(tmp_path, settings) == ["42", "0"]
    assert not list(planted.iterdir())


def plant_open(folder, elsewhere):
    folder.mkdir()
    folder.chmod(0o770)


def plant_link(folder, elsewhere):
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)


def plant_file(folder, elsewhere):
    folder.touch(mode=0o600)


@pytest.mark.parametrize("plant", [plant_open, plant_link, plant_file])
def test_a_folder_that_others_could_have_made_is_not_trusted(tmp_path, monkeypatch, plant):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plant(tmp_path / f"vprism_plan-{os.getuid()}", tmp_path / "elsewhere")
    assert own_temporary_folder.__wrapped__() is None


def test_a_folder_of_somebody_else_is_not_trusted(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mine = os.getuid()
    (tmp_path / f"vprism_plan-{mine + 1}").mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    assert own_temporary_folder.__wrapped__() is None
