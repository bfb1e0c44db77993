# SPDX-License-Identifier: BSD-3-Clause
"""A second opinion by FCL: the surfaces of a world against the solids of a robot.

It judges the same map at the same level for the same robot, but with neither the distance
field, nor the octree that it is traced with, nor the compiled kernels.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.collision import _fcl
from vprism_plan.collision._mesh_queries import Queries, contact_rules
from vprism_plan.collision._mesh_world import MeshWorld
from vprism_plan.collision._solids import LinkShapes, PlacedSolids, robot_solids
from vprism_plan.collision.comparison import causes_between
from vprism_plan.collision.mesh_reports import PathFinding, PathOpinion
from vprism_plan.collision.protocols import BakedWorld, Numbers
from vprism_plan.collision.reports import Contact
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots import Robot
from vprism_plan.robots._values import joint_values

_STEP = 0.005  # metres
_MAX_CONFIGURATIONS = 1_000_000


class MeshChecker:
    """Checks a robot's solids against extracted meshes, half-spaces and known geometry.

    What it judges: every object's surface {P(occupied) >= level} as a closed mesh, the
    support surface and known half-spaces (by formula), known primitives and meshes,
    self-collision of the pairs the robot tests, and joint limits. What it does not know:
    occluded and unobserved space, unlabelled clutter, seen parts too thin for the map.
    So it is no planner's checker: it says whether the field's verdict holds for surfaces.

    FCL's meshes are hollow. A solid that no surface cuts lies wholly on one side, and the
    map's level set at one of its points says which (for known meshes: the winding number).
    Links that no joint moves are not checked against the world: they stand on it.
    Touching counts as collision. FCL's own tolerance is about 1e-5 m.

    Not safe to share between threads: shapes are moved while they are asked about.

    Args:
        world: what to avoid.
        robot: whose configurations are asked about.
        links: "geometry": the URDF's meshes, boxes, cylinders and spheres, or `link_meshes`,
            and the collision spheres of links that have neither (or whose meshes are missing,
            in more than 20 pieces, or of a link that was padded or scaled). "spheres": the
            collision spheres of every link.
        link_meshes: link -> `trimesh.Trimesh` in the link's frame, metres, in place of its
            primitives. They are taken as they are: the robot's padding does not grow them.
        allowed_contacts: link or SRDF group -> ids of the objects that it may touch.
        resolution: edge of the objects' marching cubes, metres. None: the lattice of the
            world's distance field (a quarter of its resolution), on which no mesh reaches
            beyond what the field encloses. A coarser mesh is made sooner, and may.

    Raises:
        MissingDependencyError: python-fcl is not installed.
        ConfigError: an option is out of range, or names an unknown object.
        RobotError: an option names an unknown link, or a mesh cannot be used.
    """

    def __init__(
        self,
        world: BakedWorld,
        robot: Robot,
        *,
        links: LinkShapes = "geometry",
        link_meshes: Mapping[str, Any] | None = None,
        allowed_contacts: Mapping[str, Collection[int]] | None = None,
        resolution: float | None = None,
    ) -> None:
        _fcl.fcl()
        self.world = world
        self.robot = robot
        self.links = links
        self.solids = robot_solids(robot, links, link_meshes)
        self.surfaces = MeshWorld(world, resolution)
        self.placed = PlacedSolids(robot, self.solids)
        rules = contact_rules(robot, world.map.object_ids, allowed_contacts or {})
        self._queries = Queries(world, self.placed, self.surfaces, rules)
        bounded = ~np.asarray(robot.continuous)
        self._arguments = world, robot, links, link_meshes, allowed_contacts, resolution
        self._lower = np.where(bounded, robot.lower, -FARTHEST)
        self._upper = np.where(bounded, robot.upper, FARTHEST)

    def __reduce__(self) -> Any:
        """A copy is made anew: FCL's objects cannot be copied."""
        return _made, self._arguments

    @classmethod
    def like(cls, checker: Any, **options: Any) -> "MeshChecker":
        """Make the second opinion on a `CollisionChecker`: its world, robot and contact rules.

        Args:
            checker: a `CollisionChecker`.
            **options: as for `MeshChecker`.
        """
        options.setdefault("allowed_contacts", dict(checker.config.allowed_contacts))
        return cls(checker.world, checker.robot, **options)

    # --- one configuration -------------------------------------------------------

    def is_valid(self, q: Numbers) -> bool:
        """Return whether no solid touches a surface or another link, within joint limits.

        Raises:
            RobotError: q does not have shape (dof,) or is not finite.
        """
        q = self.robot.check_configuration(q)
        if (q < self._lower).any() or (q > self._upper).any():
            return False
        self.placed.place(q)
        return not self._queries.collides()

    def distance(self, q: Numbers) -> float:
        """Return the distance from the moving links to the nearest surface, metres.

        At most 0 exactly when a moving link touches the world. Self-collision, joint
        limits and what `allowed_contacts` permits do not enter; inf if there is nothing.

        Apart, the figure is FCL's distance, exact for what is compared. In touch it is
        what FCL can say: exact depth for half-spaces, for spheres against anything, and
        between primitives; 0 for a box, cylinder or mesh that crosses a mesh's surface
        (FCL has no depth for that); minus the gap to the surface for one wholly inside.

        Raises:
            RobotError: q does not have shape (dof,) or is not finite.
        """
        q = self.robot.check_configuration(q)
        self.placed.place(q)
        return self._queries.distance()

    def contacts(self, q: Numbers) -> tuple[Contact, ...]:
        """Return every reason to refuse q: the deepest contact of each link and body.

        Depths are exact for half-spaces, for spheres against anything, and between
        primitives. Where a box, cylinder or mesh crosses a mesh's surface, the depth is
        FCL's figure for the deepest triangle: how far the solid reaches through it, not
        the way out. Of a solid wholly inside it is the gap to the surface. Normals of
        meshes are those of the triangle.

        Returns:
            Deepest first; empty exactly if `is_valid(q)`. `sphere` is -1 for solids.

        Raises:
            RobotError: q does not have shape (dof,) or is not finite.
        """
        q = self.robot.check_configuration(q)
        self.placed.place(q)
        reasons = [*self._queries.contacts(), *self._limit_contacts(q)]
        return tuple(sorted(reasons, key=lambda contact: -contact.depth))

    def link_distance(self, q: Numbers, link: str, body: str) -> float:
        """Return the distance from one link to one body, metres, as `distance` states it.

        Args:
            q: (dof,) configuration.
            link: one of `robot.link_names`.
            body: "object:3", "known:NAME", a half-space, or another link; inf for what
                has no surface here ("occluded", an object left out of the meshes, ...).

        Raises:
            RobotError: the configuration or the link is not one of the robot's.
        """
        q = self.robot.check_configuration(q)
        self.placed.place(q)
        if link not in self.robot.link_names:
            raise RobotError(f"no link {link!r} to check; links: {list(self.robot.link_names)}")
        return self._queries.link_distance(link, body)

    def allows(self, link: str, body: str) -> bool:
        """Whether `allowed_contacts` lets a link touch a body."""
        return self._queries.allows(link, body)

    # --- motions -----------------------------------------------------------------

    def check_motion(self, qa: Numbers, qb: Numbers, step: float = _STEP) -> bool:
        """Return whether the straight edge from qa to qb is free at discrete configurations.

        Between two of them no point of the robot moves more than `step` metres, so a
        collision may hide in at most half of that. (FCL's continuous check crashes or
        misses with meshes, and is not used.)

        Raises:
            RobotError: an end does not have shape (dof,) or is not finite.
            ConfigError: step is out of range.
        """
        qa, qb = (self.robot.check_configuration(q) for q in (qa, qb))
        return all(self.is_valid(qa + t * (qb - qa)) for t in self._fractions(qa, qb, step))

    def check_path(self, path: Numbers, step: float = _STEP) -> PathOpinion:
        """Check every edge of a path (T, dof) as `check_motion` does.

        Returns:
            The opinion, with the first collision found on each refused edge.

        Raises:
            RobotError: path does not have shape (T, dof), T >= 1, or is not finite.
            ConfigError: step is out of range.
        """
        rows = joint_values(path, self.robot, "a path")
        if rows.ndim != 2 or len(rows) == 0:
            raise RobotError(
                f"path has shape {rows.shape}; it must be (T, {self.robot.dof}) with T >= 1"
            )
        rows = np.array([self.robot.check_configuration(row) for row in rows])
        ends = pairwise(rows) if len(rows) > 1 else iter([(rows[0], rows[0])])
        findings, checked = [], 0
        for edge, (qa, qb) in enumerate(ends):
            for t in self._fractions(qa, qb, step):
                checked += 1
                q = qa + t * (qb - qa)
                if not self.is_valid(q):
                    values = tuple(float(v) for v in q)
                    findings.append(PathFinding(edge, float(t), values, self.contacts(q)))
                    break
        return PathOpinion(not findings, float(step), checked, tuple(findings))

    def review(self, checker: Any, path: Numbers, step: float = _STEP) -> PathOpinion:
        """Check a path that another checker accepted, and say why the two disagree.

        Args:
            checker: the `CollisionChecker` that accepted it.
            path: (T, dof) waypoints.
            step: metres, as for `check_motion`.

        Returns:
            `check_path`, with the causes of each disagreement as `compare` names them;
            "edge tolerance" where the checker refuses the very configuration, too, and
            accepted the edge within its tolerance.
        """
        opinion = self.check_path(path, step)
        findings = tuple(
            replace(found, causes=causes_between(checker, self, np.array(found.configuration)))
            for found in opinion.findings
        )
        return replace(opinion, findings=findings)

    def _fractions(self, qa: np.ndarray, qb: np.ndarray, step: float) -> Float[np.ndarray, "n"]:
        """Where to look on an edge: no point of the robot moves more than `step` in between."""
        if not (math.isfinite(step) and step >= 1e-5):
            raise ConfigError(f"step is {step!r}; it must be finite and at least 1e-5 metres")
        pieces = max(1, math.ceil(self.placed.motion_bound(qb - qa) / step))
        if pieces > _MAX_CONFIGURATIONS:
            raise ConfigError(
                f"step {step} m asks for {pieces:,} configurations on one edge (at most "
                f"{_MAX_CONFIGURATIONS:,}); use a larger one"
            )
        return np.linspace(0.0, 1.0, pieces + 1)

    def _limit_contacts(self, q: Float[np.ndarray, "dof"]) -> list[Contact]:
        found = []
        for j in np.flatnonzero((q < self._lower) | (q > self._upper)):
            name = self.robot.joint_names[j]
            excess = float(max(self._lower[j] - q[j], q[j] - self._upper[j]))
            detail = (
                f"joint {name} is {q[j]:.10g}, outside its limits "
                f"[{self._lower[j]:.10g}, {self._upper[j]:.10g}]"
            )
            found.append(Contact("joint_limit", name, "joint_limit", excess, detail=detail))
        return found


def _made(world: BakedWorld, robot: Robot, *options: Any) -> MeshChecker:
    """Make a checker of its arguments in order."""
    names = ("links", "link_meshes", "allowed_contacts", "resolution")
    return MeshChecker(world, robot, **dict(zip(names, options, strict=True)))
