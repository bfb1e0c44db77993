# SPDX-License-Identifier: BSD-3-Clause
"""Collision spheres of links: of a file (this package's YAML, cuRobo's, XRDF), else fitted."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import reading, write_text
from vprism_plan._shapes import Spheres
from vprism_plan.errors import RobotError
from vprism_plan.robots.sphere_fit import SphereFit, enclosing_spheres, fit_spheres
from vprism_plan.robots.surfaces import link_triangles
from vprism_plan.robots.urdf import RobotModel

LinkSpheres = dict[str, np.ndarray]
"""Link name -> (n, 4) rows (x, y, z, radius) in the link's frame, metres."""

# A YAML of 80 spheres has 6 kB and 700 values; these take some seconds to read.
_MOST_BYTES = 2**19
_MOST_VALUES = 100_000
_LONGEST_VALUE = 1000  # characters; a number is read in the square of that
_EXPECTED = "'collision_spheres: {link: [{center: [x, y, z], radius: r}, ...]}'"


FIT = "fit"
# So many tiles are taken as they are; what needs more is fitted, which needs fewer.
_FEW_TILES = 12
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChosenSpheres:
    """The spheres of a robot's links, and where they are from."""

    rows: LinkSpheres  # never empty
    sources: dict[str, str]  # "file", "urdf" (of its own), "tiled" (over its solids) or "fitted"
    padding: dict[str, float] = field(default_factory=dict)  # metres that a file adds to them


def link_spheres(
    model: RobotModel,
    urdf_path: Path,
    spheres: str | Path | Mapping[str, Any] | None,
    fit: SphereFit,
) -> ChosenSpheres:
    """Choose and validate the collision spheres of a robot, see :meth:`Robot.from_urdf`."""
    has = f"links: {list(model.links)}"
    named = set(fit.max_spheres) if isinstance(fit.max_spheres, Mapping) else set()
    if named - model.links.keys():
        raise RobotError(f"max_spheres names the links {sorted(named - model.links.keys())}; {has}")
    if spheres is None:
        beside = urdf_path.with_name(f"{urdf_path.stem}_spheres.yml")
        spheres = beside if beside.is_file() else FIT
    if isinstance(spheres, str) and spheres == FIT:
        chosen = _from_geometry(model, model.links, fit)
        if not chosen.rows:
            remedy = "add <collision> elements, or pass spheres={link: [{center, radius}]}"
            raise RobotError(f"'{urdf_path}': no link has collision geometry; {remedy}")
        return chosen
    table = read_spheres(spheres)
    known = {name: rows for name, rows in table.spheres.items() if name in model.links}
    for link, rows in table.spheres.items():
        if link not in model.links and (len(rows) or not table.foreign):
            raise RobotError(f"{table.source} gives spheres for the unknown link '{link}'; {has}")
    solid = [name for name, link in model.links.items() if link.primitives or link.meshes]
    bare = [name for name in solid if name not in known]
    if bare and not table.foreign:
        raise RobotError(
            f"{table.source} gives no spheres for the links {bare}, which have collision "
            "geometry and would go unchecked; add spheres, or an empty list to leave a link out "
            "on purpose"
        )
    emptied = [name for name, rows in known.items() if not len(rows) and name in solid]
    if emptied and table.foreign:
        odd = "%s leaves the links %s without spheres; they have geometry that is not checked"
        _logger.warning(odd, table.source, emptied)
    rest = _from_geometry(model, bare, fit)
    if rest.rows:
        _logger.info("%s leaves out %s; their spheres are fitted", table.source, list(rest.rows))
    everything, sources = known | rest.rows, dict.fromkeys(known, "file") | rest.sources
    held = {name: everything[name] for name in model.links if len(everything.get(name, ()))}
    if not held:
        raise RobotError(f"{table.source} gives no link a sphere; a robot needs at least one")
    return ChosenSpheres(held, {name: sources[name] for name in held}, table.padding)


def _from_geometry(model: RobotModel, links: Iterable[str], fit: SphereFit) -> ChosenSpheres:
    """Spheres that hold the collision geometry of the URDF."""
    rows: LinkSpheres = {}
    sources: dict[str, str] = {}
    for name in links:
        link = model.links[name]
        own = [solid for solid in link.primitives if solid.kind == "sphere"]
        rest = [solid for solid in link.primitives if solid.kind != "sphere"]
        parts = [enclosing_spheres(solid) for solid in own]
        tiles = [enclosing_spheres(solid) for solid in rest]
        if link.meshes or sum(map(len, tiles)) > _FEW_TILES:
            surface = link_triangles(rest, link.meshes)
            tolerance, most = fit.allowed(surface), fit.most(name, surface)
            parts.append(fit_spheres(surface, tolerance, most))
            sources[name] = "fitted"
        elif tiles:
            parts += tiles
            sources[name] = "tiled"
        elif own:
            sources[name] = "urdf"
        if parts:
            rows[name] = np.vstack(parts)
    return ChosenSpheres(rows, sources)


