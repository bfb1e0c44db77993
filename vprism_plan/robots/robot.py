# SPDX-License-Identifier: BSD-3-Clause
"""A robot arm as spheres that follow a configuration."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from vprism_plan._arguments import rigid_pose
from vprism_plan._read_only import ReadOnly
from vprism_plan._shapes import Pairs, Pose
from vprism_plan.errors import RobotError
from vprism_plan.robots import changes, kinematics, pairs, surfaces
from vprism_plan.robots.changes import Held
from vprism_plan.robots.geometry import MeshFile, PackageDirs, PrimitiveGeometry
from vprism_plan.robots.kinematics import Attachment, KinematicArrays, TorchKinematics
from vprism_plan.robots.report import RobotReport, robot_report, robot_warnings
from vprism_plan.robots.sphere_files import ChosenSpheres, link_spheres, write_spheres
from vprism_plan.robots.sphere_fit import SphereFit
from vprism_plan.robots.srdf import SemanticModel, choose_joints, load_srdf, lock_values, write_srdf
from vprism_plan.robots.urdf import RobotModel, load_model

READY = "ready"


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a robot is made of, whatever joints are locked."""

    model: RobotModel
    semantics: SemanticModel
    chosen: ChosenSpheres
    stated: dict[frozenset[str], str] | None  # pairs that files disable; None: they do not say
    matrix_samples: int


