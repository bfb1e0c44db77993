# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps: every case answered once, whatever was stored, broken or killed before."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import sweep_tasks as tasks

from experiments.tables.backends import one_thread
from experiments.tables.store import Store
from experiments.tables.sweep import Case, SweepError, SweepInputError, sweep
from vprism_plan.errors import ConfigError, VPrismError

HERE = Path(__file__).resolve().parent


def asked(trace):
    """What the tasks were asked so far."""
    return sorted(int(line) for line in trace.read_text().split()) if trace.exists() else []


def run(cases, store, **how):
    return sweep(tasks.square, cases, store, **{"jobs": 1, "progress": False, **how})


def squares(answers):
    return [answer["square"] for answer in answers]


def test_answers_come_in_the_order_of_the_cases_and_are_stored(tmp_path):
    trace, store = tmp_path / "trace", tmp_path / "store"
    first = run(tasks.numbered(trace, 4), store)
    again = run(tasks.numbered(trace, 4)[::-1], store)
    assert squares(first) == [0, 1, 4, 9]
    assert squares(again) == [9, 4, 1, 0]
    assert asked(trace) == [0, 1, 2, 3]
    assert len(list(store.iterdir())) == 4
    more = run(tasks.numbered(trace, 5), store)  # a longer list asks only for what is new
    assert squares(more) == [0, 1, 4, 9, 16]
    assert asked(trace) == [0, 1, 2, 3, 4]


def test_another_question_is_another_answer(tmp_path):
    trace, store = tmp_path / "trace", tmp_path / "store"
    run(tasks.numbered(trace, 2), store)
    run(tasks.numbered(trace, 2, version=2), store)
    assert asked(trace) == [0, 0, 1, 1]
    assert len(list(store.iterdir())) == 4


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 1}', '{"format": 0, "question": {}, "answer": {}}']
)
def test_a_half_or_foreign_file_is_computed_again_and_said(text, tmp_path, caplog):
    trace, cases = tmp_path / "trace", tasks.numbered(tmp_path / "trace", 2)
    run(cases, tmp_path)
    path = Store(tmp_path, "sweep_tasks.square").path(cases[1])
    path.write_text(text)
    assert squares(run(cases, tmp_path)) == [0, 1]
    assert asked(trace) == [0, 1, 1]
    assert path.name in caplog.text
    assert "again" in caplog.text
    assert json.loads(path.read_text())["answer"]["square"] == 1


def test_an_answer_to_another_question_under_this_name_is_not_taken(tmp_path):
    cases = tasks.numbered(tmp_path / "trace", 2)
    run(cases, tmp_path)
    kept = Store(tmp_path, "sweep_tasks.square")
    kept.path(cases[1]).write_text(kept.path(cases[0]).read_text())
    assert squares(run(cases, tmp_path)) == [0, 1]


def test_the_same_question_twice_is_refused_before_anything_runs(tmp_path):
    cases = tasks.numbered(tmp_path / "trace", 2)
    with pytest.raises(ConfigError, match="'x=1' and 'again' ask the same"):
        run([*cases, Case("again", dict(cases[1].asked))], tmp_path)
    assert asked(tmp_path / "trace") == []


@pytest.mark.parametrize("bad", [float("nan"), {1, 2}, Path("x")])
def test_a_question_must_be_json(bad, tmp_path):
    with pytest.raises(ConfigError, match="odd"):
        run([Case("odd", {"x": bad})], tmp_path)


def test_a_task_with_arguments_of_its_own_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"Case.asked"):
        sweep(partial(tasks.square), [], tmp_path)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_fails_is_named_at_the_end_and_the_rest_is_kept(jobs, tmp_path):
    trace = tmp_path / "trace"
    with pytest.raises(SweepError, match=r"2 of 5.*x=1: ValueError: 1 cannot.*x=3") as caught:
        run(tasks.numbered(trace, 5, bad=[1, 3]), tmp_path / "store", jobs=jobs)
    assert [f.name for f in caught.value.failures] == ["x=1", "x=3"]
    assert "in square" in caught.value.failures[0].traceback
    assert not isinstance(caught.value, VPrismError)
    assert asked(trace) == [0, 1, 2, 3, 4]
    assert len(list((tmp_path / "store").iterdir())) == 3


def unusable(case):
    raise ConfigError("no such folder")


def unstorable(case):
    return {"set": {1}}


def test_input_at_fault_and_answers_that_are_not_json_are_told_apart(tmp_path):
    case = [Case("a", {})]
    with pytest.raises(SweepInputError, match="no such folder"):
        sweep(unusable, case, tmp_path, jobs=1, progress=False)
    with pytest.raises(SweepError, match="JSON serializable") as caught:
        sweep(unstorable, case, tmp_path, jobs=1, progress=False)
    assert not isinstance(caught.value, SweepInputError)


