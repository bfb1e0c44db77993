# SPDX-License-Identifier: BSD-3-Clause
"""Who is compared, by which rules."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from inspect import signature
from typing import Any

from experiments.baselines import METHODS
from experiments.stored import Stored
from experiments.tables.scoring import method_question
from vprism_plan.collision import CheckerConfig
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig
from vprism_plan.planning import plan
from vprism_plan.world import WorldConfig
from vprism_plan.world.config import OccludedPolicy

STRAYS = 0.03  # share of neighbours below which a point is a flying pixel, as in the map
LONE = 0.03  # the same of points without a label: `WorldConfig.lone_share` for every contender


@dataclass(frozen=True)
class Contender(Stored):
    """One row of the benchmark.

    Attributes:
        key: short name.
        label: name in tables and pictures.
        line: contenders of one line differ in one parameter only.
        map: "vprism", "sgd", "points", "octomap", "pointsdf", "network" or "truth".
        occluded: what a world of ours, or of the point estimate, does with occluded space;
            of OctoMap: whether unknown voxels in the image are obstacles.
        bounds: (margin in metres, bound on the collision probability or None) to plan with.
            Of several, each gets an equal share of the time limit, and the first with which
            the query succeeds makes the path.
        meshes: whether FCL judges extracted meshes.
        resolution: of a world of ours, metres.
        step: for FCL, motion between two configurations of an edge, metres.
        defaults: whether world, checker and planner are whatever the package makes of a map
            when nothing else is said; of the fields above only `map` counts then.
    """

    key: str
    label: str
    line: str
    map: str
    occluded: OccludedPolicy = "free"
    bounds: tuple[tuple[float, float | None], ...] = ((0.0, None),)
    meshes: bool = False
    resolution: float = 0.01
    step: float = 0.005
    defaults: bool = False

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Contender":
        """Rebuild from `to_dict`, or from `question`."""
        return super().from_dict({"label": data["key"], "line": data["key"], **data})

    def question(self) -> dict[str, Any]:
        """Return what its answers depend on: all but how it is called in tables."""
        data = self.to_dict()
        del data["label"], data["line"]
        return data

    @property
    def posterior(self) -> bool:
        """Whether its checker can say how probable a collision of the bare robot is."""
        return self.map == "vprism" and not self.meshes and self.bounds[-1][0] == 0.0


def _ours() -> Iterable[Contender]:
    """Level sets with margins and bounds on risk, by what occluded space is taken for."""
    policies: tuple[tuple[OccludedPolicy, str, str], ...] = (
        ("occupied", "all", "hidden: obstacle"),
        ("posterior", "beyond", "hidden: obstacle beyond support"),
        ("free", "", "hidden: the map decides"),
    )
    margins = {"occupied": (0,), "posterior": (0, 10), "free": (0, 5, 10, 20, 30)}
    risks = {"occupied": BOUNDS, "posterior": BOUNDS, "free": (0.01, *BOUNDS, 0.5)}
    for policy, short, words in policies:
        head = f"ours-{short}-" if short else "ours-"
        for mm in margins[policy]:
            yield Contender(
                f"{head}m{mm}", f"{mm} mm", f"ours, margin ({words})", "vprism", policy,
                ((mm / 1000.0, None),),
            )  # fmt: skip
        for risk in risks[policy]:
            yield Contender(
                f"{head}r{round(100 * risk):02d}", f"risk {risk:g}", f"ours, risk ({words})",
                "vprism", policy, ((0.0, risk),),
            )  # fmt: skip
    for mm in (0, 5, 10):
        yield Contender(
            f"ours-dense-m{mm}", f"{mm} mm", "ours, margin (5 mm grid)", "vprism",
            bounds=((mm / 1000.0, None),), resolution=0.005,
        )  # fmt: skip
    steps = tuple((margin, None) for margin in _LADDER)
    for short, words, resolution in (("", "", 0.01), ("dense-", " (5 mm grid)", 0.005)):
        name = f"ours, widest margin that works{words}"
        yield Contender(
            f"ours-{short}widest", name, name, "vprism", bounds=steps, resolution=resolution
        )


BOUNDS = (0.02, 0.05, 0.1, 0.2)  # on the collision probability, of every policy
_LADDER = (0.02, 0.01, 0.005, 0.0)  # metres
CONTENDERS: dict[str, Contender] = {
    entry.key: entry
    for entry in (
        Contender("truth", "the truth itself", "truth", "truth"),
        *_ours(),
        Contender("fcl", "plain", "meshes with FCL", "vprism", meshes=True),
        Contender(
            "fcl-m10", "links padded by 10 mm", "meshes with FCL", "vprism",
            bounds=((0.01, None),), meshes=True,
        ),
        Contender(
            "fcl-fine", "meshes with FCL, edges every 1 mm", "meshes with FCL, edges every 1 mm",
            "vprism", meshes=True, step=0.001,
        ),
        Contender("points", "point cloud", "points", "points"),
        Contender("octomap-free", "OctoMap, unknown free", "octomap-free", "octomap"),
        Contender(
            "octomap-occupied", "OctoMap, unknown occupied", "octomap-occupied", "octomap",
            "occupied",
        ),
        Contender("sgd", "SGD point estimate", "sgd", "sgd"),
        Contender("default", "ours as it comes", "default", "vprism", defaults=True),
        Contender("pointsdf", "PointSDF", "pointsdf", "pointsdf"),
        Contender("network", "shape network alone", "network", "network"),
    )
}  # fmt: skip

ASKED = (
    "truth", "default",
    *(f"ours-{short}{rule}" for short in ("", "beyond-", "all-")
      for rule in ("m0", *(f"r{round(100 * risk):02d}" for risk in BOUNDS))),
    "ours-widest", "fcl", "fcl-m10", "points", "octomap-free", "octomap-occupied", "sgd",
    "pointsdf", "network",
)  # fmt: skip
# About vetted ends, where refusing is always wrong, these say little that is new.
_ONLY_ASKED = {"ours-r02", "ours-r10", "ours-beyond-r02", "ours-beyond-r10", "ours-beyond-r20",
               "pointsdf", "network"}  # fmt: skip
VETTED = tuple(k for k in CONTENDERS if k not in _ONLY_ASKED and not k.startswith("ours-all-r"))


def contenders(keys: Iterable[str] | None = None) -> tuple[Contender, ...]:
    """Return the contenders of these keys (all if None); ConfigError naming the keys."""
    chosen = tuple(CONTENDERS) if keys is None else tuple(keys)
    for key in chosen:
        if key not in CONTENDERS:
            raise ConfigError(f"there is no checker {key!r}; valid: {', '.join(CONTENDERS)}")
    return tuple(CONTENDERS[key] for key in chosen)


def settings(contender: Contender) -> dict[str, Any]:
    """Return the package's settings that a contender's answers depend on, ready for JSON."""
    own: dict[str, Any] = {
        "checker": asdict(CheckerConfig()),
        "world": asdict(WorldConfig()),
        "lone_share": LONE,
        "stray_share": STRAYS,
    }
    if contender.map in ("vprism", "sgd"):
        own["map"] = asdict(MapConfig())
    if contender.map in METHODS:  # the weights of networks, too
        own["method"] = method_question(contender.map)
    if contender.defaults:
        parameters = signature(plan).parameters.items()
        own["plan"] = {name: repr(parameter.default) for name, parameter in parameters}
    return own


def full_label(contender: Contender) -> str:
    """Return a contender's name where its line does not stand beside it."""
    if contender.line in (contender.label, contender.key):
        return contender.label
    return f"{contender.line}, {contender.label}"
