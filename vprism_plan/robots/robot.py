# SPDX-License-Identifier: BSD-3-Clause
"""A robot arm as spheres that follow a configuration."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from vprism_plan.errors import RobotError
from vprism_plan.robots import _attached, _frames, _padding, _self_collision
from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._model import load_model
from vprism_plan.robots._setup import choose_joints, lock_values, rigid_pose
from vprism_plan.robots._spheres import link_spheres
from vprism_plan.robots._srdf import SemanticModel, load_srdf
from vprism_plan.robots._torch_kinematics import TorchKinematics

if TYPE_CHECKING:
    import torch

READY = "ready"


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot read from a URDF; build it with :meth:`from_urdf`.

    A configuration ``q`` has one value per name in ``joint_names``: radians for
    revolute and continuous joints, metres for prismatic ones.

    Attributes:
        name: The robot's name.
        joint_names: The joints of a configuration, in its order.
        locked: Value of every other actuated joint.
        velocity_limits: (dof,) rad/s or m/s; inf where the URDF states none.
        base_pose: (4, 4) pose of the root link in the world.
        link_names: The links that carry collision spheres.
        geometry: Link name -> its primitive solids (links without any are absent).
        named_states: SRDF states that fix every joint of ``joint_names``.
        groups: SRDF group -> names of its links: the children of its joints and the links
            it names, with or without spheres (:meth:`links_of` gives those with spheres).
        disabled_pairs: Unordered link pair -> the reason for not testing it: the SRDF's, or
            what :meth:`attach` was told.
        arrays: The flat form that compiled kernels read.
        links_with_meshes: Links whose collision geometry has meshes, which are not read:
            what ``geometry`` holds of them is not the whole link.
        attached: Name of each attached object -> the link that carries it.
    """

    name: str
    joint_names: tuple[str, ...]
    locked: dict[str, float]
    velocity_limits: Float[np.ndarray, "dof"]
    base_pose: Float[np.ndarray, "4 4"]
    link_names: tuple[str, ...]
    geometry: dict[str, tuple[PrimitiveGeometry, ...]]
    named_states: dict[str, np.ndarray]
    groups: dict[str, tuple[str, ...]]
    disabled_pairs: dict[frozenset[str], str]
    arrays: KinematicArrays
    _links: dict[str, _frames.Attachment] = field(repr=False)
    _torch: TorchKinematics = field(repr=False)
    links_with_meshes: tuple[str, ...] = ()
    attached: dict[str, str] = field(default_factory=dict)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        srdf: str | Path | None = None,
        spheres: str | Path | Mapping[str, Any] | None = None,
        base_pose: ArrayLike | None = None,
        joints: Sequence[str] | None = None,
        locked: Mapping[str, float] | None = None,
    ) -> Robot:
        """Read a robot.

        Args:
            path: The URDF (xacro expanded).
            srdf: The SRDF; None takes ``<stem>.srdf`` beside the URDF if there is
                one. Without an SRDF, only links joined by a joint and links whose
                spheres always overlap are left out of self-collision.
            spheres: Collision spheres: a YAML file (``collision_spheres: {link:
                [{center: [x, y, z], radius: r}]}``), such a mapping, or None:
                ``<stem>_spheres.yml`` beside the URDF, else spheres that enclose
                the URDF's own boxes, cylinders and spheres.
            base_pose: (4, 4) pose of the root link in the world; None is identity.
            joints: Joints of a configuration, in the order wanted. None takes the
                SRDF group "arm" if there is one, else all joints that move and do
                not mimic another.
            locked: Values for joints not in ``joints``. Default for each: its value
                in the SRDF (state "ready" first, then file order), else 0 or the
                limit next to it.

        Raises:
            RobotError: Something above is malformed or does not fit together; the
                message names it.
        """
        path = Path(path)
        model = load_model(path)
        beside = path.with_suffix(".srdf")
        srdf = beside if srdf is None and beside.is_file() else srdf
        semantics = SemanticModel() if srdf is None else load_srdf(srdf, model)
        active = choose_joints(model, semantics, joints)
        fixed_values = lock_values(model, semantics, active, locked or {})
        base = rigid_pose(np.eye(4) if base_pose is None else base_pose)
        balls = link_spheres(model, path, spheres)
        nothing = np.empty((0, 2), dtype=np.int64)
        arrays, links = _frames.build_arrays(model, active, fixed_values, balls, nothing, base)
        pairs = _self_collision.candidate_pairs(model, links, tuple(balls), semantics.disabled)
        if srdf is None:
            pairs = _self_collision.drop_always_touching(arrays, pairs, tuple(balls))
        arrays = dataclasses.replace(arrays, pairs=pairs)
        states = {
            name: np.array([values[joint] for joint in active])
            for name, values in semantics.merged_states().items()
            if all(joint in values for joint in active)
        }
        return cls(
            name=model.name,
            joint_names=active,
            locked=fixed_values,
            velocity_limits=np.array([model.joint_map[j].velocity for j in active]),
            base_pose=base,
            link_names=tuple(balls),
            geometry={n: link.primitives for n, link in model.links.items() if link.primitives},
            named_states=states,
            groups=dict(semantics.group_links),
            disabled_pairs=dict(semantics.disabled),
            arrays=arrays,
            _links=links,
            _torch=TorchKinematics(arrays),
            links_with_meshes=tuple(n for n, link in model.links.items() if link.meshes),
        )

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
    def collision_pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """Link pairs to test for self-collision, indices into ``link_names``."""
        return self.arrays.pairs

    @property
    def fixed_links(self) -> Bool[np.ndarray, "links"]:
        """True for links of ``link_names`` that no joint moves (the mounted base)."""
        return self.arrays.link_fixed

    @property
    def neutral(self) -> Float[np.ndarray, "dof"]:
        """The SRDF state "ready" if there is one, else 0 or the limit next to it."""
        if READY in self.named_states:
            return self.named_states[READY].copy()
        return np.clip(np.zeros(self.dof), self.lower, self.upper)

    @functools.cached_property
    def reach(self) -> float:
        """Upper bound on how far any sphere gets from the root link's origin, metres."""
        return _frames.reach_bound(self.arrays)

    def links_of(self, name: str) -> tuple[str, ...]:
        """The links with collision spheres that a name stands for.

        Args:
            name: A link of ``link_names`` or an SRDF group. Where both have the name, it
                is the link.

        Raises:
            RobotError: There is no such link or group, or it has no collision spheres.
        """
        if name in self.link_names:
            return (name,)
        members = tuple(link for link in self.groups.get(name, ()) if link in self.link_names)
        if members:
            return members
        what = "is"
        if name in self.groups or name in self._links:
            what = "has no collision spheres, so it is"
        raise RobotError(
            f"{name!r} {what} no link or group of {self.name} to check; "
            f"links: {list(self.link_names)}, groups: {sorted(self.groups)}"
        )

    def sphere_centers(
        self, q: Float[torch.Tensor, "*batch dof"]
    ) -> Float[torch.Tensor, "*batch spheres 3"]:
        """World centres of the collision spheres.

        Args:
            q: Configurations, float32 or float64, any device and batch shape.

        Returns:
            Centres in metres, same dtype and device, differentiable in q to any order.
            Batched already: torch.vmap over it is not supported.

        Raises:
            RobotError: q has another dtype, a wrong last dimension, or values that
                are not finite.
        """
        import torch

        if q.ndim == 0 or q.shape[-1] != self.dof:
            raise RobotError(f"q has shape {tuple(q.shape)}; expected {self._expected('(..., ')}")
        if not bool(torch.isfinite(q.detach()).all()):
            raise RobotError("q holds NaN or infinite values; give finite joint values")
        local = self._torch.sphere_centers(q.reshape(-1, self.dof))
        base = torch.as_tensor(self.base_pose, dtype=q.dtype, device=q.device)
        world = local @ base[:3, :3].T + base[:3, 3]
        return world.reshape(*q.shape[:-1], *world.shape[1:])

    def link_poses(self, q: Any) -> dict[str, np.ndarray]:
        """World poses of all links of the URDF.

        Args:
            q: (dof,) configuration.

        Raises:
            RobotError: See :meth:`check_configuration`.

        Returns:
            Link name -> (4, 4).
        """
        R, t = _frames.frame_poses(self.arrays, self.check_configuration(q)[None])
        poses = {}
        for link, sits in self._links.items():
            frame = np.eye(4)
            frame[:3, :3], frame[:3, 3] = R[0, sits.frame], t[0, sits.frame]
            poses[link] = frame @ sits.T
        return poses

    def random_configuration(self, rng: np.random.Generator) -> Float[np.ndarray, "dof"]:
        """A uniform configuration within the limits."""
        return rng.uniform(self.lower, self.upper)

    def check_configuration(self, q: Any) -> Float[np.ndarray, "dof"]:
        """A configuration as a float64 array.

        Joint limits are not looked at: being outside is a verdict, not an error.

        Raises:
            RobotError: The length is wrong or a value is not a finite number.
        """
        try:
            array = np.array(np.asarray(q), dtype=np.float64, order="C")
        except (TypeError, ValueError, RuntimeError) as error:
            raise RobotError(
                f"a configuration of {self.name} cannot be read from {type(q).__name__}: {error}; "
                f"expected {self._expected('(')}"
            ) from error
        if array.shape != (self.dof,):
            raise RobotError(
                f"a configuration of {self.name} has shape {array.shape}; "
                f"expected {self._expected('(')}"
            )
        if not np.isfinite(array).all():
            bad = {
                name: float(v)
                for name, v in zip(self.joint_names, array, strict=True)
                if not math.isfinite(v)
            }
            raise RobotError(f"joint values are not finite: {bad}; give finite numbers")
        return array

    def with_base_pose(self, base_pose: ArrayLike) -> Robot:
        """The same robot standing elsewhere; shares everything but the base.

        Args:
            base_pose: (4, 4) pose of the root link in the world.

        Raises:
            RobotError: The pose is not a rigid motion.
        """
        base = rigid_pose(base_pose)
        arrays = dataclasses.replace(
            self.arrays,
            base_R=np.ascontiguousarray(base[:3, :3]),
            base_t=np.ascontiguousarray(base[:3, 3]),
        )
        return dataclasses.replace(self, base_pose=base, arrays=arrays)

    def with_padding(
        self, padding: float | Mapping[str, float] = 0.0, scale: float | Mapping[str, float] = 1.0
    ) -> Robot:
        """The same robot with larger (or smaller) links, scaled first and then padded.

        Padding adds to the radius of every sphere, so clearance falls by exactly that much;
        solids of ``geometry`` are grown by it all around. A scale moves spheres and solids
        of a link away from (or towards) the centre of the ball around the link's spheres
        and multiplies their size; above 1, spheres are widened so that they also hold what
        they held before. Scaled and padded spheres hold the scaled and padded solids.

        As in MoveIt, padding counts against the world only: links may come as near to each
        other as before. MoveIt differs in three ways: it scales every shape about the
        shape's own origin; its padding moves each face of a box outward, corners farther,
        where ours is a distance in every direction; and it leaves the scale out of
        self-collision, where ours counts (pairs that then touch at ``neutral`` are logged).

        Args:
            padding: Metres, 0 or more: one number, or a table by link or group whose other
                links stay as they are. A link's own entry outranks its groups'; of several
                groups the largest counts.
            scale: Factor above 0, in the same form.

        Raises:
            RobotError: An unknown link or group, or a value that is not allowed for it.
        """
        return _padding.padded(self, padding, scale)

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
                by 7 mm on average and 12 mm at most; around plates and rings by up to 3 cm.
            pose: (4, 4) pose of the object's frame in the frame of ``link``; None: the same.
            touch_links: Links, groups or attached objects that it may touch (the fingers).
            max_spheres: For ``mesh``.

        Raises:
            RobotError: The name is taken, a link is unknown, or the shape is unusable.
        """
        rows = _attached.object_spheres(name, spheres, mesh, max_spheres)
        return _attached.attached(self, name, link, rows, pose, touch_links)

    def detach(self, name: str) -> Robot:
        """The same robot without an attached object.

        Raises:
            RobotError: Nothing of that name is attached, or something is attached to it.
        """
        return _attached.detached(self, name)

    def _expected(self, opening: str) -> str:
        return f"{opening}{self.dof},) for the joints {list(self.joint_names)}"
