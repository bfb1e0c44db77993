# SPDX-License-Identifier: BSD-3-Clause
"""Goals from the image: how they are proposed, and what answers to them are worth."""

import importlib
import json
from itertools import pairwise, permutations
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.small_scenes import at, small_config, small_scene
from scipy.stats import beta

from experiments.planning_benchmark import (
    Answer,
    Found,
    PathTruth,
    Problem,
    Truth,
    asked,
    asking,
    checkers,
    report,
)
from experiments.planning_benchmark.checkers import Bench
from experiments.planning_benchmark.contenders import ASKED, CONTENDERS, VETTED
from experiments.planning_benchmark.grid_world import benchmark_robot, checker_of
from experiments.planning_benchmark.problems import tip_sphere
from experiments.planning_benchmark.proposals import (
    HOMES,
    Proposals,
    find_goals,
    hand_rotations,
    propose,
    tip_places,
)
from experiments.planning_benchmark.summary import outcomes
from vprism_plan.collision import CheckerConfig
from vprism_plan.mapping import fit_map
from vprism_plan.mapping.training_data import stray_points
from vprism_plan.planning import plan
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box

HOW = Proposals()
contending = importlib.import_module("experiments.planning_benchmark.contenders")
running = importlib.import_module("experiments.planning_benchmark.run")


@pytest.fixture(scope="module")
def scene():
    return small_scene()


@pytest.fixture(scope="module")
def truth(scene):
    return Truth(scene, benchmark_robot())


@pytest.fixture(scope="module")
def bench(scene, truth):
    made = Bench(scene, truth.robot, 0, truth.world)
    made.__dict__["vprism"] = fit_map(scene.observation, small_config(), seed=0)
    return made


@pytest.fixture(scope="module")
def goals(truth, bench):
    return find_goals(truth, bench, 10, 3, HOW)


# --- proposals ------------------------------------------------------------------------


def rays_and_depths(observation, place):
    """Angle (radians) from a place to every labelled point's ray, and how far behind it lies."""
    points, labels = observation.points()
    seen = points[labels > 0] - observation.camera_center
    own = place - observation.camera_center
    unit = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    along = unit @ own
    aside = np.linalg.norm(own - along[:, None] * unit, axis=1)
    return aside, along - np.linalg.norm(seen, axis=1)


def test_a_finger_tip_lies_behind_a_seen_point(goals, bench, truth):
    assert len(goals) == 10
    tip = np.array([tip_sphere(bench.robot)])
    for problem in goals:
        place = truth.sphere_centers(np.array([problem.goal]), tip)[0, 0]
        aside, behind = rays_and_depths(bench.observation, place)
        # A millimetre of the arm's way there.
        good = (aside < 0.002) & (behind > HOW.behind[0] - 0.002) & (behind < 0.152)
        assert good.any()
    places = tip_places(bench.observation, np.random.default_rng(0), HOW.behind, 40)
    for place in places:
        aside, behind = rays_and_depths(bench.observation, place)
        assert ((aside < 1e-9) & (behind > 0.02 - 1e-9) & (behind < 0.15 + 1e-9)).any()


def test_hands_point_down_and_keep_clear_of_what_was_seen(goals, bench, scene):
    robot, observation = bench.robot, bench.observation
    points, labels = observation.points()
    seen = np.concatenate(
        [own[~stray_points(own, 0.03)] for own in (points[labels == k] for k in (2, 5))]
    )
    fixed = np.asarray(robot.fixed_links)[robot.sphere_links]
    for q in (np.array(problem.goal) for problem in goals):
        centers, radii = robot.sphere_centers(q)[~fixed], np.asarray(robot.sphere_radii)[~fixed]
        gaps = np.linalg.norm(centers[:, None] - seen[None], axis=2).min(axis=1) - radii
        assert gaps.min() >= HOW.clear
        assert (centers[:, 2] - radii).min() >= HOW.clear - 0.003  # the fitted plane is not z = 0
        axis = robot.link_poses(q)["panda_hand"][:3, 2]
        assert np.arccos(-axis[2]) <= HOW.tilt + 0.03


