# SPDX-License-Identifier: BSD-3-Clause
"""Where the objects of generated scenes come from.

Every source draws a shape of household size: its largest extent is 6 to 22 cm.

- `analytic`: boxes, cylinders, cups, balls and capsules as meshes of 64 segments; needs
  no files.
- `ycb`: a folder of the YCB set's meshes (metres), at 0.8 to 1.2 times their size.
- `random`, `random-train`: the procedural objects that the package pybullet carries,
  400 to 699 for evaluation and 000 to 399 for training and tuning. Their own size means
  little, so the largest extent is drawn: 7 to 20 cm.
- `folder`: any folder of meshes; the largest extent is drawn as well, whatever the unit.
"""

import os
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np

from experiments.generation.shapes import MESH_SUFFIXES, Shape, read_shape, shape_of
from vprism_plan.errors import ConfigError, MissingDependencyError
from vprism_plan.simulation.scenes import random_solid

SETS = ("analytic", "ycb", "random")  # the sets of the tables
KINDS = (*SETS, "random-train", "folder")
YCB_VARIABLE = "VPRISM_PLAN_YCB"
SMALLEST, LARGEST = 0.06, 0.22  # metres, of the largest extent of any object
_DRAWN_EXTENT = (0.07, 0.20)  # metres, where a mesh's own size means nothing
_RESCALE = (0.8, 1.2)  # where it does
_THINNEST = 0.01  # metres; a thinner object drowns in the sensor's noise
_EMPTIEST = 0.1  # share of the hull that an object must fill; below are bundles of wires
_TRIES = 100  # draws before a source gives up on finding a usable mesh
_RANDOM_OBJECTS = {"random": range(400, 700), "random-train": range(400)}
_UNUSABLE = frozenset({168})  # of the random objects: corners that are not numbers


class Source(Protocol):
    """Anything that draws objects."""

    def draw(self, rng: np.random.Generator) -> Shape:
        """Return one shape, scaled, in its own frame."""


class AnalyticSource:
    """Solids of `random_solid`, which come in household sizes."""

    def draw(self, rng: np.random.Generator) -> Shape:
        """Return a random solid's mesh, at rest orientation, in its own frame."""
        for _ in range(_TRIES):
            solid = replace(random_solid(rng), pose=np.eye(4))
            shape = shape_of(solid.mesh(), solid.kind).scaled(1.0)
            if SMALLEST <= shape.extents.max() <= LARGEST:
                return shape
        raise ConfigError(f"no analytic solid of household size in {_TRIES} draws")


@dataclass(frozen=True)
class FileSource:
    """Mesh files, each as likely as the others.

    With `true_size` they keep their size up to a factor of 0.8 to 1.2; otherwise the
    largest extent is drawn.
    """

    files: tuple[Path, ...]
    true_size: bool = False

    def draw(self, rng: np.random.Generator) -> Shape:
        """Return one of the meshes at a random scale.

        Meshes that would be thinner than 1 cm, or that fill less than a tenth of
        their hull, are drawn again.

        Raises:
            ConfigError: a file is no usable mesh, or none of 100 draws was fit.
        """
        for _ in range(_TRIES):
            path = self.files[int(rng.integers(len(self.files)))]
            shape = read_shape(path)
            extents = shape.extents
            factor = self._factor(float(extents.max()), rng)
            if extents.min() * factor >= _THINNEST and shape.fill >= _EMPTIEST:
                return replace(shape.scaled(factor), name=path.stem)
        raise ConfigError(
            f"none of {_TRIES} draws from {self.files[0].parent} was {_THINNEST * 100:g} cm "
            f"thick and filled {_EMPTIEST:.0%} of its hull; give solid meshes"
        )

    def _factor(self, extent: float, rng: np.random.Generator) -> float:
        if not self.true_size:
            return float(rng.uniform(*_DRAWN_EXTENT)) / extent
        low, high = np.clip(np.array(_RESCALE), SMALLEST / extent, LARGEST / extent)
        return float(rng.uniform(low, high))


def source(kind: str, data: Path | None = None) -> Source:
    """Return the source of a set.

    Args:
        kind: one of `KINDS`.
        data: folder of meshes; required for "folder", optional for "ycb" (default:
            $VPRISM_PLAN_YCB, or ../shared/data/ycb beside the checkout), not used by
            the others.

    Raises:
        ConfigError: an unknown kind, or a folder that is missing or holds no mesh.
        MissingDependencyError: pybullet's meshes are not installed.
    """
    if kind == "analytic":
        return AnalyticSource()
    if kind == "ycb":
        return FileSource(meshes_in(_ycb_folder() if data is None else data), true_size=True)
    if kind in _RANDOM_OBJECTS:
        return FileSource(_random_objects(kind))
    if kind == "folder":
        if data is None:
            raise ConfigError("the source 'folder' needs the folder: give data")
        return FileSource(meshes_in(data))
    raise ConfigError(f"source {kind!r} is unknown; valid: {', '.join(KINDS)}")


def chosen_folder(kind: str, data: Path | None = None) -> Path | None:
    """Return the folder of meshes, absolute, that somebody chose for a set.

    None where there is no choice (sets that take no folder) or none was made: the YCB meshes
    are at their usual place beside the checkout. Takes what `source` takes.
    """
    if kind not in ("ycb", "folder"):
        return None
    named = os.environ.get(YCB_VARIABLE) if kind == "ycb" and data is None else data
    if not named:
        return None
    folder = Path(named).resolve()
    return None if kind == "ycb" and folder == _beside().resolve() else folder


def _beside() -> Path:
    """Where the YCB meshes are, unless somebody says otherwise."""
    return Path(__file__).resolve().parents[3] / "shared" / "data" / "ycb"


def _ycb_folder() -> Path:
    named = os.environ.get(YCB_VARIABLE)
    if named:
        return Path(named)
    beside = _beside()
    if not beside.is_dir():
        raise ConfigError(
            f"the YCB meshes are not at {beside}; set {YCB_VARIABLE} to their folder, or give data"
        )
    return beside


def meshes_in(folder: Path) -> tuple[Path, ...]:
    """Return every mesh in a folder and those below, sorted; ConfigError if there is none."""
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; give one that holds meshes")
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in MESH_SUFFIXES)
    if not found:
        raise ConfigError(f"{folder} holds no mesh ({', '.join(MESH_SUFFIXES)})")
    return tuple(found)


def _random_objects(kind: str) -> tuple[Path, ...]:
    spec = find_spec("pybullet_data")
    if spec is None or not spec.submodule_search_locations:
        raise MissingDependencyError(
            f"the objects of {kind!r} come with pybullet: pip install 'vprism_plan[experiments]'"
        )
    folder = Path(spec.submodule_search_locations[0]) / "random_urdfs"
    numbers = (number for number in _RANDOM_OBJECTS[kind] if number not in _UNUSABLE)
    return tuple(folder / f"{number:03d}" / f"{number:03d}.obj" for number in numbers)
