# SPDX-License-Identifier: BSD-3-Clause
"""Checkers of the planning benchmark, its runs, figures and log."""

import dataclasses
import importlib
import json
import pickle
import sqlite3
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.small_scenes import small_config, small_scene

from experiments.planning_benchmark import (
    CONTENDERS,
    Answer,
    Contender,
    Limits,
    PathTruth,
    Problem,
    Truth,
    asking,
    contenders,
    report,
)
from experiments.planning_benchmark.checkers import Bench, known_nodes
from experiments.planning_benchmark.contenders import settings
from experiments.planning_benchmark.grid_world import benchmark_grid, benchmark_robot
from experiments.planning_benchmark.ompl_log import log_text
from experiments.planning_benchmark.summary import (
    collisions_at,
    outcomes,
    statements,
    successes_at,
)
from experiments.tables.sweep import Case, SweepError
from vprism_plan.collision import CheckerConfig, MeshChecker
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.world.visibility import background_points

# The package's names `contenders` and `run` are functions.
contending = importlib.import_module("experiments.planning_benchmark.contenders")
running = importlib.import_module("experiments.planning_benchmark.run")


@pytest.fixture(scope="module")
def bench():
    scene = small_scene()
    made = Bench(scene, benchmark_robot(), 0)
    made.__dict__["vprism"] = fit_map(scene.observation, small_config(), seed=0)
    return made


def coarse_scene():
    """The small scene, seen with a sixteenth of the pixels."""
    scene = small_scene()
    K = scene.camera.intrinsics / 4.0
    K[2, 2] = 1.0
    camera = dataclasses.replace(scene.camera, intrinsics=K, width=160, height=120)
    return dataclasses.replace(scene, camera=camera)


def refuses(bench, key, points):
    """Which points (m) a contender's world calls an obstacle."""
    (checker, *_), _ = bench.checkers(CONTENDERS[key])
    return checker.world.field.lower_bound(np.ascontiguousarray(points)) <= 0.0


def test_contenders_are_named_and_survive_json():
    assert [c.key for c in contenders(["fcl", "truth"])] == ["fcl", "truth"]
    assert len(contenders()) == len(CONTENDERS)
    for entry in CONTENDERS.values():
        assert Contender.from_dict(entry.to_dict()) == entry
        asked = Contender.from_dict(entry.question())
        assert dataclasses.replace(asked, label=entry.label, line=entry.line) == entry
    with pytest.raises(ConfigError, match=r"'bvh'; valid: truth, ours-all-m0"):
        contenders(["bvh"])


def test_the_point_cloud_refuses_its_points_and_little_else(bench):
    points, labels = bench.observation.points()
    seen = points[labels > 0]
    assert refuses(bench, "points", seen).mean() > 0.999
    rng = np.random.default_rng(0)
    some = rng.uniform((-0.2, -0.2, 0.03), (0.2, 0.2, 0.2), (5000, 3))
    refused = some[refuses(bench, "points", some)]
    others, _ = background_points([bench.observation], bench.vprism.plane, 0.015, 0.03)
    everything = np.concatenate([seen, others])
    near = [np.abs(everything - p).max(axis=1).min() <= 0.0125 for p in refused]
    assert all(near)  # three sigma of the noise here, and a cell
    inside = bench.scene.signed_distance(some) < -0.02
    assert not refuses(bench, "points", some[inside]).any()  # hollow


