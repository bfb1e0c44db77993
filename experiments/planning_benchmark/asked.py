# SPDX-License-Identifier: BSD-3-Clause
"""Who knows what it does not know? Goals from the image, judged by the truth afterwards.

A contender may refuse; what it answers and what collides decide what it is worth to a user to
whom a collision is c times as bad as a reached goal is good.
"""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from experiments.metrics import Reliability
from experiments.planning_benchmark import report
from experiments.planning_benchmark.asking import Answer
from experiments.planning_benchmark.contenders import ASKED, CONTENDERS, full_label
from experiments.planning_benchmark.proposals import Proposals
from experiments.planning_benchmark.report import exceptions, percent
from experiments.planning_benchmark.summary import OURS, REFERENCE, Outcome, estimate, outcomes
from experiments.tables.intervals import Statistic, difference, over_scenes, ratio
from vprism_plan._files import write_text
from vprism_plan.collision import CheckerConfig
from vprism_plan.collision.risk import clopper_pearson

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "asked"
COSTS = (3, 10, 30, 100)  # of a collision, in reached goals
COVERAGES = (0.2, 0.4, 0.6)  # shares of the goals at which the curves are read
UNBOUND = "ours-m0"  # its paths are selected by no probability: what calibration is read from


def benchmark(
    kinds: Sequence[str] = ("analytic", "ycb", "random"),
    scenes: int = 30,
    *,
    checkers: Iterable[str] | None = None,
    count: int = 30,
    criteria: Proposals | None = None,
    **how: Any,
) -> tuple[dict[str, Any], list[Path]]:
    """Run on `scenes` scenes of each kind and write asked.md, .json and .png.

    Other arguments, results and errors are those of the vetted benchmark.
    """
    return report.benchmark(
        kinds, scenes * len(kinds), checkers=ASKED if checkers is None else checkers, count=count,
        criteria=criteria or Proposals(), write=write_report, **how,
    )  # fmt: skip


# --- figures --------------------------------------------------------------------------


def utility(outcome: Outcome, cost: float) -> Statistic:
    """Return (clean - cost * collided) / asked over scenes."""
    n = outcome.counts()
    return ratio(n["paths"] - (1.0 + cost) * n["collided"], n["problems"])


def risks(answers: Sequence[Answer]) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return what each path is ranked by, the riskiest highest, and whether it collides.

    That is its stated probability, or the negative clearance (m) where none is stated.
    """
    found = [a for a in answers if a.truth is not None]
    stated = [-(a.clearance or 0.0) if a.stated is None else a.stated for a in found]
    hit = [a.truth is not None and a.truth.collides for a in found]
    return np.array(stated, dtype=float), np.array(hit, dtype=bool)


def risk_curve(
    risk: Float[np.ndarray, " n"], collided: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Share that collides of the k paths of least risk, k = 1 to n.

    Paths of equal risk are taken in any order: what is expected over all of them.
    """
    _, group, size = np.unique(risk, return_inverse=True, return_counts=True)
    expected = np.repeat(np.bincount(group, weights=collided) / size, size)
    return np.asarray(np.cumsum(expected) / np.arange(1, len(risk) + 1))


def area(outcome: Outcome) -> Statistic:
    """Return the mean of `risk_curve` over all that was answered; NaN without answers."""
    own = [risks(scene) for scene in outcome.answers]

    def statistic(scenes: np.ndarray) -> Any:
        values = []
        for row in scenes.reshape(-1, scenes.shape[-1]):
            risk, hit = (np.concatenate([own[s][part] for s in row]) for part in (0, 1))
            values.append(risk_curve(risk, hit).mean() if len(risk) else np.nan)
        return np.array(values).reshape(scenes.shape[:-1])

    return statistic


def possible(found: Sequence[dict[str, Any]], everyone: Sequence[Outcome]) -> list[list[bool]]:
    """Return, per scene, which goals can be reached: in truth, or by anybody without a collision.

    (The search on the truth keeps a lower bound of the distance and has a time limit.)
    """
    truth = {(e["kind"], e["seed"]): [own[0] for own in e["reachable"]] for e in found}
    for s, reached in enumerate(truth.values()):
        for outcome in everyone:
            for k, answer in enumerate(outcome.answers[s]):
                reached[k] |= answer.truth is not None and not answer.truth.collides
    return list(truth.values())


