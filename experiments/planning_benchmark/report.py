# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark as Markdown, JSON, pictures and OMPL's log.

results, files = benchmark(("ycb",), scenes=30, output=Path("docs/results"))
"""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from experiments.planning_benchmark.asking import Limits
from experiments.planning_benchmark.contenders import VETTED, full_label
from experiments.planning_benchmark.ompl_log import write_log
from experiments.planning_benchmark.problems import Criteria
from experiments.planning_benchmark.proposals import Proposals
from experiments.planning_benchmark.run import Found, run
from experiments.planning_benchmark.summary import (
    DEEP,
    REFERENCE,
    Outcome,
    Statement,
    outcomes,
    statements,
)
from vprism_plan._files import write_text
from vprism_plan.errors import ConfigError

KEY = "planning"
_KNOWN = {
    "seen": "what the camera saw",
    "supported": "occluded, with support",
    "unsupported": "occluded, without support",
    "unobserved": "outside the image or without a return",
    "table": "the table",
}

Write = Callable[
    [Sequence[dict[str, Any]], dict[str, Any], Path], tuple[dict[str, Any], list[Path]]
]


def benchmark(
    kinds: Sequence[str] = ("analytic", "ycb", "random"),
    scenes: int = 30,
    first_seed: int = 1000,
    *,
    output: Path,
    store: Path,
    checkers: Iterable[str] | None = None,
    count: int = 20,
    criteria: Criteria | Proposals | None = None,
    limits: Limits | None = None,
    data: Path | None = None,
    write: Write | None = None,
    command: str = "",
    **how: Any,
) -> tuple[dict[str, Any], list[Path]]:
    """Run the benchmark on `scenes` scenes in all, shared out among the kinds, and write it.

    Returns the figures, ready for JSON, and the files, as `write` does with answers, what was
    asked, and the folder; `write_report` if None. Other arguments are those of `run`.

    Raises:
        ConfigError: fewer scenes than kinds; or as `run`.
        SweepError: some scenes failed; the report is written without them, and names them.
    """
    chosen = VETTED if checkers is None else tuple(checkers)
    limits = Limits() if limits is None else limits
    criteria = Criteria() if criteria is None else criteria
    if not kinds or scenes < len(kinds):
        raise ConfigError(
            f"scenes is {scenes} for {len(kinds)} sets ({', '.join(kinds)}); scenes are shared out "
            "among the sets, and each needs at least one"
        )
    found: dict[str, Found] = {}
    for number, kind in enumerate(kinds):
        own = scenes // len(kinds) + (number < scenes % len(kinds))
        found[kind] = run(
            kind, own, first_seed, checkers=chosen, count=count, criteria=criteria,
            limits=limits, store=store, data=data if kind in ("ycb", "folder") else None, **how,
        )  # fmt: skip
    answers = [entry for own in found.values() for entry in own.answers]
    failures = [own.failed for own in found.values() if own.failed is not None]
    about = {
        "kinds": {
            kind: len({entry["seed"] for entry in own.answers}) for kind, own in found.items()
        },
        "replaced": {
            kind: {str(seed): offered for seed, offered in own.replaced.items()}
            for kind, own in found.items()
        },
        "left_out": [f"{f.name}: {f.error}" for error in failures for f in error.failures],
        "first_seed": first_seed, "count": count, "criteria": criteria.to_dict(),
        "limits": vars(limits), "command": command,
        "commits": sorted({entry["commit"] for entry in answers}),
    }  # fmt: skip
    figures, files = (write or write_report)(answers, about, output)
    if failures:
        raise failures[0]
    return figures, files


def write_report(
    found: Sequence[dict[str, Any]], about: dict[str, Any], output: Path
) -> tuple[dict[str, Any], list[Path]]:
    """Write planning.md, .json, .png, -fates.png and .log of answers and what was asked."""
    from experiments.planning_benchmark.pictures import curve_figure, fates_figure
    from vprism_plan.viz._figures import save_figure

    everything = outcomes(found)
    reference = _reference(everything)
    figures: dict[str, Any] = {
        "about": about,
        "contenders": {o.contender.key: o.to_dict(reference) for o in everything},
        "statements": [statement.to_dict() for statement in statements(everything)],
        "sets": {
            kind: {
                o.contender.key: {k: v.to_dict() for k, v in o.estimates().items()}
                for o in outcomes([entry for entry in found if entry["kind"] == kind])
            }
            for kind in about["kinds"]
        },
    }
    files = [output / f"{KEY}{end}" for end in (".png", "-fates.png", ".json", ".md", ".log")]
    save_figure(curve_figure(everything), files[0])
    save_figure(fates_figure(everything), files[1])
    write_text(files[2], json.dumps(figures, indent=1, allow_nan=False) + "\n")
    write_text(files[3], markdown(figures, everything))
    setup = f"{about['count']} problems in each of {about['kinds']}, seeds from "
    setup += f"{about['first_seed']}; {about['command']}"
    write_log(files[4], everything, "vprism_plan planning", Limits(**about["limits"]), setup)
    return figures, files


def _reference(found: Sequence[Outcome]) -> Outcome | None:
    return next((o for o in found if o.contender.key == REFERENCE), None)


# --- Markdown -------------------------------------------------------------------------


def markdown(figures: dict[str, Any], found: Sequence[Outcome]) -> str:
    """Return the report in Markdown; `figures` as `write_report` makes them."""
    about = figures["about"]
    sets = ", ".join(f"{n} of {kind}" for kind, n in about["kinds"].items())
    lines = [
        "# Planning: does it get safer?", "",
        f"The same planner, robot and time with different maps of {sets} scenes (seeds from "
        f"{about['first_seed']}), {about['count']} problems each. Every returned path is judged "
        "by the true scene. Reprint with", "",
        f"    {about['command']}", "",
        f'Computed at {", ".join(about["commits"])} ("+": with uncommitted changes).', "",
        *exceptions(about),
        "## What holds", "",
        *[f"- {_sentence(s)}" for s in statements(found)], "",
        f"![Success against true collisions]({KEY}.png)", "",
        "Light band: what ours reach together (the lower hull: one may toss a coin between two).",
        "", *_table(figures, found), *_losses(figures, found), *_sets(figures, found),
        *_explanation(about),
    ]  # fmt: skip
    return "\n".join(lines)


def exceptions(about: dict[str, Any]) -> list[str]:
    """Which scenes are not those that the seeds say, and why."""
    lines = []
    short = [
        f"{kind} {seed} ({offered})"
        for kind, own in about["replaced"].items()
        for seed, offered in own.items()
    ]
    if short:
        lines += [
            f"Scenes that offer fewer than {about['count']} such problems, replaced by the next "
            f"seeds: {', '.join(short)}.", "",
        ]  # fmt: skip
    if about["left_out"]:
        lines += ["Left out for everybody, since somebody failed there:", ""]
        lines += [*[f"- {line}" for line in about["left_out"]], ""]
    return lines


def _sentence(s: Statement) -> str:
    interval = ""
    if s.quotient.low == s.quotient.low:
        interval = f", 95 % interval {s.quotient.low:.2f} to {s.quotient.high:.2f}"
    theirs, ours = f"{100 * s.theirs:.1f} %", f"{100 * s.ours:.1f} %"
    if s.asked.startswith("collisions"):
        place = "" if s.reached else f" (which {s.who} do not reach: their highest success counts)"
        words = f"{s.quotient.value:.2f} times its true collisions{interval}"
        return (
            f"At the success rate of {s.against}{place}, {s.who} collide in {ours} of all "
            f"problems, {s.against} in {theirs}: {words if s.theirs else 'it never collides'}."
        )
    words = f"{s.quotient.value:.2f} times its successes{interval}"
    return (
        f"At the collision rate of {s.against}, {s.who} solve {ours} of the problems, "
        f"{s.against} {theirs}: {words if s.theirs else 'it solves none'}."
    )


def percent(figure: dict[str, float | None]) -> str:
    """Return a share, and its interval if it has one, in percent."""
    if figure["value"] is None:
        return "-"
    text = f"{100 * figure['value']:.1f}"
    if figure["low"] is None or figure["high"] is None:
        return text
    return f"{text} [{100 * figure['low']:.1f}, {100 * figure['high']:.1f}]"


def _table(figures: dict[str, Any], found: Sequence[Outcome]) -> list[str]:
    lines = [
        "## Everybody", "",
        "| map and rule | success (%) | paths that collide (%) | by more than "
        f"{1000 * DEEP:.0f} mm (%) | solved without collision (%) | depth, mean and worst (mm) "
        "| length | way of the tip | query, median and 95 % (s) | map (s) |",
        "|---" * 10 + "|",
    ]  # fmt: skip
    for outcome in found:
        row = figures["contenders"][outcome.contender.key]
        length, travel = (
            "-" if row[name] is None else f"{row[name]:.2f}" for name in ("length", "travel")
        )
        lines.append(
            f"| {full_label(outcome.contender)} | {percent(row['success'])} "
            f"| {percent(row['collision'])} | {percent(row['deep'])} | {percent(row['safe'])} "
            f"| {1000 * row['mean_depth']:.1f}, {1000 * row['worst_depth']:.0f} "
            f"| {length} | {travel} "
            f"| {row['seconds_median']:.2f}, {row['seconds_95']:.2f} | {row['build']:.1f} |"
        )
    return [*lines, ""]


def _losses(figures: dict[str, Any], found: Sequence[Outcome]) -> list[str]:
    """Where successes are lost, and what is hit."""
    lines = [
        "## Where the losses come from", "", f"![What became of all problems]({KEY}-fates.png)", "",
        "Refused: the deepest contact of the refused start or goal. Hit: what was known of the "
        "place of the deepest penetration.", "",
        "| map and rule | refused: | no path: | hit: |", "|---|---|---|---|",
    ]  # fmt: skip
    for outcome in found:
        row = figures["contenders"][outcome.contender.key]
        unsolved = {k: v for k, v in row["unsolved"].items() if k != "refused"}
        hit = {_KNOWN.get(k, k): v for k, v in row["hit"].items()}
        cells = [_counts(part) for part in (row["refused"], unsolved, hit)]
        lines.append(f"| {full_label(outcome.contender)} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _counts(part: dict[str, int]) -> str:
    ranked = sorted(part.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {count}" for name, count in ranked[:5]) or "-"


def _sets(figures: dict[str, Any], found: Sequence[Outcome]) -> list[str]:
    kinds = list(figures["sets"])
    if len(kinds) < 2:
        return []
    lines = ["## Set by set", "", "Success and, after the slash, paths that collide (%).", ""]
    lines += ["| map and rule | " + " | ".join(kinds) + " |", "|---" * (1 + len(kinds)) + "|"]
    for outcome in found:
        cells = []
        for kind in kinds:
            row = figures["sets"][kind][outcome.contender.key]
            hit = row["collision"]["value"]
            rate = "-" if hit is None else f"{100 * hit:.1f}"
            cells.append(f"{100 * (row['success']['value'] or 0.0):.1f} / {rate}")
        lines.append(f"| {full_label(outcome.contender)} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _explanation(about: dict[str, Any]) -> list[str]:
    """What was asked, and what the columns mean."""
    c, limits = about["criteria"], about["limits"]
    ends = ", ".join(f"{1000 * e:.0f}" for e in c["ends"])
    return [
        "## What is asked", "",
        "- **Robot**: the Panda beside the table, base at (0.05, -0.6, 0) m; its collision spheres "
        "are its geometry for every checker and for the truth. Links that no joint moves stand on "
        "the table.",
        f"- **Problems**: every end has a finger tip at most {1000 * c['tip']:.0f} mm from an "
        f"object (a hand at most {1000 * c['hand']:.0f} mm); at least {100 * c['hidden']:.0f} % "
        "have an end whose finger tip the camera cannot see; the straight motion comes within "
        f"{1000 * c['straight']:.0f} mm of something or collides. The ends keep at least {ends} mm "
        "from the true scene (a third each), and the same planner has found a path that keeps "
        f"{1000 * c['clearance']:.0f} mm within {c['time_limit']:g} s on the truth. So a checker "
        "that refuses an end, or finds no path, is too careful or wrong there.",
        f"- **Planner**: {limits['planner']}, {limits['time_limit']:g} s of processor time for the "
        f"search, then "
        f"shortening (at most {limits['simplify_time']:g} s); the same seed for everybody.",
        "- **Truth**: exact distances of the spheres to the true meshes and the table at samples "
        "with at most 2 mm of motion between them. Any penetration is a collision.",
        "- **Everybody** has a support plane fitted to the image and takes space outside the image "
        "as free. All but the mesh checker are worlds of the same checker on the same nodes, 1 cm "
        "apart.",
        "- **ours**: the default map; occluded space is an obstacle (the package's default), an "
        "obstacle only beyond the map's support, or the map's to decide. Single unlabelled "
        "points in the air are left out (`lone_share=0.03`, for everybody; the package's default "
        "keeps them as obstacles). *margin*: distance to "
        "the level set 0.5. *risk*: the bound on the joint probability of collision. *widest "
        "margin*: 20, 10, 5 and 0 mm are tried in turn, each for a quarter of the time. *5 mm "
        "grid*: the same level set; distances between nodes are lower bounds, which lose up to "
        "some millimetres at 1 cm and half of that at 5 mm.",
        "- **meshes with FCL**: surfaces of the same map at level 0.5 and the table, as a user of "
        "meshes has them: no rule for unseen space. *10 mm*: links padded. (A distance field of "
        "the same level set answers first where it is certain; FCL's verdicts stand.)",
        "- **point cloud**: each observed point off the table, as wide as three standard "
        "deviations of the depth noise; flying pixels left out. **OctoMap**: voxels of 1 cm; "
        "unknown ones free, or those in the image obstacles. **SGD point estimate**: the level "
        "set 0.5 of the same features and data without a posterior.", "",
        "Brackets: 95 % bootstrap intervals over scenes. Lengths: median over the problems that "
        "both solved, relative to the planner that knows the truth. Query: processor time, search, "
        "shortening and verification together. Map: from the image to a checker that answers.", "",
    ]  # fmt: skip