def test_octomap_refuses_occupied_cells_and_unknown_ones_if_asked(bench):
    pytest.importorskip("pyoctomap")
    bench = Bench(coarse_scene(), bench.robot, 0)
    tree, grid = bench.octomap, benchmark_grid(bench.observation)
    rng = np.random.default_rng(1)
    nodes = rng.integers(0, grid.shape, (600, 3))
    near = np.round((rng.uniform((-0.1, -0.15, 0.02), (0.2, 0.15, 0.1), (1200, 3))) / 0.01)
    points, labels = bench.observation.points()
    seen = np.round(points[labels > 0][::4] / 0.01)
    nodes = np.concatenate([nodes, np.concatenate([near, seen]).astype(np.int64) - grid.first])
    centers = grid.spacing * (nodes + grid.first)
    state = tree.state(centers)
    np.testing.assert_array_equal(known_nodes(tree, grid)[tuple(nodes.T)], state != 2)
    off = centers[:, 2] > 0.03
    centers, state = centers[off], state[off]
    inside = centers + rng.uniform(-0.0049, 0.0049, centers.shape)
    around = np.array(list(np.ndindex(3, 3, 3))) - 1.0
    others = np.stack([tree.state(centers + grid.spacing * shift) for shift in around])
    free, occupied = (refuses(bench, f"octomap-{word}", inside) for word in ("free", "occupied"))
    hit = state == 1
    assert hit.sum() > 10
    assert free[hit].mean() > 0.9  # the rest are cells of nothing but flying pixels
    assert (occupied[hit] >= free[hit]).all()
    assert not free[(others != 1).all(axis=0)].any()
    assert not occupied[(others == 0).all(axis=0)].any()
    behind = (state == 2) & (np.abs(inside) < (0.2, 0.1, 0.1)).all(axis=1)  # in the image
    assert behind.sum() > 20
    assert occupied[behind].all()


def test_level_sets_and_margins(bench):
    """Ours with the map's say, and FCL on the same level set, tell the same inside."""
    fitted = bench.vprism
    rng = np.random.default_rng(2)
    points = rng.uniform((-0.1, -0.15, 0.01), (0.15, 0.15, 0.12), (3000, 3))
    occupied = fitted.occupancy(points) >= 0.5
    refused = refuses(bench, "ours-m0", points)
    assert refused[occupied].all()
    everything = refuses(bench, "ours-all-m0", points)
    assert everything[refused].all()
    assert everything.sum() > refused.sum()
    (checker, *_), _ = bench.checkers(CONTENDERS["ours-m20"])
    assert checker.config.margin == 0.02
    made, _ = bench.checkers(CONTENDERS["ours-widest"])
    assert [c.config.margin for c in made] == [0.02, 0.01, 0.005, 0.0]
    with pytest.raises(ConfigError, match="has no world here"):
        bench.checkers(CONTENDERS["truth"])


def test_fcl_says_what_the_mesh_checker_says(bench):
    (checker, *_), _ = bench.checkers(CONTENDERS["fcl"])
    rng = np.random.default_rng(3)
    down = np.array([0.0, 0.5, 0.0, -2.1, 0.0, 2.6, 0.8])
    Q = np.clip(down + rng.normal(0.0, 0.25, (60, 7)), checker.robot.lower, checker.robot.upper)
    verdicts = [checker.is_valid(q) for q in Q]
    config = CheckerConfig(margin=checker.config.margin)
    meshes = MeshChecker(
        checker.world, checker.robot, config, links="spheres", step=0.02, seen=False
    )
    assert verdicts == [meshes.is_valid(q) for q in Q]
    assert 5 < sum(verdicts) < 55
    for qa, qb in zip(Q[:12:2], Q[1:12:2], strict=True):
        assert checker.check_motion(qa, qb) <= meshes.check_motion(qa, qb)
        report_ = checker.check_motion_report(qa, qb)
        assert report_.valid == checker.check_motion(qa, qb)
        assert report_.text()
    refused = Q[verdicts.index(False)]
    assert not checker.explain(refused).valid
    assert checker.explain(refused).contacts
    copied = pickle.loads(pickle.dumps(checker))
    assert type(copied) is type(checker)
    assert [copied.is_valid(q) for q in Q] == verdicts


# --- runs -----------------------------------------------------------------------------


