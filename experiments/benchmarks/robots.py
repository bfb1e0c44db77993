# SPDX-License-Identifier: BSD-3-Clause
"""What published robots become: how many spheres, how far they stand out, what it costs.

    python -m experiments.benchmarks.robots [--output docs/results] [--robots panda ur5 ...]

Times are CPU seconds of one thread, which other programs do not lengthen. Needs the packages
example-robot-data and pybullet; robots whose package is not installed are left out.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "robots"))

from real_robots import ROBOTS, found  # noqa: E402

from vprism_plan._files import write_text  # noqa: E402
from vprism_plan.robots import Robot  # noqa: E402

SHOWN = ("panda", "ur5", "kuka_iiwa", "tiago")


def measured(name: str, files) -> tuple[dict, Robot]:
    options = {"srdf": files.srdf, "group": files.group, "joints": files.joints}
    clock = time.process_time()
    robot = Robot.from_urdf(files.urdf, **options, spheres="fit")
    fitted = time.process_time() - clock
    bare = {link: [] for link in (*robot.geometry, *robot.meshes_as_read)}
    rows = {
        k: [{"center": r[:3], "radius": r[3]} for r in v] for k, v in robot.link_spheres.items()
    }
    clock = time.process_time()
    Robot.from_urdf(files.urdf, **options, spheres=bare | rows)
    loaded = time.process_time() - clock
    clock = time.process_time()
    report = robot.report()
    proved = time.process_time() - clock
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, size=(500, robot.dof))
    from vprism_plan.robots.pairs import pair_gaps

    touching = (pair_gaps(robot.arrays, q, robot.collision_pairs) < 0.0).any(axis=1)
    moving = [link for link in report.links if link.spheres]
    worst = max(moving, key=lambda link: link.protrusion or 0.0)
    return {
        "robot": name,
        "dof": robot.dof,
        "links": len(moving),
        "spheres": report.spheres,
        "enclosed": report.enclosed,
        "protrusion": report.protrusion,
        "worst_link": worst.link,
        "median_protrusion": float(np.median([link.protrusion or 0.0 for link in moving])),
        "mean_protrusion": float(np.mean([link.mean_protrusion or 0.0 for link in moving])),
        "tested_pairs": report.tested_pairs,
        "self_colliding": float(touching.mean()),
        "srdf": files.srdf is not None,
        "seconds_fit": fitted - loaded,
        "seconds_load": loaded,
        "seconds_report": proved,
    }, robot


def table(rows: list[dict]) -> str:
    lines = [
        "| robot | joints | links | spheres | enclosed | stands out: most | median of links | "
        "mean | pairs tested | random poses refused | fit | load with spheres | report |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['robot']} | {row['dof']} | {row['links']} | {row['spheres']} | "
            f"{'proved' if row['enclosed'] else 'NO'} | {1000 * row['protrusion']:.0f} mm "
            f"({row['worst_link']}) | {1000 * row['median_protrusion']:.0f} mm | "
            f"{1000 * row['mean_protrusion']:.0f} mm | {row['tested_pairs']}"
            f"{'' if row['srdf'] else ' (generated)'} | {100 * row['self_colliding']:.0f} % | "
            f"{row['seconds_fit']:.1f} s | {row['seconds_load']:.1f} s | "
            f"{row['seconds_report']:.1f} s |"
        )
    return "\n".join(lines)


TEXT = """# Robots as they are published

`python -m experiments.benchmarks.robots` reads each URDF unmodified, fits spheres with the default
settings (3 cm of tolerance, a share of 0.15 of a link's size, 12 spheres a link and more for
links above 35 cm) and compares them with the collision geometry.

{table}

"Enclosed" is proved for every triangle of every link, not sampled. "Stands out" is measured on
200 points of each sphere: the largest figure of the robot and the link it belongs to, the median
over links of their largest, and the mean over links of the mean. "Random poses refused" is the
share of 500 uniform configurations in which tested links' spheres overlap: what the spheres
cost in self-collision, real collisions included. Times are CPU seconds of one thread; "fit" is
paid once if the spheres are written beside the URDF, "report" only by `vprism-plan robot`.
Without an SRDF, "load" includes the generated matrix (10,000 random configurations).

Large boxes (the bases and torsos of PR2 and TIAGo) are what spheres are worst at: they reach
64 spheres and stand out by several centimetres. Their fit is meant for self-collision of the arm;
`SphereFit(max_spheres={{link: n}})` buys more.

![Fitted spheres](robots.png)
"""


def picture(robots: dict[str, Robot], path: Path) -> None:
    import matplotlib.image
    from PIL import Image

    from vprism_plan.viz import robot_figure, save_figure

    images = []
    for name, robot in robots.items():
        part = path.with_name(f".{name}.png")
        save_figure(robot_figure(robot, title=f"{name}: {len(robot.sphere_radii)} spheres"), part)
        images.append((255 * matplotlib.image.imread(part)[..., :3]).astype(np.uint8))
        part.unlink()
    height = max(image.shape[0] for image in images)
    padded = [
        np.pad(i, ((0, height - len(i)), (0, 0), (0, 0)), constant_values=255) for i in images
    ]
    rows = [np.concatenate(padded[k : k + 2], axis=1) for k in range(0, len(padded), 2)]
    width = max(row.shape[1] for row in rows)
    sheet = [
        np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows
    ]
    whole = Image.fromarray(np.concatenate(sheet))
    whole.resize((1700, 1700 * whole.height // whole.width)).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    options = parser.parse_args()
    rows, robots = [], {}
    for name in options.robots:
        files = found(name)
        if files is None:
            print(f"{name}: needs the package {ROBOTS[name].package}")
            continue
        row, robots[name] = measured(name, files)
        rows.append(row)
        print(table([row]).splitlines()[-1], flush=True)
    options.output.mkdir(parents=True, exist_ok=True)
    write_text(options.output / "robots.json", json.dumps(rows, indent=1) + "\n")
    write_text(options.output / "robots.md", TEXT.format(table=table(rows)))
    picture({k: robots[k] for k in SHOWN if k in robots}, options.output / "robots.png")


if __name__ == "__main__":
    main()