def row(outcome: Outcome, reached: Sequence[Sequence[bool]]) -> dict[str, Any]:
    """Return one contender's figures, ready for JSON; `reached` as `possible` returns it."""
    n, scenes = outcome.counts(), len(outcome.answers)
    refused = [
        can
        for scene, own in zip(outcome.answers, reached, strict=True)
        for answer, can in zip(scene, own, strict=True)
        if answer.truth is None
    ]
    curve, asked = risk_curve(*risks(outcome.all)), int(n["problems"].sum())
    collided, paths = int(n["collided"].sum()), int(n["paths"].sum())
    shares = {
        "clean": ratio(n["paths"] - n["collided"], n["problems"]),
        "collides": ratio(n["collided"], n["problems"]),
        "refused": ratio(n["problems"] - n["paths"], n["problems"]),
        "area": area(outcome),
        **{f"utility {c}": utility(outcome, c) for c in COSTS},
    }
    places = {f"{c:g}": max(1, round(c * asked)) for c in COVERAGES}
    return {
        "contender": outcome.contender.to_dict(), "asked": asked, "answered": paths,
        "collided": collided, "impossible": len(refused) - sum(refused), "refusals": len(refused),
        **{name: estimate(share, scenes).to_dict() for name, share in shares.items()},
        "at": {c: float(curve[k - 1]) if k <= paths else None for c, k in places.items()},
        "upper": float(clopper_pearson(paths, 0.95)[1][collided]) if paths else 1.0,
        "seconds": float(np.mean([a.processor for a in outcome.all])),
        "build": float(np.median(outcome.builds)),
    }  # fmt: skip


def calibration(chosen: Sequence[Outcome]) -> dict[str, Any] | None:
    """Return how true the stated probabilities of whole paths are; None if nobody states any."""
    pairs = [
        [(a.stated, a.truth.collides) for o in chosen for a in o.answers[s]
         if a.stated is not None and a.truth is not None]
        for s in range(len(chosen[0].answers) if chosen else 0)
    ]  # fmt: skip
    if not any(pairs):
        return None
    tables = [Reliability.of(np.array([p for p, _ in own]), np.array([y for _, y in own], bool))
              for own in pairs]  # fmt: skip
    merged = Reliability.merged(tables)
    return {
        "paths": merged.n, "ece": merged.ece, "brier": merged.brier,
        "between": sum(0.1 <= p <= 0.9 for own in pairs for p, _ in own),
        "predicted": merged.mean_predicted, "observed": merged.mean_observed,
        "bins": [vars(b) for b in over_scenes(tables)],
    }  # fmt: skip