# -------------------------------------------------------------------------------------- files
@dataclass(frozen=True)
class SphereTable:
    """What a file or a mapping says of spheres; links that a foreign one leaves out are fitted."""

    source: str  # for messages
    spheres: LinkSpheres  # those that are switched off left out; a link may have none
    padding: dict[str, float] = field(default_factory=dict)  # metres against the world
    foreign: bool = False  # another program's, which may name links that the robot lacks


def read_spheres(spheres: str | Path | Mapping[str, Any]) -> SphereTable:
    """Read collision spheres.

    Understood are

    - ``collision_spheres: {link: [{center: [x, y, z], radius: r}, ...]}``, or the inner
      mapping by itself, which ``write_spheres`` writes; beside it, ``padding: {link: metres}``;
    - cuRobo's robot files, with ``robot_cfg: kinematics: collision_spheres`` as the name of
      a file beside it or inline, and its files of spheres alone (with a key ``robot``).
      A radius of 0 or below switches a sphere off; ``collision_sphere_buffer`` is padding;
    - XRDF: the spheres of the geometry that ``collision`` names, radii of 0 or below off;
      its ``buffer_distance`` is padding.

    Padding below 0 would shrink links and is not applied.

    Args:
        spheres: A YAML or XRDF file, or its content as a mapping.

    Raises:
        RobotError: There is no such file, it is none of the above, or a sphere is malformed.
    """
    if not isinstance(spheres, str | Path):
        return _understood(spheres, "spheres", Path())
    path = Path(spheres)
    with reading(path, "a usable file of spheres", RobotError):
        return _understood(_yaml(path), f"'{path}'", path.parent)


def _understood(content: Any, source: str, folder: Path) -> SphereTable:
    """The table that a file's content is; `folder` is where files that it names are."""
    if isinstance(content, Mapping) and content.get("format") == "xrdf":
        return _from_xrdf(content, source)
    kinematics = content
    for key in ("robot_cfg", "kinematics"):
        if isinstance(kinematics, Mapping) and key in kinematics:
            kinematics = kinematics[key]
    if kinematics is not content:
        return _from_curobo(kinematics, source, folder)
    alone = isinstance(content, Mapping) and "robot" in content
    spheres_of = _table(content, source, off=alone)
    padding: dict[str, float] = {}
    if "collision_spheres" in content and not alone:
        own = content.get("padding")
        unknown = sorted(set(own) - set(spheres_of)) if isinstance(own, Mapping) else []
        if unknown:
            raise RobotError(f"{source} pads the links {unknown}, to which it gives no spheres")
        padding = _padding(own, spheres_of, source)
    return SphereTable(source, spheres_of, padding, foreign=alone)


def _yaml(path: Path) -> Any:
    import yaml  # type: ignore[import-untyped]

    if not path.is_file():
        raise RobotError(f"no sphere file at '{path}'; give an existing YAML or XRDF file")
    with reading(path, "valid YAML", RobotError, _MOST_BYTES):
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_loader())


@functools.cache
def _loader() -> Any:
    """YAML's safe loader, without a second list for a link, or aliases that no memory holds."""
    import yaml

    class Loader(yaml.SafeLoader):
        def __init__(self, stream: Any) -> None:
            super().__init__(stream)
            self._values = 0  # so far, with all that aliases stand for
            self._sizes: dict[int, int] = {}

        def compose_node(self, parent: Any, index: Any) -> Any:
            mark, alias = self.peek_event().start_mark, self.check_event(yaml.AliasEvent)
            before = self._values
            node = super().compose_node(parent, index)
            # What an alias in its own list or mapping stands for has no end.
            self._values += self._sizes.get(id(node), _MOST_VALUES + 1) if alias else 1
            problem = None
            if self._values > _MOST_VALUES:
                problem = f"with aliases written out it has more than {_MOST_VALUES:,} values"
            elif isinstance(node, yaml.ScalarNode) and len(node.value) > _LONGEST_VALUE:
                problem = f"a value of more than {_LONGEST_VALUE:,} characters"
            if problem is not None:
                raise yaml.composer.ComposerError(problem=problem, problem_mark=mark)
            if not alias:
                self._sizes[id(node)] = self._values - before
            return node

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            seen = set()
            for key, _ in node.value:
                problem = None
                if not isinstance(key, yaml.ScalarNode):
                    problem = "a key is no plain name"
                elif key.value in seen:
                    problem = f"the key '{key.value}' occurs twice; join the two"
                if problem is not None:
                    mark = key.start_mark
                    raise yaml.constructor.ConstructorError(problem=problem, problem_mark=mark)
                seen.add(key.value)
            return node

    return Loader