def test_hands_lean_every_way_up_to_their_tilt():
    R = hand_rotations(np.random.default_rng(0), 0.7, 2000)
    unit = np.broadcast_to(np.eye(3), R.shape)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), unit, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    lean = np.arccos(-R[:, 2, 2])
    assert 0.69 < lean.max() <= 0.7 + 1e-12
    assert lean.min() < 0.01
    for x, y in (R[:, :2, 2].T, R[:, :2, 0].T):  # where the axis leans to, how the hand is turned
        assert (np.histogram(np.arctan2(y, x), 8, (-np.pi, np.pi))[0] > 180).all()


def test_nobody_looks_at_the_truth_to_propose(bench, scene, truth, goals):
    """Other geometry behind the same image: the same goals, other verdicts."""
    seen = checker_of(bench.point_world(), bench.robot, HOW.clear)
    alone = propose(seen, scene.observation, 10, 3, HOW)  # is given no truth
    assert [tuple(q) for q in alone] == [problem.goal for problem in goals]
    hidden = Box((0.08, 0.12, 0.1), pose=at(0.16, 0.0, 0.1))
    other = Scene((*scene.solids, hidden), (2, 5, 7), scene.camera, name="other")
    object.__setattr__(other, "observation", scene.observation)
    elsewhere = Truth(other, bench.robot)
    again = find_goals(elsewhere, Bench(other, bench.robot, 0, elsewhere.world), 10, 3, HOW)
    assert [p.goal for p in again] == [p.goal for p in goals]
    assert [p.start for p in again] == [p.start for p in goals]
    assert sum(p.reachable[0] for p in again) < sum(p.reachable[0] for p in goals)
    assert min(p.hand[1] for p in again) < 0.0  # some lie inside


def test_the_truth_says_afterwards_what_can_be_reached(goals, truth):
    for problem in goals:
        assert Problem.from_dict(json.loads(json.dumps(problem.to_dict()))) == problem
        assert problem.start in HOMES
        at_all, spacious = problem.reachable
        assert at_all or not spacious
        for clearance, can in zip(HOW.clearances, problem.reachable, strict=True):
            checker = truth.checker(clearance)
            valid = checker.is_valid(problem.goal)
            assert valid or not can
            if can:
                found = plan(checker, problem.start, problem.goal, seed=problem.seed, margins=None)
                assert found.solved
    verdicts = {problem.reachable for problem in goals}
    assert len(verdicts) > 1


# --- contenders -----------------------------------------------------------------------


def asked_of(monkeypatch, bench, truth, problem, key):
    """The keywords that a contender's planner is given, its answer, and its checkers."""
    told = []

    def spy(*given, **keywords):
        told.append(keywords)
        return plan(*given, **keywords)

    monkeypatch.setattr(asking, "plan", spy)
    checkers, _ = bench.checkers(CONTENDERS[key])
    answer = asking.ask(CONTENDERS[key], checkers, problem, truth, bench, asking.Limits())
    return told[0], answer, checkers


def test_only_the_default_takes_what_the_package_has_by_default(bench, truth, goals, monkeypatch):
    given, _, (checker,) = asked_of(monkeypatch, bench, truth, goals[0], "default")
    assert "margins" not in given
    assert checker.config == CheckerConfig()
    assert checker.world.config == type(checker.world.config)()
    for key in ("ours-m0", "ours-r10", "ours-all-m0", "points", "truth"):
        given, _, (checker,) = asked_of(monkeypatch, bench, truth, goals[0], key)
        assert given["margins"] is None
        assert checker.config.max_risk == CONTENDERS[key].bounds[0][1]
        if CONTENDERS[key].map == "vprism":
            assert checker.world.config.occluded == CONTENDERS[key].occluded


