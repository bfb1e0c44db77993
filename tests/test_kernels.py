"""numba's on-disk cache misses edits in other modules: kernels must not call across files."""

import ast
from pathlib import Path

import pytest

import vprism_plan._kernels

FILES = sorted(Path(vprism_plan._kernels.__file__).parent.glob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_kernel_files_import_nothing_of_ours(path):
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = ["vprism_plan" if node.level else str(node.module)]
        assert not [name for name in names if name.startswith("vprism_plan")]


def test_there_are_kernels_to_look_at():
    assert {path.stem for path in FILES} >= {"checking", "mapping", "world"}