def test_a_run_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    scene = small_scene()
    truth = Truth(scene, benchmark_robot())
    rng = np.random.default_rng(0)
    Q = rng.uniform(truth.robot.lower, truth.robot.upper, (40, 7))
    Q = Q[truth.checker(0.05).is_valid_batch(Q)][:4].tolist()
    no, far = (False, False), (1.0, 1.0)
    problems = [Problem(k, tuple(Q[2 * k]), tuple(Q[2 * k + 1]), no, far, seed=k) for k in (0, 1)]
    asked = []
    monkeypatch.setattr(asking, "_truth", lambda *_: truth)
    monkeypatch.setattr(asking, "_bench", lambda *_: Bench(scene, truth.robot, 0, truth.world))
    monkeypatch.setattr(
        asking, "find_problems", lambda *given: asked.append(given[1:3]) or problems
    )
    real = asking.ask
    monkeypatch.setattr(asking, "ask", lambda *given: asked.append("ask") or real(*given))
    options = {"checkers": ["truth", "points"], "count": 2, "store": tmp_path, "jobs": 1}
    first = running.run("solids", 1, 7, progress=False, **options)
    assert asked == [(2, 7), "ask", "ask", "ask", "ask"]
    again = running.run("solids", 1, 7, progress=False, **options)
    assert again.answers == first.answers
    assert len(asked) == 5
    (entry, other) = first.answers
    assert (entry["contender"], other["contender"]) == ("truth", "points")
    for found in entry["answers"]:
        answer = Answer.from_dict(found)
        assert answer.solved
        assert not answer.truth.collides
        assert answer.travel > 0.0
        assert json.loads(json.dumps(answer.to_dict())) == found
    with pytest.raises(ConfigError, match="scenes is 0"):
        running.run("solids", 0)


def stub_sweeps(monkeypatch, offers, fails=()):
    """Let scene k offer offers[k] problems, and a contender raise on some scenes."""

    def sweep(task, cases, store, **options):
        cases = list(cases)
        if task is asking.problem_case:
            return [{"problems": [{}] * offers[case.asked["seed"]]} for case in cases]
        lost = [
            case for case in cases if (case.asked["contender"]["key"], case.asked["seed"]) in fails
        ]
        if lost:
            raise SweepError([SimpleNamespace(name=c.name, error="no", trace="") for c in lost], 9)
        return [{"contender": c.asked["contender"]["key"], "seed": c.asked["seed"]} for c in cases]

    monkeypatch.setattr(running, "sweep", sweep)
    monkeypatch.setattr("experiments.tables.sweep.sweep", sweep)


def test_scenes_that_offer_too_few_problems_are_replaced_and_named(tmp_path, monkeypatch):
    """One of ten scenes once counted as twenty problems, half of them hidden; it had ten."""
    stub_sweeps(monkeypatch, {7: 3, 8: 1, 9: 3, 10: 0, 11: 3, 12: 3})
    options = {"checkers": ["truth"], "count": 3, "store": tmp_path}
    found = running.run("solids", 3, 7, **options)
    assert [entry["seed"] for entry in found.answers] == [7, 9, 11]
    assert found.replaced == {8: 1, 10: 0}
    assert found.failed is None
    stub_sweeps(monkeypatch, dict.fromkeys(range(7, 13), 2))
    with pytest.raises(ConfigError, match=r"solids scenes 7 to 12 only 0 offer 3 problems"):
        running.run("solids", 3, 7, **options)


def test_a_scene_on_which_one_contender_fails_counts_for_none(tmp_path, monkeypatch):
    stub_sweeps(monkeypatch, dict.fromkeys(range(20), 2), fails=[("points", 8)])
    options = {"checkers": ["truth", "points"], "count": 2, "store": tmp_path}
    found = running.run("solids", 2, 7, **options)
    assert [(e["contender"], e["seed"]) for e in found.answers] == [("truth", 7), ("points", 7)]
    assert [failure.name for failure in found.failed.failures] == ["points solids 8"]
    with pytest.raises(SweepError):
        running.run("solids", 1, 8, **options)


@pytest.mark.parametrize("scenes", [-5, 0, 1])
def test_fewer_scenes_than_sets_are_refused(tmp_path, scenes):
    """They once became one scene of each set."""
    with pytest.raises(ConfigError, match=f"scenes is {scenes} for 2 sets"):
        report.benchmark(("solids", "ycb"), scenes, output=tmp_path, store=tmp_path)