def _from_curobo(kinematics: Any, source: str, folder: Path) -> SphereTable:
    entry = kinematics.get("collision_spheres") if isinstance(kinematics, Mapping) else None
    named = source
    if isinstance(entry, str):
        path = folder / entry
        if not path.is_file():
            raise RobotError(
                f"{source} takes its spheres from '{entry}', and there is no file '{path}'; put "
                "it there, or give that file itself"
            )
        entry, named = _yaml(path), f"'{path}'"
    spheres = _table(entry, named, off=True)
    buffer = kinematics.get("collision_sphere_buffer")
    return SphereTable(source, spheres, _padding(buffer, spheres, source), foreign=True)


def _from_xrdf(content: Mapping[str, Any], source: str) -> SphereTable:
    geometries = content.get("geometry")
    if not isinstance(geometries, Mapping) or not geometries:
        raise RobotError(f"{source} is XRDF without a 'geometry' section; it holds no spheres")
    # Version 2 renamed the section.
    section = content.get("collision") or content.get("world_collision") or {}
    name = section.get("geometry") if isinstance(section, Mapping) else None
    if name is None and len(geometries) == 1:
        name = next(iter(geometries))
    chosen = geometries.get(name)
    if not isinstance(chosen, Mapping) or "spheres" not in chosen:
        found = f"the section 'collision' names the geometry {name!r}, which has no spheres"
        raise RobotError(f"{source}: {found}; geometries: {sorted(map(str, geometries))}")
    spheres = _table(chosen["spheres"], source, off=True)
    padding = _padding(section.get("buffer_distance"), spheres, source)
    return SphereTable(source, spheres, padding, foreign=True)


def _padding(buffer: Any, spheres: LinkSpheres, source: str) -> dict[str, float]:
    table = buffer if isinstance(buffer, Mapping) else dict.fromkeys(spheres, buffer or 0.0)
    padding = {}
    for link, value in table.items():
        try:
            grown = float(value)
        except (TypeError, ValueError):
            grown = math.nan
        if not math.isfinite(grown):
            found = f"the buffer of link '{link}' is {value!r}"
            raise RobotError(f"{source}: {found}; it must be metres")
        if grown > 0.0 and len(spheres.get(link, ())):
            padding[str(link)] = grown
    return padding


def _table(content: Any, source: str, off: bool) -> LinkSpheres:
    if isinstance(content, Mapping) and "collision_spheres" in content:
        content = content["collision_spheres"]
    if not isinstance(content, Mapping):
        raise RobotError(f"{source} holds no sphere table; expected {_EXPECTED}")
    return {str(link): _rows(link, entries, source, off) for link, entries in content.items()}


def _rows(link: str, entries: Any, source: str, off: bool) -> Spheres:
    entries = [] if entries is None else entries
    if isinstance(entries, str | Mapping) or not isinstance(entries, Sequence):
        raise RobotError(f"{source}: the spheres of '{link}' are {entries!r}; expected a list")
    rows = np.empty((len(entries), 4))
    for row, entry in zip(rows, entries, strict=True):
        found = f"{source}: a sphere of '{link}' is {entry!r}"
        try:
            x, y, z = entry["center"]
            row[:] = float(x), float(y), float(z), float(entry["radius"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            wanted = "expected {center: [x, y, z], radius: r} in metres"
            raise RobotError(f"{found}; {wanted}") from error
        if not np.isfinite(row).all() or (row[3] <= 0 and not off):
            wanted = "centre and radius must be finite and the radius positive"
            raise RobotError(f"{found}; {wanted}")
    return rows[rows[:, 3] > 0.0]


def write_spheres(
    path: str | Path,
    spheres: Mapping[str, Spheres],
    note: str = "",
    padding: Mapping[str, float] | None = None,
) -> None:
    """Write spheres as YAML that :func:`read_spheres` reads back bit by bit.

    Args:
        path: The file.
        spheres: Link -> (n, 4) rows (x, y, z, radius), link frame, metres.
        note: Lines for a comment at the top.
        padding: Link -> metres that spheres grow by against the world, not in their radii.
    """
    lines = [f"# {line}".rstrip() for line in note.splitlines()]
    lines.append("collision_spheres:")
    for link, rows in spheres.items():
        lines.append(f"  {_key(link)}:" + ("" if len(rows) else " []"))
        for row in rows:
            x, y, z, radius = (_number(float(value)) for value in row)
            lines.append(f"    - {{center: [{x}, {y}, {z}], radius: {radius}}}")
    if padding:
        lines.append("padding:")
        lines += [f"  {_key(link)}: {_number(float(value))}" for link, value in padding.items()]
    write_text(path, "\n".join(lines) + "\n")


def _number(value: float) -> str:
    """Shortest text that gives the same number, with the dot that YAML 1.1 asks for."""
    text = repr(value)
    mantissa, mark, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{mark}{exponent}"


def _key(link: str) -> str:
    """A link's name as a YAML key; quoted where it could be read as something else."""
    plain = link.isidentifier() and link.lower() not in {"y", "n", "yes", "no", "on", "off"}
    return link if plain and link.lower() not in {"true", "false", "null"} else f'"{link}"'
