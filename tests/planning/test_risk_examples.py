# SPDX-License-Identifier: BSD-3-Clause
"""The examples about risk and contacts say what they are there to show."""

import re
import subprocess
import sys

import pytest


def output_of(repository, name):
    done = subprocess.run(
        [sys.executable, str(repository / "examples" / f"{name}.py")],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_bound_on_risk_gives_a_less_risky_path_than_none(repository):
    said = output_of(repository, "bounded_risk")
    straight, free, bounded = (float(p) for p in re.findall(r"P\(collision\) (\d\.\d+)", said))
    assert straight > 0.5
    assert bounded <= 0.05
    assert bounded <= free
    assert "max_risk 0.05: exact" in said


@pytest.mark.slow
def test_a_path_may_end_touching_the_target_and_says_so(repository):
    said = output_of(repository, "touch_the_target")
    assert "without a rule: invalid_goal" in said
    assert "into object:1" in said
    assert "with it: exact" in said
    assert "ends touching object:1" in said
