# SPDX-License-Identifier: BSD-3-Clause
"""Train the learned baseline that the package carries.

    python -m experiments.benchmarks.train_pointsdf [--solids 180] [--meshes 120] [--steps 1200]
        [--output FILE]

Arrangements of solids and of dropped meshes (objects 000 to 359 of those that pybullet brings;
360 to 399 are held out for validation), several views of each, go to build/pointsdf/ in parts
as they are done: started again, it goes on where it stopped. Then one thread trains, prints
what it sees and writes the weights and build/pointsdf/training.{json,png}. The same arguments
on the same machine give the same weights.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.baselines.pointsdf.data import Examples, examples_of
from experiments.baselines.pointsdf.shapes import training_scene
from experiments.baselines.pointsdf.training import LEVELS, Look, Schedule, mean_iou, train
from experiments.baselines.pointsdf.weights import SHIPPED, save_network
from experiments.protocols import TrueScene
from experiments.tables.scoring import commit
from vprism_plan._files import write_text
from vprism_plan.simulation.scenes import random_camera

ROOT = Path(__file__).resolve().parents[2]
VERSION = 1  # of the examples; raised by hand when generator or sampling change their meaning
FIRST_SEED, HELD_OUT_SEED = 100_000, 190_000
HELD_OUT_OBJECT = 360  # of random-train; from here on objects are for validation
SOLID_VIEWS, MESH_VIEWS = 3, 4
QUERIES, UNIFORM_QUERIES = 512, 1024
MOST_VALIDATED = 160  # examples per validation set
Parts = tuple[Examples | None, Examples | None]  # to learn from, to validate


def solids(seed: int) -> Parts:
    """Examples of one arrangement of solids; above HELD_OUT_SEED for validation."""
    if seed >= HELD_OUT_SEED:
        views = training_scene(seed)
        return None, examples_of(views, seed=seed, queries=UNIFORM_QUERIES, uniform=1.0)
    return examples_of(training_scene(seed, views=SOLID_VIEWS), seed=seed, queries=QUERIES), None


def meshes(seed: int) -> Parts:
    """Examples of one drop of meshes: most objects to learn from, the held out to validate."""
    from experiments.generation import generate

    scene = generate("random-train", seed)
    rng = np.random.default_rng([seed, 0x71E5])
    views: list[TrueScene] = [scene]
    for view in range(1, MESH_VIEWS):
        camera = random_camera(rng)
        seen = scene.render(camera, noise=scene.noise, seed=1000 * seed + view)
        views.append(replace(scene, camera=camera, observation=seen))
    numbers = {k: int(o.name) for k, o in zip(scene.object_ids, scene.objects, strict=True)}
    known = {k for k, number in numbers.items() if number < HELD_OUT_OBJECT}
    return (
        examples_of(views, seed=seed, queries=QUERIES, only=known),
        examples_of(
            views, seed=seed, queries=UNIFORM_QUERIES, uniform=1.0, only=set(numbers) - known
        ),
    )


def settings() -> dict[str, int]:
    """Return what kept examples depend on besides their seed."""
    return {
        "version": VERSION, "solid_views": SOLID_VIEWS, "mesh_views": MESH_VIEWS,
        "queries": QUERIES, "uniform_queries": UNIFORM_QUERIES,
        "held_out_object": HELD_OUT_OBJECT, "held_out_seed": HELD_OUT_SEED,
    }  # fmt: skip


def collected(
    name: str, make: Callable[[int], Parts], seeds: Sequence[int], folder: Path
) -> tuple[list[Examples], list[Examples]]:
    """Make the examples of every seed, or read those of an earlier run with these settings."""
    learn, validate = [], []
    started = time.perf_counter()
    for done, seed in enumerate(seeds, 1):
        marker = folder / f"{name}-{seed}.json"
        files = [folder / f"{name}-{seed}-{use}.npz" for use in ("learn", "validate")]
        asked = json.dumps({"seed": seed, **settings()}) + "\n"
        if not marker.is_file() or marker.read_text(encoding="utf-8") != asked:
            marker.unlink(missing_ok=True)  # half of the new beside it would pass for the old
            for part, file in zip(make(seed), files, strict=True):
                file.unlink(missing_ok=True)
                if part is not None:
                    part.save(file)
            write_text(marker, asked)
        for found, file in zip((learn, validate), files, strict=True):
            if file.is_file():
                found.append(Examples.load(file))
        if done % 20 == 0 or done == len(seeds):
            print(
                f"{name}: {done} of {len(seeds)}, {time.perf_counter() - started:.0f} s", flush=True
            )
    return learn, validate


def thinned(examples: Examples) -> Examples:
    """Return at most MOST_VALIDATED examples, evenly out of all."""
    count = min(len(examples), MOST_VALIDATED)
    return examples.subset(np.arange(count) * len(examples) // count)


def said(look: Look, started: float) -> str:
    """One line of progress."""
    sets = ", ".join(
        f"{name} {' '.join(f'{v:.3f}' for v in iou)}" for name, iou in look.iou.items()
    )
    return (
        f"{look.step:6d}  loss {look.loss:.4f}  IoU {sets}  {time.perf_counter() - started:.0f} s"
    )


def picture(looks: Sequence[Look], file: Path) -> None:
    """Write the curves of loss and validation IoU."""
    from vprism_plan.viz._figures import new_figure, save_figure

    figure = new_figure(9.0, 3.5)
    left, right = figure.subplots(1, 2)
    steps = [look.step for look in looks]
    left.plot(steps, [look.loss for look in looks], color="#205080")
    left.set(xlabel="step", ylabel="cross entropy per query", title="training")
    for name in looks[0].iou:
        for level, style in ((0.3, "-"), (0.5, "--")):
            values = [look.iou[name][LEVELS.index(level)] for look in looks]
            right.plot(steps, values, style, label=f"{name}, level {level}")
    right.set(xlabel="step", ylabel="mean IoU", title="objects held out")
    right.legend()
    save_figure(figure, file)


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--solids", type=int, default=180, help="arrangements of solids")
    parser.add_argument("--meshes", type=int, default=120, help="drops of meshes; 0: none")
    parser.add_argument(
        "--validation", type=int, default=20, help="held-out arrangements of solids"
    )
    parser.add_argument("--steps", type=int, default=Schedule.steps)
    parser.add_argument("--output", type=Path, default=SHIPPED)
    parser.add_argument("--data", type=Path, default=ROOT / "build" / "pointsdf")
    args = parser.parse_args()

    first = range(FIRST_SEED, FIRST_SEED + args.solids)
    learn, _ = collected("solids", solids, first, args.data)
    held = range(HELD_OUT_SEED, HELD_OUT_SEED + args.validation)
    validation = {"solids": Examples.joined(collected("solids", solids, held, args.data)[1])}
    if args.meshes:
        drops = range(FIRST_SEED, FIRST_SEED + args.meshes)
        more, unseen = collected("meshes", meshes, drops, args.data)
        learn += more
        validation["meshes"] = Examples.joined(unseen)
    validation = {name: thinned(part) for name, part in validation.items()}
    examples = Examples.joined(learn)
    sizes = {name: len(part) for name, part in validation.items()}
    print(f"{len(examples)} examples to learn from, validation {sizes}", flush=True)

    schedule, started = Schedule(steps=args.steps), time.perf_counter()
    model, looks = train(
        examples,
        validation,
        schedule=schedule,
        report=lambda look: print(said(look, started), flush=True),
    )
    best = max(looks, key=lambda look: look.score)
    final = {name: mean_iou(model, found) for name, found in validation.items()}
    print(f"kept: {said(replace(best, iou=final), started)} (calibrated, levels {LEVELS})")
    history: dict[str, Any] = {
        "data": {
            "solids": [first.start, first.stop], "meshes": [FIRST_SEED, FIRST_SEED + args.meshes],
            "objects": f"random-train 000 to {HELD_OUT_OBJECT - 1}", "examples": len(examples),
            "validation": sizes,
        },
        "schedule": asdict(schedule),
        "kept": asdict(replace(best, iou=final)),
        "levels": list(LEVELS),
        "commit": commit(),
    }  # fmt: skip
    save_network(model, args.output, history)
    full = {**history, "looks": [asdict(look) for look in looks]}
    write_text(args.data / "training.json", json.dumps(full, indent=1) + "\n")
    picture(looks, args.data / "training.png")
    size = args.output.stat().st_size / 1e6
    print(f"{args.output}: {size:.2f} MB, {sum(p.numel() for p in model.parameters())} weights")


if __name__ == "__main__":
    main()