def test_who_has_a_posterior_states_a_probability(bench, truth, goals, monkeypatch):
    found = (asked_of(monkeypatch, bench, truth, p, "ours-m0")[1] for p in goals)
    answer = next(one for one in found if one.solved)
    assert 0.0 <= answer.stated <= 1.0
    assert answer.clearance >= 0.0
    assert Answer.from_dict(json.loads(json.dumps(answer.to_dict()))) == answer
    before = {k: v for k, v in answer.to_dict().items() if k not in ("stated", "clearance")}
    assert Answer.from_dict(before).stated is None  # as stored before there were such fields
    _, answer, _ = asked_of(monkeypatch, bench, truth, goals[answer.number], "points")
    assert (answer.solved, answer.stated) == (True, None)
    assert answer.clearance >= 0.0
    silent = [key for key in ASKED if not CONTENDERS[key].posterior]
    assert not [key for key in silent if key.startswith(("ours", "default"))]
    assert {"fcl", "sgd", "truth"} <= set(silent)


def test_vetted_ends_are_asked_of_whom_they_were_before():
    assert set(VETTED) | set(ASKED) == set(CONTENDERS)
    assert not [key for key in VETTED if key.startswith("ours-all-r")]
    assert {"default", "ours-r05", "ours-r20", "ours-beyond-r05", "fcl"} <= set(VETTED)


@pytest.mark.parametrize("key", ["pointsdf", "network"])
def test_a_network_adds_solids_to_the_seen_points(bench, key, monkeypatch):
    """Half a space behind the middle of the objects, as a network that says so."""

    class Said:
        def predict_proba(self, points):
            inside = points[:, 0] > 0.03
            return np.stack([1.0 - 0.9 * inside, 0.9 * inside], axis=1)

    chosen = SimpleNamespace(fit=lambda *_: Said(), level=0.3)
    monkeypatch.setattr(checkers, "method", lambda asked: chosen if asked == key else None)
    field = Bench(bench.scene, bench.robot, 0).checkers(CONTENDERS[key])[0][0].world.field
    alone = bench.point_world().field
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.08, -0.1, 0.02), (0.12, 0.1, 0.1), (4000, 3))
    there, seen = field.lower_bound(points) <= 0.0, alone.lower_bound(points) <= 0.0
    assert there[points[:, 0] > 0.035].all()
    outside = points[:, 0] < 0.015
    np.testing.assert_array_equal(there[outside], seen[outside])
    assert not seen.all()


def test_answers_depend_on_the_weights_and_on_what_the_planner_has_by_default(monkeypatch):
    before = {key: contending.settings(CONTENDERS[key]) for key in ASKED}
    monkeypatch.setattr(contending, "method_question", lambda key: {"weights": "others"})
    after = {key: contending.settings(CONTENDERS[key]) for key in ASKED}
    changed = {key for key in ASKED if after[key] != before[key]}
    assert changed == {key for key in ASKED if CONTENDERS[key].map not in ("points", "truth")}
    monkeypatch.setattr(contending, "plan", lambda checker, start, goal, *, margins=(0.01, 0.0): 0)
    last = {key: contending.settings(CONTENDERS[key]) for key in ASKED}
    assert [key for key in ASKED if last[key] != after[key]] == ["default"]


# --- figures --------------------------------------------------------------------------


def answered(rows, key="ours-m0", seed=0):
    """A contender's answers: per scene tuples (gap or None, stated, clearance)."""
    found = []
    for number, scene in enumerate(rows):
        answers = []
        for k, (gap, stated, clearance) in enumerate(scene):
            judged = None
            if gap is not None:
                judged = PathTruth(gap, "object:1", "hand", 3, 0.5, (0.0, 0.0, 0.1), 9)
            status = "invalid_goal" if gap is None else "exact"
            solved = gap is not None
            answers.append(
                Answer(
                    k, status, "" if solved else "risk", 0.2, 0.1, 0.05, judged, "",
                    1.0 if solved else None, 1.0 if solved else None,
                    stated if solved else None, clearance if solved else None,
                ).to_dict()
            )  # fmt: skip
        found.append(
            {"contender": key, "kind": "solids", "seed": seed + number, "scene": f"s{number}",
             "build": 1.0, "answers": answers, "commit": "0",
             "reachable": [[k % 2 == 0, k % 4 == 0] for k in range(len(scene))]}
        )  # fmt: skip
    return found


