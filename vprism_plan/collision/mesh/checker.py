# SPDX-License-Identifier: BSD-3-Clause
"""A second opinion by FCL: the surfaces of a world against the solids of a robot.

It judges the same map at the same level for the same robot, but with neither the distance field,
nor the octree that it is traced with, nor the compiled kernels; and what the cameras saw it takes
from the images, so it can contradict the map as well.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool

from vprism_plan._arguments import number
from vprism_plan.collision import explain
from vprism_plan.collision.config import CheckerConfig, contact_rules
from vprism_plan.collision.mesh.comparison import PathFinding, PathOpinion, causes_between
from vprism_plan.collision.mesh.fcl import fcl
from vprism_plan.collision.mesh.queries import Queries
from vprism_plan.collision.mesh.solids import LinkShapes, MeshWorld, PlacedSolids, robot_solids
from vprism_plan.collision.packing import Configuration, Numbers, configuration, configurations
from vprism_plan.collision.reports import Contact, MotionReport
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots import Robot
from vprism_plan.world.grid import Chosen, Values

_MAX_CONFIGURATIONS = 1_000_000


class MeshChecker(explain.Checker):
    """Checks a robot's solids against extracted meshes, half-spaces and known geometry.

    What it judges: every object's surface {P(occupied) >= level} as a closed mesh, the support
    surface and known half-spaces (by formula), known primitives and meshes, self-collision of the
    pairs the robot tests, and joint limits; and, by the images alone, every observed point off the
    support surface (a ball of half its pixel's width) and, as the world's policies say, hidden
    space. Of hidden space it asks one point per 3 cm cube of the solids' surfaces, so a shadow
    narrower than that can be missed.

    The robot is what the URDF has, scaled if the robot was scaled, whatever its spheres are. Its
    padding is a distance to keep from the world, beside `config.margin`.

    FCL's meshes are hollow. A solid that no surface cuts lies wholly on one side, and the map's
    level set at one of its points says which (for known meshes: the winding number). Links that no
    joint moves are not checked against the world: they stand on it. Touching counts as collision.
    FCL's own tolerance is about 1e-5 m.

    It answers the questions of `CollisionChecker` by the same names and can be given to `plan` in
    its place, some hundred times slower, with edges checked at discrete configurations. Not safe to
    share between threads: shapes are moved while they are asked about.

    Args:
        world: what to avoid.
        robot: whose configurations are asked about.
        config: margins and allowed contacts. `max_risk` is not judged (nothing is drawn here), and
            `min_motion` says nothing of what is sampled by `step`.
        links: "geometry": the URDF's meshes, boxes, cylinders and spheres, or `link_meshes`, and
            the collision spheres of links that have neither (or whose meshes are missing, or in
            more than 20 pieces). "spheres": the collision spheres of every link.
        link_meshes: link -> `trimesh.Trimesh` in the link's frame, metres, in place of its
            primitives.
        resolution: edge of the objects' marching cubes, metres. None: the lattice of the world's
            distance field (a quarter of its resolution), on which no mesh reaches beyond what the
            field encloses. A coarser mesh is made sooner, and may.
        step: motion, metres, that no point of the robot exceeds between two configurations of an
            edge: a collision may hide in at most half of that.
        seen: False leaves observed points and hidden space out: surfaces alone.

    Raises:
        MissingDependencyError: python-fcl is not installed.
        ConfigError: an option is out of range, or names an unknown object.
        RobotError: an option names an unknown link, or a mesh cannot be used.
    """

    def __init__(
        self,
        world: Any,
        robot: Robot,
        config: CheckerConfig | None = None,
        *,
        links: LinkShapes = "geometry",
        link_meshes: Mapping[str, Any] | None = None,
        resolution: float | None = None,
        step: float = 0.005,
        seen: bool = True,
    ) -> None:
        fcl()
        number("step", step, 1e-5, unit="metres")
        self._made: Callable[[], MeshChecker] = partial(
            MeshChecker, world, robot, config, links=links, link_meshes=link_meshes,
            resolution=resolution, step=step, seen=seen,
        )  # fmt: skip
        if hasattr(world, "for_base"):
            world = world.for_base(robot.base_pose[:3, 3])
        self.world = world
        self.robot = robot
        self.config = CheckerConfig() if config is None else config
        self.links = links
        self.step = float(step)
        self.solids = robot_solids(robot, links, link_meshes)
        self.surfaces = MeshWorld(world, resolution)
        self.placed = PlacedSolids(robot, self.solids)
        rules = self._allowed_classes()
        self._queries = Queries(world, self.placed, self.surfaces, rules, self.config, seen)

    def __reduce__(self) -> Any:
        """A copy is made anew: FCL's objects cannot be copied."""
        return self._made, ()

    @classmethod
    def like(cls, checker: Any, **options: Any) -> "MeshChecker":
        """Make the second opinion on a `CollisionChecker`: its world, robot, margins and rules.

        What its edges may miss (`config.tolerance`) is taken off the margins: paths are shaved down
        to them.

        Args:
            checker: a `CollisionChecker`.
            **options: as for `MeshChecker`.
        """
        config = checker.config
        margins = {
            name: max(0.0, getattr(config, name) - config.tolerance)
            for name in ("margin", "self_margin")
        }
        options.setdefault("config", replace(config, **margins))
        return cls(checker.world, checker.robot, **options)

    def _allowed_classes(self) -> Bool[np.ndarray, "links classes"]:
        """Which link may touch which class of the map; column 0, all else, is never allowed."""
        object_ids = list(self.world.map.object_ids)
        rules, index = contact_rules(self.robot, self.config.allowed_contacts)
        unknown = sorted(set().union(*rules) - set(object_ids))
        if unknown:
            raise ConfigError(
                f"allowed_contacts names object {unknown[0]}; the map has {object_ids}"
            )
        table = np.array([[False, *(i in rule for i in object_ids)] for rule in rules])
        return np.asarray(table[index])

    # --- configurations ----------------------------------------------------------

    def is_valid_buffer(self, q: Configuration) -> bool:
        """`is_valid` without looking at the shape: every solid keeps its distances."""
        if explain.limit_contacts(self.robot, q):
            return False
        self.placed.place(q)
        return not self._queries.collides()

    def is_valid_batch(self, Q: Numbers) -> Chosen:
        """Return `is_valid` for each row of Q."""
        return np.array([*map(self.is_valid_buffer, configurations(self.robot, Q))], dtype=bool)

    def clearance(self, q: Numbers) -> float:
        """Return the distance from the moving links to the nearest surface, metres.

        At most 0 exactly when a moving link touches the world. The margin is not subtracted,
        padding is; self-collision, joint limits and what `allowed_contacts` permits do not enter.
        inf if there is nothing.

        Apart, the figure is FCL's distance, exact for what is compared; of hidden space only that a
        link is in it is known (0). In touch it is what FCL can say: exact depth for half-spaces,
        for spheres against anything, and between primitives; 0 for a box, cylinder or mesh that
        crosses a mesh's surface (FCL has no depth for that); minus the gap to the surface for one
        wholly inside. RobotError if q is not finite.
        """
        self.placed.place(self.robot.check_configuration(q))
        return self._queries.clearance()

    def clearance_batch(self, Q: Numbers) -> Values:
        """Return `clearance` for each row of Q, metres."""
        return np.array([*map(self.clearance, configurations(self.robot, Q))], dtype=np.float64)

    def self_clearance_batch(self, Q: Numbers) -> Values:
        """Return the smallest gap between links that may collide, for each row of Q, metres."""
        found = []
        for q in configurations(self.robot, Q, finite=True):
            self.placed.place(q)
            found.append(self._queries.self_clearance())
        return np.array(found, dtype=np.float64)

    def contacts(self, q: Numbers) -> tuple[Contact, ...]:
        """Return every reason to refuse q: the deepest contact of each link and body.

        Depths are exact where those of `clearance` are. Where a box, cylinder or mesh crosses a
        mesh's surface, the depth is FCL's figure for the deepest triangle: how far the solid
        reaches through it, not the way out. Normals of meshes are those of the triangle.

        Returns:
            Deepest first; empty exactly if `is_valid(q)`. `sphere` is -1 for solids.
        """
        q = configuration(self.robot, q)
        reasons = explain.limit_contacts(self.robot, q)
        if np.isfinite(q).all():
            self.placed.place(q)
            reasons += self._queries.contacts()
        return tuple(explain.by_depth(reasons))

    def link_distance(self, q: Numbers, link: str, body: str) -> float:
        """Return the distance from one link to one body, metres, as `clearance` states it.

        Args:
            q: configuration.
            link: one of `robot.link_names`, or RobotError.
            body: "object:3", "known:NAME", a half-space, or another link; inf for what has no
                surface here ("occluded", an object left out of the meshes, ...).
        """
        self.placed.place(self.robot.check_configuration(q))
        if link not in self.robot.link_names:
            raise RobotError(f"no link {link!r} to check; links: {list(self.robot.link_names)}")
        return self._queries.link_distance(link, body)

    def allows(self, link: str, body: str) -> bool:
        """Whether `allowed_contacts` lets a link touch a body."""
        return self._queries.allows(link, body)

    # --- motions -----------------------------------------------------------------

    def check_motion_buffer(self, qa: Configuration, qb: Configuration) -> bool:
        """`check_motion` without looking at shapes, at discrete configurations.

        Between two of them no point of the robot moves more than `step` metres. (FCL's continuous
        check crashes or misses with meshes, and is not used.) ConfigError if that asks for too
        many.
        """
        return all(self.is_valid_buffer(q) for _, q in self._between(qa, qb))

    def check_motion_report(self, qa: Numbers, qb: Numbers) -> MotionReport:
        """Return the verdict on an edge, how far apart it was looked at, and the reason."""
        qa, qb = configuration(self.robot, qa), configuration(self.robot, qb)
        checked, refused, state = 0, None, None
        for t, q in self._between(qa, qb):
            checked += 1
            if not self.is_valid_buffer(q):
                refused, state = t, self.explain(q)
                break
        finite = np.isfinite(qa).all() and np.isfinite(qb).all()
        return MotionReport(
            valid=refused is None,
            certified=False,
            tolerance=0.5 * self.step,
            collision_fraction=refused,
            configurations=checked,
            motion_bound=self.placed.motion_bound(qb - qa) if finite else math.inf,
            state=state,
        )

    def check_path(self, path: Numbers) -> PathOpinion:
        """Check every edge of a path (T, dof) as `check_motion` does.

        Returns:
            The opinion, with the first collision found on each refused edge.

        Raises:
            RobotError: path does not have shape (T, dof), T >= 1, or is not finite.
            ConfigError: the step asks for too many configurations.
        """
        rows = configurations(self.robot, path, finite=True)
        if len(rows) == 0:
            raise RobotError(f"a path has shape {rows.shape}; it needs at least one waypoint")
        ends = pairwise(rows) if len(rows) > 1 else iter([(rows[0], rows[0])])
        findings, checked = [], 0
        for edge, (qa, qb) in enumerate(ends):
            for t in self._fractions(qa, qb):
                checked += 1
                q = qa + t * (qb - qa)
                if not self.is_valid_buffer(q):
                    values = tuple(float(v) for v in q)
                    findings.append(PathFinding(edge, float(t), values, self.contacts(q)))
                    break
        return PathOpinion(not findings, self.step, checked, tuple(findings))

    def review(self, checker: Any, path: Numbers) -> PathOpinion:
        """Check a path that another checker accepted, and say why the two disagree.

        Returns:
            `check_path`, with the causes of each disagreement as `compare` names them; "edge
            tolerance" where the checker refuses the very configuration, too, and accepted the edge
            within its tolerance.
        """
        opinion = self.check_path(path)
        findings = tuple(
            replace(found, causes=causes_between(checker, self, np.array(found.configuration)))
            for found in opinion.findings
        )
        return replace(opinion, findings=findings)

    def _fractions(self, qa: np.ndarray, qb: np.ndarray) -> Values:
        """Where to look on an edge: no point of the robot moves more than `step` in between."""
        pieces = max(1, math.ceil(self.placed.motion_bound(qb - qa) / self.step))
        if pieces > _MAX_CONFIGURATIONS:
            raise ConfigError(
                f"step {self.step} m asks for {pieces:,} configurations on one edge (at most "
                f"{_MAX_CONFIGURATIONS:,}); use a larger one"
            )
        return np.linspace(0.0, 1.0, pieces + 1)

    def _between(self, qa: np.ndarray, qb: np.ndarray) -> Iterator[tuple[float, Configuration]]:
        """Where to look and what is there: both ends, then each time the middles of what is
        left. Who gets an invalid end asks no further."""
        yield 0.0, qa
        yield 1.0, qb
        fractions = self._fractions(qa, qb)
        spans = [(0, len(fractions) - 1)]
        while spans:
            middles = [(a, (a + b) // 2, b) for a, b in spans if b - a > 1]
            for _, m, _ in middles:
                yield float(fractions[m]), qa + fractions[m] * (qb - qa)
            spans = [span for a, m, b in middles for span in ((a, m), (m, b))]

    def _permitted(self, q: Configuration) -> list[Contact]:
        self.placed.place(q)
        return self._queries.permitted()
