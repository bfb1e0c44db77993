# SPDX-License-Identifier: BSD-3-Clause
"""Does a planner that minimises risk find paths of less risk? All kinds of risk, one table.

    python -m experiments.benchmarks.ompl_objectives [--scenes 5] [--problems 4]
        [--output docs/results]

Problems: start and goal near uncertain parts of generated clutter (free, and by themselves
almost without risk), between which the path of RRTConnect, shortened, has a risk above 1 %.
Every contender gets 2.5 s of processor time. Paths are judged by posterior worlds that no
search has seen. Answers are kept under build/objectives; a run goes on where one stopped.
"""

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np
from ompl import base as ob

import vprism_plan as vp
from experiments.planning_benchmark.asking import scene_of
from experiments.planning_benchmark.grid_world import benchmark_robot
from experiments.planning_benchmark.problems import tip_sphere
from vprism_plan._files import replacing, write_text
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.collision.motion import sphere_jacobians
from vprism_plan.mapping.serialization import load_map
from vprism_plan.planning import VPrismRiskObjective, plan, quiet_ompl, state_space, to_state
from vprism_plan.planning.objectives import PathCost, RiskObjective

KEPT = Path("build/objectives")
FIRST_SCENE = 100
LEAST_RISK, RISK_AT_ENDS = 0.01, 0.004
SEARCH, SHORTENING = 2.0, 0.5  # seconds of processor time
JUDGES = {"n_worlds": 1024, "risk_seed": 4711}


@dataclass(frozen=True)
class Contender:
    """Who is asked: a planner with an objective, or with a margin."""

    name: str
    planner: str
    objective: RiskObjective | None = None
    warm: bool = True
    margin: float = 0.0


CONTENDERS = (
    Contender("RRTConnect", "RRTConnect"),
    Contender("RRTConnect, margin 2 cm", "RRTConnect", margin=0.02),
    Contender("InformedRRTstar, joint", "InformedRRTstar", RiskObjective("joint")),
    Contender("InformedRRTstar, survival", "InformedRRTstar", RiskObjective("survival")),
    Contender("InformedRRTstar, occupancy", "InformedRRTstar", RiskObjective("occupancy")),
    Contender("InformedRRTstar, entropy", "InformedRRTstar", RiskObjective("entropy")),
    Contender(
        "InformedRRTstar, worst survival", "InformedRRTstar", RiskObjective("survival", worst=True)
    ),
    Contender("InformedRRTstar, joint, cold", "InformedRRTstar", RiskObjective("joint"), False),
    Contender("RRTstar, joint", "RRTstar", RiskObjective("joint")),
)