def test_processes_give_the_same_with_one_thread_each_and_groups_stay_together(tmp_path):
    trace = tmp_path / "trace"
    answers = run(
        tasks.numbered(trace, 6), tmp_path / "a", jobs=2, group=lambda case: case.asked["x"] // 3
    )
    assert squares(answers) == [0, 1, 4, 9, 16, 25]
    assert asked(trace) == list(range(6))
    pids = [answer["pid"] for answer in answers]
    assert len(set(pids[:3])) == len(set(pids[3:])) == 1
    assert os.getpid() not in pids
    told = sweep(tasks.threads, [Case("t", {})], tmp_path / "b", jobs=2, progress=False)
    assert (told[0]["torch"], told[0]["own"]) == (1, 1)
    assert told[0]["pid"] != os.getpid()


def test_this_process_gets_its_threads_back(monkeypatch):
    import torch

    monkeypatch.setenv("VPRISM_PLAN_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
            assert os.environ["VPRISM_PLAN_THREADS"] == "1"
        assert torch.get_num_threads() == 2
        assert os.environ["VPRISM_PLAN_THREADS"] == "3"
        assert "MKL_NUM_THREADS" not in os.environ
    finally:
        torch.set_num_threads(before)


def test_a_killed_sweep_goes_on_where_it_was(tmp_path):
    """SIGKILL while case 2 runs: cases 0 and 1 are not asked again, nothing is counted twice."""
    child = subprocess.Popen(
        [sys.executable, str(HERE / "sweep_tasks.py"), str(tmp_path)],
        cwd=HERE,
        env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
    )
    store = tmp_path / "store"
    limit = time.monotonic() + 60.0
    while len(list(store.glob("x-*.json"))) < 2:
        assert child.poll() is None
        assert time.monotonic() < limit
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    trace = tmp_path / "trace"
    assert asked(trace) == [0, 1]
    # The rest of it answers at once: `slowly` is the same task by name, with no pause.
    answers = sweep(tasks.slowly, tasks.numbered(trace, 2), store, jobs=1, progress=False)
    assert squares(answers) == [0, 1]
    assert asked(trace) == [0, 1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "PAUSE", 0.0)
        answers = sweep(tasks.slowly, tasks.numbered(trace, 4), store, jobs=1, progress=False)
    assert squares(answers) == [0, 1, 4, 9]
    assert asked(trace) == [0, 1, 2, 3]


def test_a_local_dask_cluster_gives_the_same(tmp_path):
    distributed = pytest.importorskip("distributed")
    trace = tmp_path / "trace"
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
        pytest.raises(SweepError, match=r"1 of 6.*x=4"),
    ):
        run(tasks.numbered(trace, 6, bad=[4]), tmp_path / "s", backend="dask", cluster=client)
    assert asked(trace) == list(range(6))
    again = run(tasks.numbered(trace, 4, bad=[4]), tmp_path / "s")
    assert squares(again) == [0, 1, 4, 9]
    assert len(asked(trace)) == 6


def test_a_store_that_cannot_be_written_lost_every_answer(tmp_path):
    trace = tmp_path / "trace"
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ConfigError, match=r"below cannot be written \(Not a directory"):
        run(tasks.numbered(trace, 3), tmp_path / "file" / "below")
    assert asked(trace) == []
    assert run([], tmp_path / "file" / "below") == []  # nothing to keep


def test_a_damaged_answer_was_computed_anew_in_every_run_by_workers_elsewhere(
    tmp_path, monkeypatch
):
    trace, cases = tmp_path / "trace", tasks.numbered(tmp_path / "trace", 2)
    run(cases, tmp_path / "store")
    path = Store(tmp_path / "store", "sweep_tasks.square").path(cases[1])
    path.write_text("{")

    def elsewhere(task, cases, kept, parent, number):
        return number, [Store(tmp_path / "there", kept.task).write(c, task(c)) for c in cases]

    monkeypatch.setattr("experiments.tables.sweep._answer_group", elsewhere)
    for _ in range(2):
        assert squares(run(cases, tmp_path / "store")) == [0, 1]
    assert asked(trace) == [0, 1, 1]
    assert json.loads(path.read_text())["answer"]["square"] == 1


@pytest.mark.parametrize("how", [{"backend": "slurm"}, {"jobs": 0}])
def test_unknown_ways_to_run_are_refused(how, tmp_path):
    with pytest.raises(ConfigError, match=r"slurm|jobs is 0"):
        run(tasks.numbered(tmp_path / "trace", 1), tmp_path, **how)
