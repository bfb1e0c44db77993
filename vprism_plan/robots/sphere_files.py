# SPDX-License-Identifier: BSD-3-Clause
"""Robot files (this package's YAML, cuRobo's, XRDF), and collision spheres: theirs, or fitted."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
    file: SphereTable  # what else it says


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
    rest = _from_geometry(model, bare, fit)
    if rest.rows:
        _logger.info("%s leaves out %s; their spheres are fitted", table.source, list(rest.rows))
    everything, sources = known | rest.rows, dict.fromkeys(known, "file") | rest.sources
    held = {name: everything[name] for name in model.links if len(everything.get(name, ()))}
    if not held:
        raise RobotError(f"{table.source} gives no link a sphere; a robot needs at least one")
    return ChosenSpheres(held, {name: sources[name] for name in held}, table.only(model))


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
    return ChosenSpheres(rows, sources, SphereTable("", rows))


# -------------------------------------------------------------------------------------- files
@dataclass(frozen=True)
class SphereTable:
    """What a file or a mapping says of spheres; links that a foreign one leaves out are fitted."""

    source: str  # for messages
    spheres: LinkSpheres  # those that are switched off left out; a link may have none
    padding: dict[str, float] = field(default_factory=dict)  # metres against the world
    foreign: bool = False  # another program's, which may name links that the robot lacks
    buffer: dict[str, float] = field(default_factory=dict)  # metres against other links
    ignored: frozenset[frozenset[str]] | None = None  # pairs of links; None: it does not say
    joints: tuple[str, ...] = ()  # of a configuration; empty: it does not say
    locked: dict[str, float] = field(default_factory=dict)  # the value of other joints
    rest: dict[str, float] = field(default_factory=dict)  # a configuration, by joint
    accelerations: dict[str, float] = field(default_factory=dict)  # limits, by joint
    tool: str | None = None  # the link that reaches poses
    missing: tuple[str, ...] = ()  # what it names of this, and the robot does not have

    def only(self, model: RobotModel) -> SphereTable:
        """The same of what a robot has; the names of the rest are `missing`."""
        joints, links, pairs = model.joint_map, model.links, self.ignored or ()
        missing = {*self.joints, *self.locked, *self.rest} - joints.keys()
        missing |= frozenset({self.tool or model.root}).union(*pairs) - links.keys()
        return replace(
            self,
            ignored=self.ignored and frozenset(pair for pair in pairs if pair <= set(links)),
            joints=tuple(name for name in self.joints if name in model.movable),
            locked={name: v for name, v in self.locked.items() if name in model.actuated},
            rest={name: v for name, v in self.rest.items() if name in model.actuated},
            tool=self.tool if self.tool in links else None,
            missing=tuple(sorted(missing)),
        )


def read_spheres(spheres: str | Path | Mapping[str, Any]) -> SphereTable:
    """Read collision spheres.

    Understood are

    - ``collision_spheres: {link: [{center: [x, y, z], radius: r}, ...]}``, or the inner
      mapping by itself, which ``write_spheres`` writes; beside it, ``padding: {link: metres}``
      against the world and ``self_padding`` against other links;
    - cuRobo's robot files, with ``robot_cfg: kinematics: collision_spheres`` as the name of
      a file beside it or inline, and its files of spheres alone (with a key ``robot``).
      A radius of 0 or below switches a sphere off; ``collision_sphere_buffer`` is padding,
      ``self_collision_buffer`` self-padding. Also read are ``self_collision_ignore``,
      ``lock_joints``, ``ee_link``, and of ``cspace`` the joints, their order, the retracted
      configuration and the acceleration limits;
    - XRDF: the spheres of the geometry that ``collision`` names, radii of 0 or below off;
      ``buffer_distance`` is padding, in ``self_collision`` self-padding. Also read are
      ``ignore``, ``cspace``, ``default_joint_positions`` and the first of ``tool_frames``.

    Padding below 0 would shrink links and is not applied.

    Args:
        spheres: A YAML or XRDF file, or its content as a mapping.

    Raises:
        RobotError: There is no such file, it is none of the above, or a sphere is malformed.
    """
    given = not isinstance(spheres, str | Path)
    path = Path("spheres" if given else str(spheres))
    with reading(path, "a usable file of spheres", RobotError):
        content, source = (spheres, "spheres") if given else (_yaml(path), f"'{path}'")
        return _understood(content, source, path.parent)


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
    named = "collision_spheres" in content and not alone
    own = [content.get(key) if named else None for key in ("padding", "self_padding")]
    for table in own:
        unknown = sorted(set(table) - set(spheres_of)) if isinstance(table, Mapping) else []
        if unknown:
            raise RobotError(f"{source} pads the links {unknown}, to which it gives no spheres")
    padding, buffer = (_padding(table, spheres_of, source) for table in own)
    return SphereTable(source, spheres_of, padding, foreign=alone, buffer=buffer)


def _yaml(path: Path) -> Any:
    import yaml  # type: ignore[import-untyped]

    if not path.is_file():
        raise RobotError(f"no sphere file at '{path}'; give an existing YAML or XRDF file")
    with reading(path, "valid YAML", RobotError, _MOST_BYTES):
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        root = loader.get_single_node()
        if root is not None:
            _check_values(root, {})
            root = loader.construct_document(root)
        return root


def _check_values(node: Any, sizes: dict[int, int]) -> int:
    """Count the values of a YAML node, those that aliases stand for too; refuse more than memory
    holds, and a second list for a link."""
    import yaml

    # Until it is known: what an alias in its own list or mapping stands for has no end.
    sizes[id(node)] = _MOST_VALUES
    parts, problem, mark = [], None, node.start_mark
    if isinstance(node, yaml.ScalarNode):
        if len(node.value) > _LONGEST_VALUE:
            problem = f"a value of more than {_LONGEST_VALUE:,} characters"
    elif isinstance(node, yaml.MappingNode):
        parts, names = [part for pair in node.value for part in pair], set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                problem, mark = "a key is no plain name", key.start_mark
            elif key.value in names:
                problem, mark = f"the key '{key.value}' occurs twice; join the two", key.start_mark
            else:
                names.add(key.value)
    else:
        parts = node.value
    size = 1 + sum(sizes.get(id(part)) or _check_values(part, sizes) for part in parts)
    if size > _MOST_VALUES:
        problem = f"with aliases written out it has more than {_MOST_VALUES:,} values"
    if problem is not None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
    sizes[id(node)] = size
    return size


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
    cspace, of_joint = kinematics.get("cspace") or {}, f"{source} gives joint"
    joints, tool = cspace.get("joint_names") or (), kinematics.get("ee_link")
    locked = finite_values(kinematics.get("lock_joints"), (), of_joint)
    return SphereTable(
        source,
        spheres,
        _padding(kinematics.get("collision_sphere_buffer"), spheres, source),
        foreign=True,
        buffer=_padding(kinematics.get("self_collision_buffer"), spheres, source),
        ignored=_pairs(kinematics.get("self_collision_ignore")),
        joints=tuple(name for name in joints if name not in locked),
        locked=locked,
        rest=finite_values(cspace.get("retract_config"), joints, of_joint),
        accelerations=finite_values(cspace.get("max_acceleration"), joints, of_joint),
        tool=tool and str(tool),
    )


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
    cspace, own = content.get("cspace") or {}, content.get("self_collision") or {}
    joints, tools = cspace.get("joint_names") or (), content.get("tool_frames") or ()
    of_joint = f"{source} gives joint"
    return SphereTable(
        source,
        spheres,
        _padding(section.get("buffer_distance"), spheres, source),
        foreign=True,
        buffer=_padding(own.get("buffer_distance"), spheres, source),
        ignored=_pairs(own.get("ignore")),
        joints=tuple(joints),
        rest=finite_values(content.get("default_joint_positions"), (), of_joint),
        accelerations=finite_values(cspace.get("acceleration_limits"), joints, of_joint),
        tool=str(tools[0]) if tools else None,
    )


def _pairs(entry: Mapping[str, Sequence[str]] | None) -> frozenset[frozenset[str]] | None:
    """Pairs of a mapping: link -> links."""
    if entry is None:
        return None
    return frozenset(frozenset((a, b)) for a, others in entry.items() for b in others if a != b)


def finite_values(entry: Any, names: Sequence[str], what: str) -> dict[str, float]:
    """Value of each joint or link; from a table, one number for all, or one each."""
    if entry is not None and not isinstance(entry, Mapping):
        several = entry if isinstance(entry, list | tuple) else [entry] * len(names)
        entry = dict(zip(names, several, strict=True))
    values = {}
    for name, value in (entry or {}).items():
        try:
            values[str(name)] = float(value)
        except (TypeError, ValueError):
            values[str(name)] = math.nan
        if not math.isfinite(values[str(name)]):
            raise RobotError(f"{what} '{name}' the value {value!r}; give one finite number")
    return values


def _padding(buffer: Any, spheres: LinkSpheres, source: str) -> dict[str, float]:
    grown = finite_values(buffer, tuple(spheres), f"{source} gives the buffer of link")
    return {link: pad for link, pad in grown.items() if pad > 0.0 and len(spheres.get(link, ()))}


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
    self_padding: Mapping[str, float] | None = None,
) -> None:
    """Write spheres as YAML that :func:`read_spheres` reads back bit by bit.

    Args:
        path: The file.
        spheres: Link -> (n, 4) rows (x, y, z, radius), link frame, metres.
        note: Lines for a comment at the top.
        padding: Link -> metres that spheres grow by against the world, not in their radii.
        self_padding: The same against other links.
    """
    import yaml

    content: dict[str, Any] = {
        "collision_spheres": {
            link: [{"center": row[:3], "radius": row[3]} for row in np.asarray(rows).tolist()]
            for link, rows in spheres.items()
        }
    }
    tables = {"padding": padding, "self_padding": self_padding}
    content |= {name: {k: float(v) for k, v in t.items()} for name, t in tables.items() if t}
    lines = [f"# {line}".rstrip() + "\n" for line in note.splitlines()]
    write_text(path, "".join(lines) + yaml.safe_dump(content, sort_keys=False, width=100))