class Bench:
    """One scene: a map, its checkers, and problems."""

    def __init__(self, seed: int) -> None:
        file = KEPT / f"solids-{seed}.safetensors"
        if not file.exists():
            KEPT.mkdir(parents=True, exist_ok=True)
            vp.fit_map(scene_of("solids", seed).observation, vp.MapConfig(), seed=0).save(file)
        self.seed = seed
        self.robot = benchmark_robot()
        # What the objectives are told apart by are the objects of the map.
        config = vp.WorldConfig(occluded="posterior", hidden_objects=math.inf)
        self.world = vp.World(load_map(file), config)
        self.checker = CollisionChecker(self.world, self.robot, CheckerConfig(max_risk=None))
        wary = CheckerConfig(margin=0.02, max_risk=None)
        self.wary = CollisionChecker(self.world, self.robot, wary)
        self.judge = CollisionChecker(self.world, self.robot, CheckerConfig(**JUDGES))

    def risk(self, path: np.ndarray) -> float:
        """Risk by worlds that nobody plans with."""
        return float(self.judge.collision_probability(path).probability)

    def ends(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Free configurations with the finger tip near something uncertain, hand down."""
        setting = self.checker.risk_setting()
        owners, _, first = setting.worlds.owner_tables
        voxels = np.argwhere(owners >= 0) + first
        found: list[np.ndarray] = []
        while len(found) < count:
            places = setting.worlds.resolution * voxels[rng.integers(len(voxels), size=256)]
            places = places + rng.normal(scale=0.06, size=places.shape)
            places[:, 2] = np.maximum(places[:, 2], 0.04)
            for q in self._reaching(places, rng):
                if self.checker.is_valid(q) and self.risk(q) <= RISK_AT_ENDS:
                    found.append(q)
        return np.array(found[:count])

    def _reaching(self, places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        arrays, tips = self.robot.arrays, np.full(len(places), tip_sphere(self.robot))
        q = np.array([self.robot.random_configuration(rng) for _ in places])
        for _ in range(25):
            centers, jacobian = sphere_jacobians(arrays, q, tips)
            damped = jacobian @ jacobian.transpose(0, 2, 1) + 0.02**2 * np.eye(3)
            step = np.linalg.solve(damped, (places - centers)[..., None])
            step = (jacobian.transpose(0, 2, 1) @ step)[..., 0]
            largest = np.abs(step).max(axis=1, keepdims=True)
            q = q + step * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-12))
            q = np.clip(q, self.robot.lower, self.robot.upper)
        centers, _ = sphere_jacobians(arrays, q, tips)
        return q[np.linalg.norm(places - centers, axis=1) < 0.003]

    def problems(self, count: int) -> list[tuple[np.ndarray, np.ndarray, int]]:
        """Pairs of ends between which RRTConnect's path is risky: the same ones every time."""
        file = KEPT / f"problems-{self.seed}-{count}.json"
        if file.exists():
            kept = json.loads(file.read_text())
            return [(np.array(start), np.array(goal), own) for start, goal, own in kept]
        rng = np.random.default_rng(self.seed)
        ends = self.ends(24, rng)
        found = []
        for number in range(200):
            i, j = rng.choice(len(ends), 2, replace=False)
            result = self.ask(CONTENDERS[0], ends[i], ends[j], number)[0]
            if result.path is not None and self.risk(result.path) > LEAST_RISK:
                found.append((ends[i], ends[j], number))
            if len(found) == count:
                break
        write_text(file, json.dumps([(a.tolist(), b.tolist(), own) for a, b, own in found]))
        return found

    def ask(self, who: Contender, start: np.ndarray, goal: np.ndarray, seed: int):
        """Return the plan and the processor time it took."""
        began = time.process_time()
        result = plan(
            self.wary if who.margin else self.checker,
            start,
            goal,
            who.planner,
            time_limit=SEARCH,
            simplify_time=SHORTENING,
            seed=seed,
            clock="process",
            objective="length" if who.objective is None else who.objective,
            warm_start=who.warm,
        )
        return result, time.process_time() - began


def answers(scenes: int, problems: int, ask: bool) -> list[dict]:
    """Ask everybody everything that is not answered yet, the most important ones first."""
    seeds = range(FIRST_SCENE, FIRST_SCENE + scenes)
    files = {seed: KEPT / f"answers-{seed}-{problems}.json" for seed in seeds}
    kept = {k: json.loads(f.read_text()) if f.exists() else [] for k, f in files.items()}
    benches: dict[int, Bench] = {}
    for group in (CONTENDERS[:3], CONTENDERS[3:]):
        for number, seed, who in product(range(problems), seeds, group):
            row = {"scene": seed, "problem": number, "contender": who.name}
            if not ask or any(row.items() <= other.items() for other in kept[seed]):
                continue
            bench = benches.get(seed) or benches.setdefault(seed, Bench(seed))
            found = bench.problems(problems)
            if number < len(found):
                kept[seed].append({**row, **answer(bench, who, *found[number])})
                print(*list(kept[seed][-1].values())[:-1], flush=True)
                write_text(files[seed], json.dumps(kept[seed]))
    return [row for rows in kept.values() for row in rows]


def answer(bench: Bench, who: Contender, start: np.ndarray, goal: np.ndarray, seed: int) -> dict:
    """One query, judged."""
    result, seconds = bench.ask(who, start, goal, seed)
    solved = result.path is not None
    began = [(step.time, bench.risk(step.path)) for step in result.report.history]
    return {
        "status": result.status,
        "risk": bench.risk(result.path) if solved else None,
        "length": result.report.path_length if solved else None,
        "clearance": result.report.min_clearance if solved else None,
        "seconds": seconds,
        "history": began,
    }


def speed(seed: int = FIRST_SCENE, n: int = 600) -> dict[str, float]:
    """Microseconds per motion: each kind by itself, through OMPL, and the checker's verdict."""
    file = KEPT / "speed.json"
    if file.exists():
        return json.loads(file.read_text())
    bench, rng = Bench(seed), np.random.default_rng(0)
    pool = [bench.robot.random_configuration(rng) for _ in range(400)]
    pool = [q for q in pool if bench.checker.is_valid(q)]
    pairs = []
    for _ in range(n):
        a, b = pool[rng.integers(len(pool))], pool[rng.integers(len(pool))]
        far = max(1.0, float(np.linalg.norm(b - a)) / 1.5)
        pairs.append((a, np.ascontiguousarray(a + (b - a) / far)))
    found = {"check_motion": _per_call(bench.checker.check_motion_buffer, pairs)}
    for kind in ("joint", "survival", "occupancy", "entropy"):
        found[kind] = _per_call(PathCost(bench.checker, RiskObjective(kind)).risk.motion, pairs)
    with quiet_ompl():
        space = state_space(bench.robot)
        objective = VPrismRiskObjective(ob.SpaceInformation(space), bench.checker)
        states = [(to_state(space, a), to_state(space, b)) for a, b in pairs]
        found["joint, motionCost of states"] = _per_call(objective.motionCost, states)
        found["joint, remembered"] = _per_call(objective.motionCost, states)
    write_text(file, json.dumps(found))
    return found


def _per_call(ask, pairs) -> float:
    ask(*pairs[0])
    began = time.process_time()
    for pair in pairs:
        ask(*pair)
    return 1e6 * (time.process_time() - began) / len(pairs)


def summary(rows: list[dict]) -> list[dict]:
    """What every contender made of the problems whose risk can be lowered."""
    cases = sorted({(row["scene"], row["problem"]) for row in rows})
    by = {(row["scene"], row["problem"], row["contender"]): row for row in rows}
    base = {case: by[*case, "RRTConnect"]["risk"] for case in cases}
    best = {
        case: min(
            r["risk"] for r in rows if (r["scene"], r["problem"]) == case and r["risk"] is not None
        )
        for case in cases
    }
    can = [case for case in cases if best[case] < base[case]]
    table = []
    for who in CONTENDERS:
        own = [by[*case, who.name] for case in can if (*case, who.name) in by]
        risks = [row["risk"] for row in own if row["risk"] is not None]
        lower = [
            row["risk"] is not None and row["risk"] < base[row["scene"], row["problem"]]
            for row in own
        ]
        table.append(
            {
                "contender": who.name,
                "problems": len(own),
                "solved": len(risks),
                "lowered": sum(lower),
                "median_risk": float(np.median(risks)) if risks else None,
                "worst_risk": max(risks, default=None),
                "below_1_percent": sum(risk < 0.01 for risk in risks),
                "median_length": float(np.median([r["length"] for r in own if r["length"]]))
                if risks
                else None,
                "median_seconds": float(np.median([r["seconds"] for r in own])) if own else None,
            }
        )
    return table


def text(table: list[dict], rates: dict[str, float], scenes: int) -> str:
    """The page."""
    total = table[0]["problems"]
    lines = [
        "# Planning for little risk",
        "",
        "How much an objective of risk lowers the joint probability of collision of a path.",
        "",
        f"- **Problems**: {total}, in {scenes} generated scenes, seen from one view. The "
        "finger tip begins and ends within a few centimetres of something uncertain; start and "
        f"goal by themselves have a risk of at most {100 * RISK_AT_ENDS:g} %. The path that "
        f"RRTConnect finds and `plan` shortens has one above {100 * LEAST_RISK:g} %, and somebody "
        "found one with less.",
        f"- **Limits**: {SEARCH:g} s for the search and {SHORTENING:g} s for what comes after it, "
        "processor time. RRTConnect stops by itself after milliseconds.",
        f"- **Judge**: the share of {JUDGES['n_worlds']} posterior worlds, drawn apart from those "
        "that the searches use, in which the path touches anything. Hidden space that the map "
        "cannot judge is an obstacle for everybody.",
        "- *cold*: without RRTConnect's path to begin with and without samples around the best "
        "path. *worst*: the worst state of the path counts alone. *s*: all of `plan`, with the "
        "worlds that the first query with an objective draws and bakes.",
        "",
        "| contender | solved | risk lowered | median risk | worst risk | below 1 % | rad | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in table:
        if not row["solved"]:
            lines.append(f"| {row['contender']} | 0 / {row['problems']} | | | | | | |")
            continue
        share = "" if row["contender"] == "RRTConnect" else f"{row['lowered']} / {row['problems']}"
        lines.append(
            f"| {row['contender']} | {row['solved']} / {row['problems']} | {share} | "
            f"{row['median_risk']:.3f} | {row['worst_risk']:.3f} | {row['below_1_percent']} | "
            f"{row['median_length']:.1f} | {row['median_seconds']:.2f} |"
        )
    lines += ["", "## What a motion costs to ask about", "", "| | microseconds |", "|---|---|"]
    lines += [f"| {name} | {value:.0f} |" for name, value in rates.items()]
    lines += ["", "Random motions of 1.5 rad, samples 2 cm apart, one processor.", ""]
    lines += [
        "![risk](objectives.png)",
        "",
        "`python -m experiments.benchmarks.ompl_objectives`",
        "",
    ]
    return "\n".join(lines)


def picture(rows: list[dict], file: Path) -> None:
    """Risk of each contender against RRTConnect's, and how it falls with time."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    floor = 0.5 / JUDGES["n_worlds"]
    by = {(r["scene"], r["problem"], r["contender"]): r for r in rows}
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), constrained_layout=True)
    shown = [w for w in CONTENDERS if w.name != "RRTConnect"]
    colours = plt.get_cmap("tab10")(np.arange(len(shown)))
    for number, (who, colour) in enumerate(zip(shown, colours, strict=True)):
        own = [r for r in rows if r["contender"] == who.name and r["risk"] is not None]
        x = [by[r["scene"], r["problem"], "RRTConnect"]["risk"] for r in own]
        y = [max(r["risk"], floor) for r in own]
        wobble = np.exp(0.04 * (number - 3.5))
        left.scatter(np.array(x) * wobble, y, s=16, color=colour, label=who.name, alpha=0.8)
        if who.name.endswith(("joint", "survival", "entropy", "occupancy")) and who.objective:
            grid = np.linspace(0.0, 0.5 * SEARCH, 200)
            curves = [_steps(r["history"], grid) for r in own if r["history"]]
            style = "--" if who.planner == "RRTstar" else "-"
            right.plot(grid, np.maximum(_mean(curves), floor), style, color=colour)
    left.plot([LEAST_RISK, 1], [LEAST_RISK, 1], color="0.6", lw=0.8)
    left.set(xscale="log", yscale="log", xlabel="risk of RRTConnect's path", ylabel="risk")
    left.set_ylim(floor / 1.5, 1.2)
    left.text(0.012, floor * 1.1, "no world collides", fontsize=8, color="0.4")
    left.legend(fontsize=7, loc="upper left")
    right.set(yscale="log", xlabel="processor time, s", ylabel="mean risk of the best path so far")
    right.set_title("before shortening", fontsize=9)
    with replacing(file) as temporary:
        figure.savefig(temporary, dpi=130, format="png")
    plt.close(figure)


def _mean(curves: list[np.ndarray]) -> np.ndarray:
    """Mean over the problems; NaN before each of them has a path."""
    values = np.array(curves)
    return values.mean(axis=0)


def _steps(history: list, grid: np.ndarray) -> np.ndarray:
    times = np.array([when for when, _ in history])
    risks = np.array([risk for _, risk in history])
    index = np.searchsorted(times, grid, side="right") - 1
    return np.where(index >= 0, risks[np.maximum(index, 0)], np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--problems", type=int, default=4, help="per scene")
    parser.add_argument("--output", type=Path, default=Path("docs/results"))
    parser.add_argument("--report", action="store_true", help="of what is answered, without asking")
    options = parser.parse_args()
    rows = answers(options.scenes, options.problems, not options.report)
    table, rates = summary(rows), speed()
    page = text(table, rates, options.scenes)
    print(page)
    write_text(options.output / "objectives.md", page)
    data = {
        "contenders": [asdict(who) for who in CONTENDERS],
        "limits": {"search": SEARCH, "shortening": SHORTENING},
        "judge": JUDGES,
        "table": table,
        "microseconds_per_motion": rates,
        "answers": rows,
    }
    write_text(options.output / "objectives.json", json.dumps(data, indent=1) + "\n")
    picture(rows, options.output / "objectives.png")


if __name__ == "__main__":
    main()
