# SPDX-License-Identifier: BSD-3-Clause
"""What becomes of a planning query: pictures, trajectory, report, a few lines of text."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan.cli._console import Console, dump_json
from vprism_plan.cli._maps import describe_map, time_line, write_meshes
from vprism_plan.cli._staging import PLAN_FILES, staged

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.planning import PlanResult
    from vprism_plan.planning.result import PlanReport
    from vprism_plan.robots import Robot

_PROFILE = 64  # clearances along the path in the report


@dataclass(frozen=True, eq=False)
class Situation:
    """A robot in a world, where it starts and where it is to go.

    `chosen` names what the user left open; `truth` is the signed distance to the real
    objects (N, 3) -> (N,), metres, where it is known: for pictures and the report only.
    """

    checker: "CollisionChecker"
    robot: "Robot"
    start: np.ndarray
    goal: np.ndarray
    chosen: tuple[str, ...] = ()
    truth: Callable[[np.ndarray], np.ndarray] | None = None
    title: str = ""


def report_plan(situation: Situation, result: "PlanResult", output: Path, console: Console) -> int:
    """Write all results to `output`, print the summary; return the exit code."""
    m = situation.checker.world.map
    with staged(output, PLAN_FILES) as aside:
        with console.stage("mesh"):
            meshes = write_meshes(m, aside / "meshes", situation.checker.world.config.level, 0.01)
        m.save(aside / "map.safetensors")
        with console.stage("pictures"):
            _draw(situation, result, meshes, aside)
        payload = _payload(situation, result, meshes, console)
        if result.path is not None:
            payload["trajectory"] = _write_trajectory(situation, result, aside)
            payload["clearance"] = clearance_profile(situation.checker, result.path)
            if situation.truth is not None:
                payload["truth"] = true_distance(situation.robot, result.path, situation.truth)
        payload["sizes"] = {
            str(p.relative_to(aside)): p.stat().st_size
            for p in sorted(aside.rglob("*"))
            if p.is_file()
        }
        (aside / "report.json").write_text(dump_json(payload), encoding="utf-8")
        written = sorted({p.relative_to(aside).parts[0] for p in aside.rglob("*") if p.is_file()})
    payload["output"] = output
    console.finish(payload, _lines(payload, result, console, output, written))
    return 0 if result.solved else 1


def _payload(
    situation: Situation, result: "PlanResult", meshes: dict[int, Any], console: Console
) -> dict[str, Any]:
    checker = situation.checker
    robot, world = situation.robot, checker.world
    explanation = result.explanation
    return {
        "solved": result.solved,
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        "base_pose": robot.base_pose,
        "start": situation.start,
        "goal": situation.goal,
        "chosen_automatically": list(situation.chosen),
        "path": result.path,
        "plan": {"status": result.status, "message": result.message, **_numbers(result.report)},
        "explanation": None if explanation is None else explanation.text(),
        "map": describe_map(world.map),
        "world": {
            "occluded": world.config.occluded,
            "unobserved": world.config.unobserved,
            "level": world.config.level,
            "resolution": world.config.resolution,
            "nodes": list(world.field.distance.shape),
            "margin": checker.config.margin,
            "max_risk": checker.config.max_risk,
        },
        "meshes": {str(i): {"triangles": len(mesh.faces)} for i, mesh in meshes.items()},
        "timings": console.timings,
        "compile_seconds": console.compile_seconds,
        "compiled_kernels": console.compiled,
    }


def _numbers(report: "PlanReport") -> dict[str, Any]:
    """Return the report's fields, JSON-ready."""
    values = {field.name: getattr(report, field.name) for field in fields(report)}
    values["risk"] = None if report.risk is None else report.risk.to_dict()
    values["allowed_contacts"] = [contact.to_dict() for contact in report.allowed_contacts]
    return values


def _write_trajectory(situation: Situation, result: "PlanResult", aside: Path) -> dict[str, Any]:
    from vprism_plan.planning import time_parameterize, write_trajectory

    robot = situation.robot
    assert result.path is not None
    trajectory = time_parameterize(robot, result.path)
    write_trajectory(aside / "trajectory.json", robot, trajectory, frame_id="world")
    return {"duration": trajectory.duration, "points": len(trajectory.times)}


def dense_path(path: np.ndarray, step: float) -> np.ndarray:
    """Return a path with configurations at most `step` apart in every joint, corners kept."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        pieces.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(pieces)


def clearance_profile(checker: "CollisionChecker", path: np.ndarray) -> dict[str, Any]:
    """Return the map's clearance along a path, metres: smallest, mean, and a profile."""
    dense = dense_path(path, 0.01)
    clearance = checker.clearance_batch(dense)
    shown = np.linspace(0, len(dense) - 1, min(_PROFILE, len(dense))).astype(int)
    return {
        "minimum": float(clearance.min()),
        "mean": float(clearance.mean()),
        "samples": len(dense),
        "profile": clearance[shown],
    }


