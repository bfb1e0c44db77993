# SPDX-License-Identifier: BSD-3-Clause
"""The example that users copy from runs, and leaves quietly."""

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_the_example_finds_a_path_and_leaves_without_binding_noise(repository):
    done = subprocess.run(
        [sys.executable, str(repository / "examples" / "own_ompl_program.py")],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "waypoints from" in done.stdout
    assert "nanobind" not in done.stderr
