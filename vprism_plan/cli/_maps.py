# SPDX-License-Identifier: BSD-3-Clause
"""Commands about the map itself: `map`, `mesh` and `export`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan._files import replacing
from vprism_plan.cli._console import Console, staged
from vprism_plan.cli._parsing import Command
from vprism_plan.errors import ObservationError

if TYPE_CHECKING:
    from vprism_plan.mapping import VPrismMap


def fit_views(
    paths: Sequence[Path],
    seed: int,
    console: Console,
    preset: str = "default",
    asked: dict[str, Any] | None = None,
) -> "VPrismMap":
    """Fit a map to views; segment what has no labels, align a single one that has no pose.

    A folder of views stands for all of them; `asked` are options of `load_observation`.

    Raises:
        ObservationError: a view cannot be used, or one of several is unposed.
    """
    from vprism_plan.mapping import MapConfig, fit_map
    from vprism_plan.perception import align_to_table, load_observation, segment_tabletop
    from vprism_plan.perception.readers import views_in

    with console.stage("load"):
        files = [file for path in paths for file in views_in(path) or [path]]
        views = [load_observation(file, **(asked or {})) for file in files]
    for number, obs in enumerate(views):
        if len(views) > 1 and not obs.posed:
            raise ObservationError(
                f"{files[number]} has no camera pose, which each of several views needs: "
                "T_world_camera in camera.json, or pose.txt beside the image"
            )
        if obs.labels is None:
            with console.stage("segment"):
                views[number] = segment_tabletop(obs, seed=seed)
        if not obs.posed:
            with console.stage("align"):
                views[number] = align_to_table(views[number], seed=seed)
    with console.stage("fit"):
        m = fit_map(views, MapConfig.paper() if preset == "paper" else MapConfig(), seed=seed)
    console.warn(m.warnings)
    return m


def asked_of(command: Command) -> dict[str, Any]:
    """Return what was asked of a view, for `fit_views`."""
    return {
        "frame": command.frame,
        "depth": command.depth,
        "at": command.at,
        "background_ids": command.background,
    }


def load(path: Path, console: Console) -> "VPrismMap":
    from vprism_plan.mapping import load_map

    with console.stage("load"):
        return load_map(path)


def describe_map(m: "VPrismMap") -> dict[str, Any]:
    """Return the sizes of a map, and where its objects were seen."""
    seen = [view.points() for view in m.views]
    objects = {}
    for object_id in m.object_ids:
        points = np.concatenate([p[labels == object_id] for p, labels in seen])
        lower, upper = points.min(axis=0), points.max(axis=0)
        objects[str(object_id)] = {"points": len(points), "lower": lower, "upper": upper}
    return {
        "objects": objects,
        "hinge_points": len(m.hinge_points),
        "iterations": len(m.history),
        "bound": float(m.history[-1]) if m.history else None,
        "views": len(m.views),
        "plane": {"normal": m.plane.normal, "offset": m.plane.offset},
    }


def run_map(command: Command, console: Console) -> int:
    """Fit and save; exit code 0."""
    output = command.output
    if output.is_dir():
        raise ObservationError(f"{output} is a folder; --output must name a file")
    m = fit_views(command.input, command.seed, console, command.preset, asked_of(command))
    with console.stage("save"), replacing(output) as temporary:
        m.save(temporary)
    size, segmented = output.stat().st_size, "segment" in console.timings
    payload = {
        "output": output,
        "bytes": size,
        "objects": list(m.object_ids),
        "map": describe_map(m),
        "segmented": segmented,
        "aligned": "align" in console.timings,
        "seed": command.seed,
    }
    how = " (segmented from geometry)" if segmented else ""
    lines = [
        f"{len(m.object_ids)} objects{how}: {', '.join(map(str, m.object_ids))}".rstrip(": "),
        f"{len(m.hinge_points)} hinge points, {len(m.history)} iterations",
        console.time_line(),
        f"wrote {output} ({size / 1e6:.1f} MB)",
    ]
    console.finish(payload, lines)
    return 0


def write_meshes(m: "VPrismMap", folder: Path, level: float, resolution: float) -> dict[int, Any]:
    """Write one PLY per object into `folder`; return the meshes."""
    from vprism_plan.world import extract_meshes

    meshes = extract_meshes(m, level=level, resolution=resolution)
    folder.mkdir(parents=True, exist_ok=True)
    for object_id, mesh in meshes.items():
        mesh.export(folder / f"object_{object_id}.ply")
    return meshes


def run_mesh(command: Command, console: Console) -> int:
    """Write the surfaces; exit code 0, or 1 if no object reaches the level."""
    m = load(command.map, console)
    with staged(command.output, ("object_*.ply",)) as aside, console.stage("mesh"):
        meshes = write_meshes(m, aside, command.level, command.resolution)
    missing = [i for i in m.object_ids if i not in meshes]
    objects, lines = {}, []
    for i, mesh in meshes.items():
        file, count, volume = command.output / f"object_{i}.ply", len(mesh.faces), mesh.volume
        objects[str(i)] = {"file": file, "triangles": count, "volume": float(volume)}
        lines.append(f"{file}: {count} triangles, {1e6 * float(volume):.0f} cm^3")
    if missing:
        lines.append(f"no surface at level {command.level:g}: objects {missing}")
    payload = {
        "output": command.output,
        "objects": objects,
        "without_surface": missing,
    }
    console.finish(payload, lines)
    return 0 if meshes else 1


def run_export(command: Command, console: Console) -> int:
    """Write the world or the trajectory; exit code 0."""
    if command.input.suffix == ".json":
        from vprism_plan.planning.trajectory import read_trajectory, write_trajectory

        names, trajectory = read_trajectory(command.input)
        with console.stage("export"):
            write_trajectory(command.output, names, trajectory, command.frame_id)
    else:
        from vprism_plan.world import World, WorldConfig

        bounds = None if command.bounds is None else np.reshape(command.bounds, (2, 3))
        config = WorldConfig(
            command.resolution, occluded=command.occluded, unobserved=command.unobserved,
            bounds=bounds,
        )  # fmt: skip
        m = load(command.input, console)
        with console.stage("bake"):
            world = World(m, config)
        console.warn(world.warnings)
        with console.stage("export"):
            world.export(command.output, command.frame_id)
    size = command.output.stat().st_size
    payload = {"output": command.output, "bytes": size}
    console.finish(payload, [console.time_line(), f"wrote {command.output} ({size / 1e6:.2f} MB)"])
    return 0