def true_distance(
    robot: "Robot", path: np.ndarray, truth: Callable[[np.ndarray], np.ndarray]
) -> dict[str, Any]:
    """Return the smallest distance of the moving spheres to the real objects, metres.

    Also how far any sphere moves between two samples, which bounds what they can miss.
    """

    moving = ~np.asarray(robot.fixed_links)[np.asarray(robot.sphere_links)]
    dense = dense_path(path, 0.0015)
    best, at, largest_step = np.inf, (0, 0), 0.0
    previous: np.ndarray | None = None
    for begin in range(0, len(dense), 256):
        centers = robot.sphere_centers(dense[begin : begin + 256])[:, moving]
        gap = truth(centers.reshape(-1, 3)).reshape(centers.shape[:2]) - robot.sphere_radii[moving]
        if gap.min() < best:
            best = float(gap.min())
            row, sphere = np.unravel_index(int(gap.argmin()), gap.shape)
            at = (begin + int(row), int(sphere))
        joined = centers if previous is None else np.concatenate([previous, centers])
        if len(joined) > 1:
            moved = np.linalg.norm(np.diff(joined, axis=0), axis=2)
            largest_step = max(largest_step, float(moved.max()))
        previous = centers[-1:]
    link = robot.link_names[int(np.asarray(robot.sphere_links)[moving][at[1]])]
    return {
        "minimum_distance": best,
        "link": link,
        "fraction": at[0] / max(1, len(dense) - 1),
        "samples": len(dense),
        "largest_motion_between_samples": largest_step,
    }


def _draw(situation: Situation, result: "PlanResult", meshes: dict[int, Any], aside: Path) -> None:
    from vprism_plan.viz import map_figure, plan_figure, save_figure, scene_figure

    m = situation.checker.world.map
    view = m.views[0]
    title = situation.title or None
    save_figure(scene_figure(view, title=title), aside / "scene.png")
    save_figure(map_figure(m, truth=situation.truth, title=title), aside / "map.png")
    path = result.path
    if path is None:
        return
    figure = plan_figure(
        meshes,
        situation.robot,
        path,
        table_height=float(m.plane.offset / m.plane.normal[2]),
        title=title,
    )
    save_figure(figure, aside / "plan.png")


def _lines(
    payload: dict[str, Any],
    result: "PlanResult",
    console: Console,
    output: Path,
    written: list[str],
) -> list[str]:
    """At most ten lines; the last one names what was written."""
    m = payload["map"]
    base = np.round(np.asarray(payload["base_pose"])[:3, 3], 3).tolist()
    lines = [
        f"map: {len(m['objects'])} objects, {m['hinge_points']} hinge points, "
        f"{m['iterations']} iterations",
        f"{payload['robot']}: base at {base} m"
        + (f"; chosen: {', '.join(payload['chosen_automatically'])}"
           if payload["chosen_automatically"] else ""),
    ]  # fmt: skip
    if result.solved:
        report = result.report
        how = (
            "continuously certified"
            if report.certified
            else (f"to within {1000 * report.tolerance:.1f} mm of motion")
        )
        lines += [
            f"path: {report.waypoints} waypoints, {report.path_length:.2f} rad, every edge "
            f"verified again ({how})",
            f"clearance to what may be occupied: at least "
            f"{1000 * payload['clearance']['minimum']:.1f} mm along the path",
        ]
        if "truth" in payload:
            lines.append(
                f"distance to the true objects: at least "
                f"{1000 * payload['truth']['minimum_distance']:.1f} mm "
                f"({payload['truth']['link']}; sampled every "
                f"{1000 * payload['truth']['largest_motion_between_samples']:.1f} mm or less)"
            )
        if report.risk is not None:
            lines.append(
                f"risk: {report.risk.text()}; bound {payload['world']['max_risk']:g}, judged by "
                f"draws the search has not seen, tightened {report.risk_levels} times"
            )
        if report.allowed_contacts:
            lines.append(
                "ends touching, as allowed: "
                + ", ".join(f"{c.link} on {c.body}" for c in report.allowed_contacts)
            )
        share = sum(report.shares.get(kind, 0.0) for kind in ("unobserved", "outside"))
        lines.append(
            f"unseen: up to {100 * share:.0f} % of the arm is where no camera looked, which counts "
            f"as {payload['world']['unobserved']}; hidden space counts as "
            f"{payload['world']['occluded']}"
        )
        lines.append(f"trajectory: {payload['trajectory']['duration']:.1f} s")
    else:
        lines.append(f"no safe answer ({result.status}): {result.message}")
    lines += [time_line(console), f"wrote {output}/: {', '.join(written)}"]
    return lines