one = st.tuples(
    st.one_of(st.none(), st.sampled_from([-0.01, 0.01])),
    st.sampled_from([0.0, 0.25, 0.5, 1.0]),
    st.sampled_from([0.0, 0.01, 0.03]),
)
some = st.lists(st.lists(one, min_size=3, max_size=3), min_size=2, max_size=4)


@given(some, st.sampled_from(asked.COSTS))
def test_utility_by_counting(rows, cost):
    (outcome,) = outcomes(answered(rows))
    every = [gap for scene in rows for gap, _, _ in scene]
    clean, hits = (sum(gap is not None and (gap < 0) == bad for gap in every) for bad in (0, 1))
    value = asked.utility(outcome, cost)(np.arange(len(rows)))
    assert value == pytest.approx((clean - cost * hits) / len(every))


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.1, 0.2, 0.7]), st.booleans()), max_size=6))
def test_the_curve_is_the_mean_over_all_orders_of_equals(pairs):
    risk, hit = np.array([r for r, _ in pairs]), np.array([h for _, h in pairs], dtype=bool)
    orders = [
        order
        for order in permutations(range(len(pairs)))
        if all(risk[a] <= risk[b] for a, b in pairwise(order))
    ]
    slow = np.mean([[np.mean(hit[list(o[: k + 1])]) for k in range(len(o))] for o in orders], 0)
    np.testing.assert_allclose(asked.risk_curve(risk, hit), slow, atol=1e-12)


@given(some)
@settings(max_examples=25, deadline=None)
def test_the_area_is_that_of_the_pooled_curve_and_ranks_by_what_is_stated(rows):
    (outcome,) = outcomes(answered(rows))
    flat = [one for scene in rows for one in scene if one[0] is not None]
    draws = np.array([np.zeros(len(rows), int), np.arange(len(rows))])
    alone, together = asked.area(outcome)(draws)
    risk = np.array([stated for _, stated, _ in flat])
    hit = np.array([gap < 0 for gap, _, _ in flat], dtype=bool)
    if flat:
        assert together == pytest.approx(asked.risk_curve(risk, hit).mean())
    else:
        assert np.isnan(together)
    first = [one for one in rows[0] if one[0] is not None]
    if first:
        twice = [*first] * len(rows)
        expected = asked.risk_curve(
            np.array([s for _, s, _ in twice]), np.array([g < 0 for g, _, _ in twice], dtype=bool)
        ).mean()
        assert alone == pytest.approx(expected)
    bare = answered([[(gap, None, clearance) for gap, _, clearance in scene] for scene in rows])
    by_room, _ = asked.risks(outcomes(bare)[0].all)
    assert list(by_room) == [-clearance for _, _, clearance in flat]


def test_refusals_of_what_somebody_reached_were_possible():
    """Scene 0: goals 0 and 2 in truth; goal 1 by somebody without a collision, 3 with one."""
    clean, hit, no = (0.01, 0.0, 0.01), (-0.01, 0.5, 0.01), (None, None, None)
    timid = answered([[no, no, no, no], [no, hit, clean, no]], "points")
    bold = answered([[no, clean, no, hit], [no, hit, clean, no]], "ours-m0")
    both = timid + bold
    everyone = outcomes(both)
    reached = asked.possible(both, everyone)
    assert reached == [[True, True, True, False], [True, False, True, False]]
    row = asked.row(everyone[0], reached)
    assert (row["refusals"], row["impossible"]) == (6, 2)
    assert (row["asked"], row["answered"], row["collided"]) == (8, 2, 1)
    assert row["clean"]["value"] == 1 / 8
    assert row["utility 10"]["value"] == pytest.approx((1 - 10) / 8)
    assert row["at"] == {"0.2": pytest.approx(0.5), "0.4": None, "0.6": None}


def test_calibration_counts_what_was_stated():
    rows = [[(-0.01, 0.3, 0.0), (0.01, 0.3, 0.0), (0.01, 0.0, 0.0)], [(None, None, None)] * 3]
    (outcome,) = outcomes(answered(rows))
    found = asked.calibration([outcome])
    assert (found["paths"], found["between"]) == (3, 2)
    assert found["ece"] == pytest.approx(2 / 3 * abs(0.3 - 0.5))
    assert found["observed"] == pytest.approx(1 / 3)
    assert [b["count"] for b in found["bins"]] == [1, 2]
    (points,) = outcomes(answered([[(0.01, None, 0.0)]], "points"))
    assert asked.calibration([points]) is None
    assert asked.calibration([]) is None