def test_an_answer_depends_on_the_settings_of_the_package(monkeypatch):
    """Answers of a former default map were once taken for those of today's."""
    before = {key: settings(chosen) for key, chosen in CONTENDERS.items()}
    assert json.loads(json.dumps(before)).keys() == before.keys()
    monkeypatch.setattr(contending, "MapConfig", MapConfig.fine)
    changed = {key for key, chosen in CONTENDERS.items() if settings(chosen) != before[key]}
    assert changed == {k for k, c in CONTENDERS.items() if c.map in ("vprism", "sgd")}
    strict = dataclasses.replace(CheckerConfig(), margin=0.01)
    monkeypatch.setattr(contending, "CheckerConfig", lambda: strict)
    assert all(settings(chosen) != before[key] for key, chosen in CONTENDERS.items())


def test_a_refusal_says_what_is_in_the_way():
    contact = SimpleNamespace(kind="object", body="object:3", link="hand")
    refused = SimpleNamespace(
        status="invalid_goal", explanation=SimpleNamespace(contacts=[contact])
    )
    assert asking._refusal(refused) == "object:3"
    contact.kind = "risk"
    assert asking._refusal(refused) == "risk"
    assert asking._refusal(SimpleNamespace(status="timeout")) == ""
    assert isinstance(Case("x", {}), Case)


# --- figures --------------------------------------------------------------------------


def made_up(rates, scenes=3, problems=10, seed=0):
    """Answers of contenders with given shares of paths and of collisions among them."""
    rng = np.random.default_rng(seed)
    found = []
    for key, (success, collision) in rates.items():
        for number in range(scenes):
            answers = []
            for problem in range(problems):
                solved = rng.random() < success
                gap = float(-rng.uniform(0.001, 0.02) if rng.random() < collision else 0.01)
                judged = PathTruth(gap, "object:1", "hand", 3, 0.5, (0.0, 0.0, 0.1), 100)
                answers.append(
                    Answer(
                        problem, "exact" if solved else "invalid_goal", "" if solved else "risk",
                        0.2, 0.1, 0.05, judged if solved else None,
                        "supported" if solved and gap < 0 else "", 3.0 if solved else None,
                        1.0 if solved else None,
                    ).to_dict()
                )  # fmt: skip
            found.append(
                {"contender": key, "kind": "solids", "seed": number, "scene": f"s{number}",
                 "build": 1.0, "answers": answers}
            )  # fmt: skip
    return found


share = st.floats(0.0, 1.0)


@given(st.lists(st.tuples(share, share), min_size=1, max_size=5), share, share)
def test_the_curve_is_the_best_coin_toss_between_two(points, wanted, rate):
    success = np.array([s for s, _ in points])
    collided = np.array([s * c for s, c in points])
    places = [(0.0, 0.0), *zip(success, collided, strict=True)]
    least, most = [], []
    for (x0, y0), (x1, y1) in [*combinations(places, 2), *((p, p) for p in places)]:
        t = np.linspace(0.0, 1.0, 2001)
        x, y = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
        most += list(x[y <= rate * x + 1e-12])
        if min(x0, x1) <= wanted <= max(x0, x1) and x0 != x1:
            least.append(y0 + (wanted - x0) / (x1 - x0) * (y1 - y0))
        elif x0 == wanted:
            least.append(y0)
    if least:
        assert collisions_at(success, collided, wanted) == pytest.approx(min(least), abs=1e-9)
    else:  # beyond the curve: its end
        end = min(c for s, c in places if s == max(success))
        assert collisions_at(success, collided, wanted) == pytest.approx(end, abs=1e-9)
    assert successes_at(success, collided, rate) == pytest.approx(max(most), abs=2e-3)