@dataclass(frozen=True, eq=False)
class Robot(ReadOnly):
    """A robot read from a URDF; build it with :meth:`from_urdf`.

    A configuration ``q`` has one value per name in ``joint_names``: radians for revolute and
    continuous joints, metres for prismatic ones. Arrays are read-only.

    Attributes:
        name: The robot's name.
        joint_names: The joints of a configuration, in its order.
        locked: Value of every other actuated joint.
        velocity_limits: (dof,) rad/s or m/s; inf where the URDF states none.
        base_pose: (4, 4) pose of the root link in the world.
        acceleration_limits: (dof,) the same per second; inf where no robot file states any.
        link_names: The links that carry collision spheres.
        geometry: Link name -> its primitive solids (links without any are absent).
        named_states: SRDF states that fix every joint of ``joint_names``.
        groups: SRDF group -> names of its links: the children of its joints and the links
            it names, with or without spheres (:meth:`links_of` gives those with spheres).
        disabled_pairs: Unordered link pair -> the reason for not testing it: the SRDF's;
            "Adjacent" for links joined by a joint (also through links without spheres);
            "Rigid" for links that no joint moves against each other; "Always" and "Never" of
            random configurations; or what :meth:`attach` says.
        arrays: The flat form that compiled kernels read.
        links: Every link, and every attached object -> where it sits.
        tool: The link that reaches poses where none is named; None if no file says.
        check_locked: Whether links that only locked joints move are checked against the world.
        meshes: Link name -> its collision meshes, read when they are asked for; scaled as
            the robot is, without its padding, by which nothing grows a mesh.
        link_spheres: Link name -> (n, 4) rows (x, y, z, radius) in the link's frame: the
            spheres as they were read or fitted, without padding, scale and attached objects.
        sphere_sources: Link name -> where its spheres are from: "file", "urdf", "tiled"
            over boxes and cylinders, or "fitted".
        geometry_as_read, meshes_as_read: ``geometry`` and ``meshes`` without padding and
            scale: what belongs to ``link_spheres``.
        attached: Name of each attached object -> the link that carries it.
        held: Name of each attached object -> its shape.
    """

    name: str
    joint_names: tuple[str, ...]
    locked: dict[str, float]
    velocity_limits: Float[np.ndarray, "dof"]
    acceleration_limits: Float[np.ndarray, "dof"]
    base_pose: Pose
    link_names: tuple[str, ...]
    geometry: dict[str, tuple[PrimitiveGeometry, ...]]
    named_states: dict[str, np.ndarray]
    groups: dict[str, tuple[str, ...]]
    disabled_pairs: dict[frozenset[str], str]
    arrays: KinematicArrays
    links: dict[str, Attachment] = field(repr=False)
    _parts: _Parts = field(repr=False)
    tool: str | None = None
    check_locked: bool = False
    meshes: dict[str, tuple[MeshFile, ...]] = field(default_factory=dict, repr=False)
    link_spheres: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    sphere_sources: dict[str, str] = field(default_factory=dict, repr=False)
    geometry_as_read: dict[str, tuple[PrimitiveGeometry, ...]] = field(
        default_factory=dict, repr=False
    )
    meshes_as_read: dict[str, tuple[MeshFile, ...]] = field(default_factory=dict, repr=False)
    # Pairs disabled by random configurations -> whether the values of locked joints enter.
    _sampled_pairs: dict[frozenset[str], bool] = field(default_factory=dict, repr=False)
    # The calls that changed it since it was made of its parts: name and arguments.
    _changes: tuple[tuple[str, dict[str, Any]], ...] = field(default=(), repr=False)
    attached: dict[str, str] = field(default_factory=dict)
    held: dict[str, Held] = field(default_factory=dict, repr=False)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        srdf: str | Path | None = None,
        spheres: str | Path | Mapping[str, Any] | None = None,
        base_pose: ArrayLike | None = None,
        joints: Sequence[str] | None = None,
        locked: Mapping[str, float] | None = None,
        *,
        group: str | None = None,
        package_dirs: PackageDirs = None,
        fit: SphereFit | None = None,
        matrix_samples: int = pairs.SAMPLES,
        check_locked: bool = False,
    ) -> Robot:
        """Read a robot.

        Args:
            path: The URDF (xacro expanded).
            srdf: The SRDF; None takes ``<stem>.srdf`` beside the URDF if there is one. Without
                an SRDF, ``disabled_pairs`` is generated: links joined by a joint or rigid to
                each other, links whose spheres always overlap, and links that stay far apart,
                both judged by ``matrix_samples`` random configurations.
            spheres: Collision spheres: a YAML file (``collision_spheres: {link:
                [{center: [x, y, z], radius: r}]}``), a robot file of cuRobo, an XRDF file
                (see :func:`read_spheres` for what else is read of them), such content as a
                mapping, or None: ``<stem>_spheres.yml`` beside the URDF, else spheres that
                enclose the URDF's own geometry (spheres are taken as they are). "fit" does
                so in any case.
            base_pose: (4, 4) pose of the root link in the world, whatever floating or planar
                joint holds it there; None is identity.
            joints: Joints of a configuration, in the order wanted. None takes the joints of
                cuRobo's or XRDF's ``cspace``, else the SRDF group "arm" if there is one, else
                all that move (lower < upper) and do not mimic another.
            locked: Values for joints not in ``joints``. Default for each: that of cuRobo's or
                XRDF's file, else its value in the SRDF (state "ready" first, then file
                order), else 0 or the limit next to it.
            group: Instead of ``joints``: an SRDF group, whose joints are taken.
            package_dirs: Where ``package://NAME/...`` leads to: folders that hold packages,
                or a mapping from a name to its folder. ROS_PACKAGE_PATH, AMENT_PREFIX_PATH
                and the folders above the URDF are searched in any case.
            fit: How spheres are fitted; None: as :class:`SphereFit` has it.
            matrix_samples: For the pairs that are generated.
            check_locked: Whether links that only locked joints move, as a second arm's, are
                checked against the world like those that move; else they are not, as the base.

        Raises:
            RobotError: Something above is malformed or does not fit together.
        """
        path = Path(path)
        model = load_model(path, package_dirs)
        beside = path.with_suffix(".srdf")
        if srdf is None and beside.is_file():
            srdf = beside
        semantics = SemanticModel() if srdf is None else load_srdf(srdf, model)
        base = rigid_pose(
            "base_pose", np.eye(4) if base_pose is None else base_pose, error=RobotError
        )
        chosen = link_spheres(model, path, spheres, fit or SphereFit())
        file = chosen.file
        if joints is None and group is None:
            joints = file.joints or None
        active = choose_joints(model, semantics, joints, group)
        known = {n: v for n, v in (file.rest | file.locked).items() if n not in active}
        known |= dict(locked or {})
        stated = None
        if srdf is not None or file.ignored is not None:
            stated = dict.fromkeys(file.ignored or (), "Ignored") | semantics.disabled
        parts = _Parts(model, semantics, chosen, stated, matrix_samples)
        return cls._of(parts, active, known, base, check_locked)

    @classmethod
    def _of(
        cls,
        parts: _Parts,
        active: tuple[str, ...],
        locked: Mapping[str, float],
        base: Pose,
        check_locked: bool,
    ) -> Robot:
        model, semantics, chosen = parts.model, parts.semantics, parts.chosen
        file = chosen.file
        fixed_values = lock_values(model, semantics, active, locked)
        arrays, links = kinematics.build_arrays(
            model, active, fixed_values, chosen.rows, base, file.buffer
        )
        tested, disabled, sampled = pairs.choose_pairs(
            model, arrays, chosen, parts.stated, parts.matrix_samples
        )
        checked = [check_locked and name in model.moved for name in chosen.rows]
        arrays = dataclasses.replace(
            arrays, pairs=tested, link_fixed=arrays.link_fixed & ~np.array(checked)
        )
        states = semantics.full_states(active)
        if file.rest.keys() >= set(active):
            states.setdefault(READY, np.array([file.rest[name] for name in active]))
        solids = {n: link.primitives for n, link in model.links.items() if link.primitives}
        meshes = {n: link.meshes for n, link in model.links.items() if link.meshes}
        robot = cls(
            name=model.name,
            joint_names=active,
            locked=fixed_values,
            velocity_limits=np.array([model.joint_map[j].velocity for j in active]),
            acceleration_limits=np.array([file.accelerations.get(j, math.inf) for j in active]),
            base_pose=base,
            link_names=tuple(chosen.rows),
            geometry=solids,
            named_states=states,
            groups=semantics.groups,
            disabled_pairs=disabled,
            arrays=arrays,
            links=links,
            tool=file.tool,
            check_locked=check_locked,
            meshes=meshes,
            link_spheres=chosen.rows,
            sphere_sources=chosen.sources,
            geometry_as_read=solids,
            meshes_as_read=meshes,
            _sampled_pairs={p: pairs.hangs_on(model, fixed_values, p) for p in sampled},
            _parts=parts,
        )
        return changes.padded(robot, file.padding, 1.0) if file.padding else robot

    @property
    def dof(self) -> int:
        """Number of joints in a configuration."""
        return len(self.joint_names)

    @property
    def lower(self) -> Float[np.ndarray, "dof"]:
        """Lower joint limits; -pi for continuous joints, which have none."""
        return self.arrays.lower

    @property
    def upper(self) -> Float[np.ndarray, "dof"]:
        """Upper joint limits; +pi for continuous joints, which have none."""
        return self.arrays.upper

    @property
    def continuous(self) -> Bool[np.ndarray, "dof"]:
        """True for joints that turn without limit."""
        return self.arrays.continuous

    @property
    def sphere_radii(self) -> Float[np.ndarray, "spheres"]:
        """Radius of each collision sphere, metres."""
        return self.arrays.sphere_radius

    @property
    def sphere_links(self) -> Int[np.ndarray, "spheres"]:
        """Index into ``link_names`` of each collision sphere's link."""
        return self.arrays.sphere_link

    @property
    def collision_pairs(self) -> Pairs:
        """Link pairs to test for self-collision, indices into ``link_names``."""
        return self.arrays.pairs

    @property
    def fixed_links(self) -> Bool[np.ndarray, "links"]:
        """True for links of ``link_names`` that are not checked against the world: no joint moves
        them (the mounted base)."""
        return self.arrays.link_fixed

    @property
    def neutral(self) -> Float[np.ndarray, "dof"]:
        """The SRDF state "ready" if there is one, else 0 or the limit next to it."""
        if READY in self.named_states:
            return self.named_states[READY].copy()
        return np.clip(np.zeros(self.dof), self.lower, self.upper)

    @functools.cached_property
    def _torch(self) -> TorchKinematics:
        return TorchKinematics(self.arrays)

    @functools.cached_property
    def reach(self) -> float:
        """Upper bound on how far any sphere gets from the root link's origin, metres."""
        return kinematics.reach_bound(self.arrays)

    def links_of(self, name: str) -> tuple[str, ...]:
        """The links with collision spheres that a name stands for.

        A link outranks an SRDF group of the same name.

        Raises:
            RobotError: There is no such link or group, or it has no collision spheres.
        """
        if name in self.link_names:
            return (name,)
        members = tuple(link for link in self.groups.get(name, ()) if link in self.link_names)
        if members:
            return members
        known = name in self.groups or name in self.links
        what = "has no collision spheres, so it is" if known else "is"
        raise RobotError(
            f"{name!r} {what} no link or group of {self.name} to check; "
            f"links: {list(self.link_names)}, groups: {sorted(self.groups)}"
        )

    def sphere_centers(self, q: Any) -> Any:
        """World centres of the collision spheres, (..., spheres, 3), metres.

        Args:
            q: configurations (..., dof): numbers or an array, or a tensor of float32 or float64
                on any device.

        Returns:
            An array, float64; for a tensor a tensor of its dtype and device, differentiable in
            q to any order. Batched already: torch.vmap over it is not supported.

        Raises:
            RobotError: q is not finite numbers, or has another dtype or last dimension.
        """
        import torch

        if not isinstance(q, torch.Tensor):
            with torch.no_grad():
                return self.sphere_centers(
                    torch.tensor(kinematics.joint_values(q, self, "q"))
                ).numpy()
        if q.ndim == 0 or q.shape[-1] != self.dof:
            raise RobotError(f"q has shape {tuple(q.shape)}; expected {self._expected('(..., ')}")
        if not bool(torch.isfinite(q.detach()).all()):
            raise RobotError("q holds NaN or infinite values; give finite joint values")
        local = self._torch.sphere_centers(q.reshape(-1, self.dof))
        base = torch.tensor(self.base_pose, dtype=q.dtype, device=q.device)
        world = local @ base[:3, :3].T + base[:3, 3]
        return world.reshape(*q.shape[:-1], *world.shape[1:])

    def link_poses(self, q: Any) -> dict[str, np.ndarray]:
        """World poses (4, 4) of all links of the URDF, by name, for one configuration.

        Raises:
            RobotError: See :meth:`check_configuration`.
        """
        R, t = kinematics.frame_poses(self.arrays, self.check_configuration(q)[None])
        poses = {}
        for link, sits in self.links.items():
            frame = np.eye(4)
            frame[:3, :3], frame[:3, 3] = R[0, sits.frame], t[0, sits.frame]
            poses[link] = frame @ sits.T
        return poses

    def solid_balls(self, q: Any) -> surfaces.SolidBalls:
        """What the robot itself fills: balls inside its solids, where collision spheres hold them.

        From the collision geometry of the URDF and the meshes of attached objects as they are,
        without padding and scale. Takes a second or two for an arm, the first time.

        Raises:
            RobotError: See :meth:`check_configuration`.
        """
        return surfaces.solid_balls(self, q)

    def random_configuration(self, rng: np.random.Generator) -> Float[np.ndarray, "dof"]:
        """A uniform configuration within the limits."""
        return rng.uniform(self.lower, self.upper)

    def check_configuration(self, q: Any) -> Float[np.ndarray, "dof"]:
        """A configuration as a float64 array.

        Joint limits are not looked at: being outside is a verdict, not an error.

        Raises:
            RobotError: The length is wrong or a value is not a finite number.
        """
        array = kinematics.joint_values(q, self, "a configuration")
        if array.shape != (self.dof,):
            found = f"a configuration of {self.name} has shape {array.shape}"
            raise RobotError(f"{found}; expected {self._expected('(')}")
        if not np.isfinite(array).all():
            named = zip(self.joint_names, array.tolist(), strict=True)
            bad = {name: value for name, value in named if not math.isfinite(value)}
            raise RobotError(f"joint values are not finite: {bad}; give finite numbers")
        return array

    @functools.cached_property
    def warnings(self) -> tuple[str, ...]:
        """What is usable but odd: in the files, links that stand out of their spheres, or that
        nothing checks."""
        return robot_warnings(self)

    def values(self, joints: kinematics.Named) -> Float[np.ndarray, "dof"]:
        """A configuration from joint values by name, which do wherever a configuration is taken.

        Joints that are not in ``joint_names`` are passed over. RobotError if one is missing, or
        no finite number.
        """
        return self.check_configuration(joints)

    def with_locked(self, values: Mapping[str, float], check_locked: bool | None = None) -> Robot:
        """The same robot with joints held at other values, those of a configuration left out.

        Pairs that are not tested are found anew; padding and attached objects stay.

        Args:
            values: Joint -> radians or metres; joints that are locked already take the new value.
            check_locked: As in :meth:`from_urdf`; None: as it is.

        Raises:
            RobotError: An unknown joint, a value outside its limits, or none is left to move.
        """
        check = self.check_locked if check_locked is None else check_locked
        rest = tuple(name for name in self.joint_names if name not in values)
        if not rest:
            raise RobotError(f"all joints {list(self.joint_names)} are locked; leave one to move")
        locked = self.locked | dict(values)
        robot = Robot._of(self._parts, rest, locked, self.base_pose, check)
        for name, given in self._changes:
            robot = getattr(robot, name)(**given)
        return robot

    def _after(self, change: str, make: Callable[..., Any], **given: Any) -> Robot:
        """What a change makes of this robot, with a note of it."""
        changes = (*self._changes, (change, given))
        return dataclasses.replace(make(self, **given), _changes=changes)

    def with_base_pose(self, base_pose: ArrayLike) -> Robot:
        """The same robot with its root link at another (4, 4) pose in the world.

        Raises:
            RobotError: The pose is not a rigid motion.
        """
        base = rigid_pose("base_pose", base_pose, error=RobotError)
        R, t = base[:3, :3].copy(), base[:3, 3].copy()
        arrays = dataclasses.replace(self.arrays, base_R=R, base_t=t)
        return dataclasses.replace(self, base_pose=base, arrays=arrays)

    def with_padding(
        self, padding: float | Mapping[str, float] = 0.0, scale: float | Mapping[str, float] = 1.0
    ) -> Robot:
        """The same robot with larger (or smaller) links, scaled first and then padded.

        Padding adds to the radius of every sphere, so clearance falls by exactly that much;
        solids of ``geometry`` are grown by it all around. A scale moves spheres and solids of a
        link away from (or towards) the centre of the ball around the link's spheres and
        multiplies their size. Scaled and padded spheres hold the scaled and padded solids, and
        what they held before.

        As in MoveIt, padding counts against the world only: links may come as near to each
        other as before. MoveIt differs in three ways: it scales every shape about its own
        origin; its padding moves each face of a box outward, corners farther; and it leaves the
        scale out of self-collision, where ours counts (pairs that then touch at ``neutral`` are
        logged). A scale above 1 makes generated "Never" pairs of that link tested again.

        Args:
            padding: Metres, 0 or more: one number, or a table by link or group whose other
                links stay as they are. A link's own entry outranks its groups'; of several
                groups the largest counts.
            scale: Factor above 0, in the same form.

        Raises:
            RobotError: An unknown link or group, or a value that is not allowed for it.
        """
        return self._after("with_padding", changes.padded, padding=padding, scale=scale)

    def attach(
        self,
        name: str,
        link: str,
        *,
        spheres: Any = None,
        mesh: Any = None,
        pose: ArrayLike | None = None,
        touch_links: Sequence[str] = (),
        max_spheres: int = 32,
    ) -> Robot:
        """The same robot carrying an object: one more link, which moves with ``link``.

        It is checked against the world (unless no joint moves ``link``) and against every
        link but ``link`` itself, ``touch_links``, and other objects on the same link; these
        exceptions are added to ``disabled_pairs``. Existing padding does not extend to it.

        Args:
            name: A new name; verdicts call the object so.
            link: Any link of the robot, with or without spheres, or an attached object.
            spheres: Rows (x, y, z, radius) in the object's frame, metres.
            mesh: Instead of spheres: a ``trimesh.Trimesh`` or a mesh file, metres, in the
                object's frame. It is held by at most ``max_spheres`` spheres, its inside
                included if it is closed. Around a box of 6 x 6 x 12 cm, 32 spheres protrude
                by 5 mm on average and 11 mm at most; around plates and rings by up to 3 cm.
            pose: (4, 4) pose of the object's frame in the frame of ``link``; None: the same.
            touch_links: Links, groups or attached objects that it may touch (the fingers).
            max_spheres: For ``mesh``.

        Raises:
            RobotError: The name is taken, a link is unknown, or the shape is unusable.
        """
        return self._after(
            "attach", changes.attached, name=name, link=link, spheres=spheres, mesh=mesh, pose=pose,
            touch_links=touch_links, max_spheres=max_spheres,
        )  # fmt: skip

    def detach(self, name: str) -> Robot:
        """The same robot without an attached object.

        Raises:
            RobotError: Nothing of that name is attached, or something is attached to it.
        """
        return self._after("detach", changes.detached, name=name)

    def report(self) -> RobotReport:
        """Compare the spheres with the geometry of the URDF, and list what is not tested.

        Takes a second or so for an arm. Padding, scale and attached objects do not enter.

        Raises:
            RobotError: A mesh file cannot be read; missing ones are reported as such.
        """
        return robot_report(self)

    def touching_shares(self, samples: int = 500, seed: int = 0) -> dict[frozenset[str], float]:
        """How often tested pairs of links overlap in random configurations.

        Where spheres are coarse, or a locked joint stands badly, a pair can refuse most of
        them.

        Returns:
            Unordered pair of ``collision_pairs`` -> share of the configurations, 0 to 1.
        """
        q = pairs.random_configurations(self.arrays, samples, np.random.default_rng(seed))
        shares = pairs.pairs_touching(self.arrays, q, self.collision_pairs).mean(axis=0)
        names = [frozenset(self.link_names[i] for i in pair) for pair in self.collision_pairs]
        return dict(zip(names, shares.tolist(), strict=True))

    def write_spheres(self, path: str | Path) -> None:
        """Write ``link_spheres`` as YAML, to be read bit by bit as ``<stem>_spheres.yml``.

        Buffers of a file of cuRobo or XRDF are written as padding, apart from the radii;
        that of :meth:`with_padding` is not written.
        """
        bare = {name: np.empty((0, 4)) for name in (*self.geometry, *self.meshes)}
        note = f"Collision spheres of {self.name}, metres, in link frames."
        file = self._parts.chosen.file
        if file.padding or file.buffer:
            note += "\nRadii are without the padding at the end, which is added when this is read."
        write_spheres(path, bare | self.link_spheres, note, file.padding, file.buffer)

    def write_srdf(self, path: str | Path) -> None:
        """Write an SRDF: the configuration's joints as group "arm", other groups, named
        states, the values of locked joints, and disabled pairs with their reasons.

        Left out are "Rigid" pairs, which are found anew when it is read, and, with a warning,
        generated "Always" and "Never" pairs that a locked joint moves against each other: an
        SRDF holds for any joints, what was sampled for these values only.
        """
        write_srdf(path, self)

    def _expected(self, opening: str) -> str:
        return f"{opening}{self.dof},) for the joints {list(self.joint_names)}"