def summary(found: Sequence[dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
    """Return all figures of `run`'s answers, ready for JSON."""
    everyone = outcomes(found)
    reached = possible(found, everyone)
    by_key = {o.contender.key: o for o in everyone}
    rows = {key: row(o, reached) for key, o in by_key.items()}
    ours = [o for o in everyone if any(a.stated is not None for a in o.all)]
    others = [key for key in rows if not key.startswith((OURS, "default", REFERENCE))]
    against = {}
    if "default" in rows and others:
        for cost in COSTS:
            best = max(others, key=lambda key: rows[key][f"utility {cost}"]["value"])
            gain = difference(utility(by_key["default"], cost), utility(by_key[best], cost))
            against[str(cost)] = {"best": best, **estimate(gain, len(reached)).to_dict()}
    goals = [own for e in found if e["contender"] == everyone[0].contender.key
             for own in e["reachable"]]  # fmt: skip
    return {
        "about": about, "contenders": rows, "against": against, "goals": len(goals),
        "reachable": [sum(column) for column in zip(*goals, strict=True)],
        "possible": sum(map(sum, reached)),
        "calibration": {
            "unbound": calibration([by_key[UNBOUND]] if UNBOUND in by_key else []),
            "everything": calibration(ours),
        },
    }  # fmt: skip


def write_report(
    found: Sequence[dict[str, Any]], about: dict[str, Any], output: Path
) -> tuple[dict[str, Any], list[Path]]:
    """Write asked.png, .json and .md of answers and what was asked."""
    from vprism_plan.viz._figures import save_figure

    figures = summary(found, about)
    files = [output / f"{KEY}{end}" for end in (".png", ".json", ".md")]
    save_figure(picture(figures, outcomes(found)), files[0])
    write_text(files[1], json.dumps(figures, indent=1, allow_nan=False) + "\n")
    write_text(files[2], markdown(figures))
    return figures, files


# --- picture --------------------------------------------------------------------------


def picture(figures: dict[str, Any], everyone: Sequence[Outcome]) -> "Figure":
    """Draw utility over the cost of a collision, and collisions over what is answered.

    Of several bounds that one is drawn that suits the cost, 1 / (1 + c); 0.1 in the curves.
    """
    from experiments.planning_benchmark.pictures import style
    from vprism_plan.viz._figures import new_figure

    figure = new_figure(14.0, 7.5)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    by_key, rows = {o.contender.key: o for o in everyone}, figures["contenders"]
    lines: dict[str, list[str]] = {}
    for c in (CONTENDERS[key] for key in rows):
        lines.setdefault(c.line if c.bounds[-1][1] else full_label(c), []).append(c.key)
    ours = [name for name, keys in lines.items() if keys[0].startswith(OURS)]
    for number, (name, keys) in enumerate(lines.items()):
        color, marker = style(keys[0], ours.index(name) if name in ours else 0)
        chosen = [rows[_suiting(keys, cost)][f"utility {cost}"] for cost in COSTS]
        middle, low, high = (
            np.array([one["value"] if one[end] is None else one[end] for one in chosen])
            for end in ("value", "low", "high")
        )
        x = np.arange(len(COSTS)) + 0.85 * ((number + 0.5) / len(lines) - 0.5)
        left.errorbar(x, middle, np.abs([middle - low, high - middle]), fmt=marker, color=color,
                      elinewidth=1.0, markersize=6.0, label=name)  # fmt: skip
        key = _suiting(keys, 9)
        curve = risk_curve(*risks(by_key[key].all))
        share = 100.0 * np.arange(1, len(curve) + 1) / rows[key]["asked"]
        right.plot(
            share, 100.0 * curve, color=color, marker=marker, markevery=[-1] * len(curve[:1])
        )
    left.axhline(0.0, color="#000000", linewidth=0.8)
    for number in range(len(COSTS) - 1):
        left.axvline(number + 0.5, color="#cccccc")
    left.set_yscale("symlog", linthresh=1.0)
    ticks = (1, 0.5, 0, -0.5, -1, -3, -10, -30)
    left.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    left.set_xticks(range(len(COSTS)), [str(cost) for cost in COSTS])
    left.set_xlabel("cost c of a collision, in reached goals")
    left.set_ylabel("utility (clean - c collides) / asked")
    left.set_title("What it is worth (0: refuse everything; bars: 95 %)", fontsize=10)
    right.set_xlabel("goals answered, least stated risk first (%)")
    right.set_ylabel("answers that truly collide (%)")
    right.set_ylim(bottom=0.0)
    right.set_title("Does it know which answers to trust?", fontsize=10)
    left.grid(axis="y", alpha=0.3)
    right.grid(alpha=0.3)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4,
                  fontsize=8)  # fmt: skip
    return figure


def _suiting(keys: Sequence[str], cost: float) -> str:
    """Return the contender whose bound on the risk is nearest to 1 / (1 + cost)."""
    return min(keys, key=lambda k: abs(math.log((CONTENDERS[k].bounds[-1][1] or 1) * (1 + cost))))


# --- Markdown -------------------------------------------------------------------------


def markdown(figures: dict[str, Any]) -> str:
    """Return the report; `figures` as `summary` makes them."""
    about, rows = figures["about"], figures["contenders"]
    sets = ", ".join(f"{n} of {kind}" for kind, n in about["kinds"].items())
    lines = [
        "# Asked: who knows what it does not know?", "",
        *_points(figures), "",
        f"{figures['goals']} hand poses in {sets} scenes (seeds from {about['first_seed']}), "
        f"proposed from the image alone. The truth judges afterwards: {figures['reachable'][0]} "
        f"can be reached, {figures['reachable'][-1]} with "
        f"{1000 * about['criteria']['clearances'][-1]:.0f} mm to spare. Reprint with", "",
        f"    {about['command']}", "",
        f'Computed at {", ".join(about["commits"])} ("+": with uncommitted changes).', "",
        *exceptions(about),
        f"![Utility, and collisions over what is answered]({KEY}.png)", "",
        "| map and rule | clean (%) | collides (%) | refused (%) | of those impossible (%) | "
        + " | ".join(f"U({c})" for c in COSTS) + " | area (%) | "
        + " | ".join(f"first {100 * c:.0f} % (%)" for c in COVERAGES) + " | query (s) | map (s) |",
        "|---" * (8 + len(COSTS) + len(COVERAGES)) + "|",
    ]  # fmt: skip
    for key, own in rows.items():
        impossible = 100 * own["impossible"] / own["refusals"] if own["refusals"] else math.nan
        cells = [
            full_label(CONTENDERS[key]), *(percent(own[k]) for k in ("clean", "collides")),
            percent(own["refused"]), "-" if math.isnan(impossible) else f"{impossible:.0f}",
            *(_figure(own[f"utility {c}"]) for c in COSTS), percent(own["area"]),
            *("-" if v is None else f"{100 * v:.1f}" for v in own["at"].values()),
            f"{own['seconds']:.2f}", f"{own['build']:.1f}",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_explanation(about)])