def test_figures_add_up_and_are_written(tmp_path):
    rates = {
        "truth": (1.0, 0.0), "ours-m0": (0.95, 0.1), "ours-m10": (0.8, 0.0), "fcl": (0.9, 0.4),
        "octomap-occupied": (0.3, 0.0),
    }  # fmt: skip
    found = made_up(rates, scenes=6)
    made = {outcome.contender.key: outcome for outcome in outcomes(found)}
    counts = made["fcl"].counts()
    by_hand = [a for e in found if e["contender"] == "fcl" for a in e["answers"]]
    assert counts["problems"].sum() == len(by_hand) == 60
    paths = [a for a in by_hand if a["truth"]]
    assert counts["paths"].sum() == len(paths)
    hits = [a["truth"]["clearance"] for a in paths if a["truth"]["clearance"] < 0.0]
    assert counts["collided"].sum() == len(hits)
    assert counts["deep"].sum() == sum(gap < -0.005 for gap in hits)
    row = made["fcl"].to_dict(made["truth"])
    assert row["worst_depth"] == pytest.approx(-min(hits))
    assert row["collision"]["value"] == pytest.approx(len(hits) / len(paths))
    assert row["safe"]["value"] == pytest.approx((len(paths) - len(hits)) / 60)
    assert row["length"] == 1.0
    meshes, occupied = statements(list(made.values()))
    assert meshes.against == "meshes with FCL"
    assert 0.0 <= meshes.quotient.low <= meshes.quotient.value <= meshes.quotient.high < 1.0
    assert meshes.reached
    assert occupied.quotient.value > 1.0
    about = {
        "kinds": {"solids": 6}, "first_seed": 0, "count": 10,
        "command": "python -m experiments planning",
        "criteria": running.Criteria().to_dict(), "limits": vars(Limits()), "commits": ["0", "1+"],
        "replaced": {"solids": {"3": 7}}, "left_out": ["fcl solids 9: RuntimeError: no"],
    }  # fmt: skip
    figures, files = report.write_report(found, about, tmp_path)
    assert {f.name for f in files} == {p.name for p in tmp_path.iterdir()}
    assert set(figures["contenders"]) == set(rates)
    text = (tmp_path / "planning.md").read_text()
    assert "At the success rate of meshes with FCL" in text
    assert "python -m experiments planning" in text
    for said in ("Computed at 0, 1+", "solids 3 (7)", "- fcl solids 9: RuntimeError: no"):
        assert said in text
    with pytest.raises(ConfigError, match="fcl was not asked"):
        outcomes([e for e in found if (e["contender"], e["seed"]) != ("fcl", 2)])


def test_ompl_reads_the_log(tmp_path, capsys):
    from ompl.tools import readBenchmarkLog

    found = outcomes(made_up({"truth": (1.0, 0.0), "ours-m0": (0.6, 0.3)}))
    text = log_text(found, "two words", Limits(), "what was\nasked", "2026-01-02T03:04:05+00:00")
    (tmp_path / "planning.log").write_text(text)
    database = tmp_path / "planning.db"
    readBenchmarkLog(str(database), [str(tmp_path / "planning.log")], False)
    capsys.readouterr()
    with sqlite3.connect(database) as read:
        names = [row[0] for row in read.execute("SELECT name FROM plannerConfigs ORDER BY id")]
        assert names == ["the truth itself", "ours, margin (hidden: the map decides), 0 mm"]
        rows = read.execute(
            "SELECT plannerid, solved, truly_collides, penetration, time, scene, problem FROM runs"
        ).fetchall()
        (seconds, count) = read.execute("SELECT timelimit, runcount FROM experiments").fetchone()
    read.close()
    assert (seconds, count) == (2.0, 30)
    assert len(rows) == 60
    for number, outcome in enumerate(found, start=1):
        own = [row for row in rows if row[0] == number]
        assert sum(row[1] for row in own) == len(outcome.paths)
        assert sum(row[2] or 0 for row in own) == outcome.counts()["collided"].sum()
        assert {(row[5], row[6]) for row in own} == {(s, p) for s in range(3) for p in range(10)}
        assert all((row[3] is None) == (not row[1]) for row in own)