def test_the_page_says_what_the_figures_say(tmp_path):
    rng = np.random.default_rng(0)

    def rows(success, collision, states):
        return [
            [(None if rng.random() > success else -0.01 if rng.random() < collision else 0.01,
              float(rng.integers(11) / 10) if states else None, float(rng.random()))
             for _ in range(8)]
            for _ in range(4)
        ]  # fmt: skip

    made = {"default": (0.6, 0.0), "ours-m0": (0.9, 0.2), "ours-r10": (0.7, 0.1),
            "points": (0.9, 0.5), "fcl-m10": (0.0, 0.0)}  # fmt: skip
    found = [
        entry
        for key, (a, b) in made.items()
        for entry in answered(rows(a, b, CONTENDERS[key].posterior), key)
    ]
    about = {
        "kinds": {"solids": 4}, "first_seed": 0, "count": 8, "replaced": {}, "commits": ["0"],
        "left_out": ["points solids 9: no"], "criteria": HOW.to_dict(),
        "limits": vars(asking.Limits()), "command": "python -m experiments asked",
    }  # fmt: skip
    figures, files = asked.write_report(found, about, tmp_path)
    assert {f.name for f in files} == {"asked.md", "asked.json", "asked.png"}
    assert json.loads((tmp_path / "asked.json").read_text()) == json.loads(json.dumps(figures))
    assert figures["goals"] == 32
    assert figures["reachable"] == [16, 8]
    text = (tmp_path / "asked.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(made)
    row = figures["contenders"]["ours-r10"]
    assert f"at 10 % {row['collided']} of {row['answered']} (at most" in text
    n, k = row["answered"], row["collided"]
    assert row["upper"] == pytest.approx(beta.ppf(0.975, k + 1, n - k))
    for gain in figures["against"].values():
        worth = [figures["contenders"][k]["utility 3"]["value"] for k in ("points", "fcl-m10")]
        assert gain["best"] in ("points", "fcl-m10")
    assert figures["against"]["3"]["best"] == ("points", "fcl-m10")[int(np.argmax(worth))]
    assert "points solids 9: no" in text


def test_every_kind_gets_all_scenes_and_goals_from_the_image(tmp_path, monkeypatch):
    told = []

    def run(kind, scenes, first_seed, **how):
        told.append((kind, scenes, first_seed, how["checkers"], how["count"], how["criteria"]))
        found = answered([[(0.01, 0.0, 0.01)]] * scenes)
        return Found([{**entry, "kind": kind} for entry in found], {})

    monkeypatch.setattr(report, "run", run)
    figures, files = asked.benchmark(
        ("ycb", "random"), 2, first_seed=7, output=tmp_path, store=tmp_path / "s"
    )
    assert told == [(kind, 2, 7, ASKED, 30, HOW) for kind in ("ycb", "random")]
    assert figures["about"]["kinds"] == {"ycb": 2, "random": 2}
    assert len(files) == 3


def test_goals_and_vetted_ends_are_different_questions(tmp_path, monkeypatch):
    """They share a store; the criteria tell them apart, and a task knows what to find."""
    cases = []

    def sweep(task, given, store, **how):
        cases.extend(given)
        return [{"problems": [{}] * 2} for _ in given]

    monkeypatch.setattr(running, "sweep", sweep)
    for criteria in (None, HOW):
        how = {} if criteria is None else {"criteria": criteria}
        monkeypatch.setattr(running, "sweep_complete", lambda *_, **__: ([], [], None))
        running.run("solids", 1, 7, checkers=["truth"], count=2, store=tmp_path, **how)
    vetted, proposed = cases
    assert ("criteria" in vetted.asked, "proposals" in vetted.asked) == (True, False)
    assert ("criteria" in proposed.asked, "proposals" in proposed.asked) == (False, True)
    assert Proposals.from_dict(json.loads(json.dumps(proposed.asked["proposals"]))) == HOW