def _figure(one: dict[str, Any]) -> str:
    text = "-" if one["value"] is None else f"{one['value']:.2f}"
    return text if one["low"] is None else f"{text} [{one['low']:.2f}, {one['high']:.2f}]"


def _points(figures: dict[str, Any]) -> list[str]:
    """What holds, in sentences."""
    rows, lines = figures["contenders"], []
    for cost, gain in figures["against"].items():
        best = gain["best"]
        lines.append(
            f"- A collision as bad as {cost} reached goals are good: ours as it comes is worth "
            f"{_figure(rows['default'][f'utility {cost}'])} per goal, the best of the others "
            f"({full_label(CONTENDERS[best])}) {_figure(rows[best][f'utility {cost}'])}; "
            f"the difference is {_figure(gain)}."
        )
    held: dict[str, list[str]] = {}
    for key, own in rows.items():
        bound = CheckerConfig().max_risk if key == "default" else CONTENDERS[key].bounds[-1][1]
        if bound is not None:
            name = full_label(CONTENDERS[key]) if key == "default" else CONTENDERS[key].line
            held.setdefault(name, []).append(
                f"at {100 * bound:g} % {own['collided']} of {own['answered']} "
                f"(at most {100 * own['upper']:.1f} %)"
            )
    for name, said in held.items():
        lines.append(f"- Answers that collide by bound, {name}: {', '.join(said)}.")
    for name, words in (("unbound", "paths planned without a bound"), ("everything", "all paths")):
        own = figures["calibration"][name]
        if own is not None:
            lines.append(
                f"- Stated probability of {words}: {100 * own['predicted']:.1f} % on average, "
                f"{100 * own['observed']:.1f} % collide; expected calibration error "
                f"{own['ece']:.3f} over {own['paths']} paths, {own['between']} of them between "
                "0.1 and 0.9. Stated, and observed: "
                + "; ".join(
                    f"{100 * b['predicted']:.0f} %, {100 * b['observed']:.0f} % of {b['count']}"
                    for b in own["bins"]
                )
                + "."
            )
    return lines


def _explanation(about: dict[str, Any]) -> list[str]:
    """What was asked, and what the columns mean."""
    c, limits = about["criteria"], about["limits"]
    near, far = (1000 * metres for metres in c["behind"])
    return [
        "## What is asked", "",
        f"- **Goals**: {about['count']} a scene. The finger tip lies {near:.0f} to {far:.0f} mm "
        "behind a seen point of an object, along its ray. The hand leans at most "
        f"{math.degrees(c['tilt']):.0f} degrees from straight down. The robot keeps "
        f"{1000 * c['clear']:g} mm from all that was seen (flying pixels left out) and from the "
        "support. Nobody has looked at the truth.",
        "- **Start**: one fixed configuration of the arm, clear of everything in truth.",
        f"- **Planner**: {limits['planner']}, {limits['time_limit']:g} s of processor time, then "
        f"at most {limits['simplify_time']:g} s of shortening; the same seed for everybody.",
        "- **Refused**: no path. Impossible: the truth has none, within "
        f"{c['time_limit']:g} s, and nobody found a clean one. **U(c)**: (clean - c collides) / "
        "asked; who refuses everything gets 0.",
        "- **area**: answers are ranked by what their checker states: the probability of a "
        "collision, or else the clearance. The mean share of collisions over all ranks; less is "
        "better. **first 20 %**: that share when the best ranked answer 20 % of the goals.",
        "- **Stated probability**: of the whole path. With a bound, by worlds that the search has "
        "not seen. **At most**: upper end of Clopper and Pearson's 95 % interval.",
        "- **ours as it comes**: `World(map)`, `CheckerConfig()` and `plan()` with their defaults. "
        "**PointSDF**, **shape network alone**: their solids and the seen points. The others are "
        "those of the vetted benchmark.",
        "- **Tuned on**: seeds 0 to 99. Objects of `random` were never tuned on; `ycb` and "
        "`analytic` are held out by scene. Both networks were trained on other scenes.", "",
        "Brackets: 95 % bootstrap intervals over scenes. Query: processor time, mean. Map: from "
        "the image to a checker that answers.", "",
    ]  # fmt: skip
