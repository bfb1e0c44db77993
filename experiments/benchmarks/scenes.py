# SPDX-License-Identifier: BSD-3-Clause
"""What generated scenes cost and how cluttered they are, and a contact sheet of them.

    python -m experiments.benchmarks.scenes [--scenes 6] [--first-seed 1000]
        [--picture docs/images/scenes.png]

Per set: seconds per scene, how much of each object the others hide, how deep objects
press into each other, how far they move when let go for another two seconds, and points
per second of the questions that experiments ask of the truth.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from experiments.generation import SETS, MeshScene, generate, source
from experiments.generation.dropping import rest_motion
from experiments.generation.shapes import Shape
from vprism_plan.errors import VPrismError
from vprism_plan.viz._figures import new_figure, save_figure

POINTS = 100_000
SHOWN = 2  # scenes per set on the contact sheet
MIDDLE = np.s_[90:390, 120:520]  # of the images, where the objects are


def hidden_shares(scene: MeshScene) -> list[float]:
    """Share of each object's outline that others hide."""
    shares = []
    for label, body in zip(scene.object_ids, scene.objects, strict=True):
        alone = MeshScene((body,), scene.camera, scene.observation).render(scene.camera)
        outline = (alone.labels > 0).sum()
        shares.append(1.0 - (scene.observation.labels == label).sum() / outline)
    return shares


def overlap(scene: MeshScene) -> float:
    """Depth to which corners of objects lie inside other objects or the table, metres."""
    worst = 0.0
    for index, body in enumerate(scene.objects):
        others = scene.objects[:index] + scene.objects[index + 1 :]
        corners = body.vertices @ body.pose[:3, :3].T + body.pose[:3, 3]
        rest = MeshScene(others, scene.camera, scene.observation)
        worst = min(worst, float(rest.signed_distance(corners, table=True).min()))
    return -worst


def motion(scene: MeshScene) -> float:
    """How far anything moves within two more seconds, metres."""
    shapes = [
        Shape(b.name, b.vertices, b.faces, ConvexHull(b.vertices).vertices) for b in scene.objects
    ]
    return rest_motion(shapes, np.array([b.pose for b in scene.objects]), 2.0)[0]


def rate(question, points: np.ndarray) -> float:
    start = time.process_time()
    question(points)
    return len(points) / (time.process_time() - start)


def measure(kind: str, seeds: range) -> list[MeshScene]:
    generate(kind, 10_000)  # imports are not a scene's cost
    wall, cpu = time.perf_counter(), time.process_time()
    scenes = [generate(kind, seed) for seed in seeds]
    wall = (time.perf_counter() - wall) / len(scenes)
    cpu = (time.process_time() - cpu) / len(scenes)
    hidden = np.concatenate([hidden_shares(scene) for scene in scenes])
    count = np.mean([len(scene.objects) for scene in scenes])
    print(
        f"{kind}: {wall:.2f} s per scene ({cpu:.2f} s of one core), {count:.1f} objects; hidden "
        f"by others {hidden.mean():.0%} on average, {(hidden > 0.5).mean():.0%} of the objects "
        f"by more than half, {(hidden > 0.99).mean():.0%} wholly"
    )
    print(
        f"  overlap at most {1000 * max(map(overlap, scenes)):.2f} mm, motion within two more "
        f"seconds at most {1000 * max(map(motion, scenes)):.2f} mm"
    )
    crowded = max(scenes, key=lambda scene: len(scene.objects))
    points = np.random.default_rng(0).uniform([-0.25, -0.25, 0], [0.25, 0.25, 0.25], (POINTS, 3))
    crowded.object_of(points[:10])  # builds the search trees
    inside, distance = rate(crowded.object_of, points), rate(crowded.signed_distance, points)
    print(
        f"  {len(crowded.objects)} objects, {sum(len(b.faces) for b in crowded.objects)} faces: "
        f"object_of {inside / 1000:.0f}k points per second, signed_distance {distance / 1000:.0f}k",
        flush=True,
    )
    return scenes


def contact_sheet(scenes: dict[str, list[MeshScene]], path: Path) -> None:
    figure = new_figure(12.0, 2.45 * len(scenes))
    axes = figure.subplots(len(scenes), 2 * SHOWN, squeeze=False)
    for row, (kind, shown) in zip(axes, scenes.items(), strict=True):
        for index, scene in enumerate(shown[:SHOWN]):
            seen = scene.observation
            color, depth = row[2 * index], row[2 * index + 1]
            color.imshow(seen.color[MIDDLE])
            color.set_title(f"{kind}, seed {scene.seed}: {len(scene.objects)} objects", fontsize=9)
            on_objects = seen.depth[(seen.labels > 0) & (seen.depth > 0)]
            near, far = np.quantile(on_objects, (0.02, 0.98))
            shown_depth = np.ma.masked_equal(seen.depth[MIDDLE], 0.0)
            depth.imshow(shown_depth, vmin=near - 0.05, vmax=far + 0.05, cmap="viridis")
            depth.set_facecolor("black")
            depth.set_title("depth with noise", fontsize=9)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    shown: dict[str, list[MeshScene]] = {}
    for kind in SETS:
        try:
            source(kind)
        except VPrismError as error:
            print(f"{kind}: left out, {error}")
            continue
        shown[kind] = measure(kind, range(args.first_seed, args.first_seed + args.scenes))
    if args.picture is not None:
        contact_sheet(shown, args.picture)


if __name__ == "__main__":
    main()
