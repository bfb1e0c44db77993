"""What the README, and the page of questions, show must run as it stands."""

import re
import subprocess
import sys

import pytest


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.S)


@pytest.mark.slow
def test_the_python_example_runs_and_plans(repository):
    code = blocks((repository / "README.md").read_text(), "python")[0]
    assert len(code.strip().splitlines()) <= 15
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    plan, reasons = done.stdout.strip().splitlines()
    assert plan.startswith("exact")
    assert "panda_" in reasons


@pytest.mark.slow
def test_what_is_shown_of_risk_contacts_and_margins_runs_after_the_first_example(
    repository,
):
    first, _, fourth = blocks((repository / "README.md").read_text(), "python")
    (second,) = blocks((repository / "docs" / "questions.md").read_text(), "python")
    done = subprocess.run(
        [sys.executable, "-c", first + second + fourth],
        cwd=repository, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("P(collision)") >= 2
    assert "ends touching, as allowed: panda_hand on object:1" in done.stdout
    assert "path of 32 waypoints" in done.stdout.splitlines()[-1]


def test_the_ompl_lines_are_those_of_the_example(repository):
    shown = blocks((repository / "README.md").read_text(), "python")[1]
    program = (repository / "examples" / "02_your_own_ompl_program.py").read_text()
    lines = [line.split("#")[0].strip() for line in shown.splitlines() if line.strip()]
    assert len(lines) <= 10
    for line in lines:
        if line.startswith("si.") or "getSpaceInformation" in line:
            assert line in program


def test_it_is_read_in_three_minutes(repository):
    assert len((repository / "README.md").read_text().splitlines()) <= 110


def test_links_lead_somewhere(repository):
    text = (repository / "README.md").read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (repository / target).exists(), target


def test_measured_numbers_name_commands_that_exist(repository):
    text = (repository / "docs" / "results" / "measured.md").read_text()
    commands = re.findall(r"`python -m experiments\.benchmarks\.([a-z_]+)", text)
    assert len(commands) >= 4
    for command in commands:
        assert (repository / "experiments" / "benchmarks" / f"{command}.py").is_file()
