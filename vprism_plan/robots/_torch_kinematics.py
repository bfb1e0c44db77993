# SPDX-License-Identifier: BSD-3-Clause
"""Batched, differentiable kinematics: pytorch-kinematics fed from the flat arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan.errors import RobotError
from vprism_plan.robots._arrays import KIND_PRISMATIC, KinematicArrays

if TYPE_CHECKING:
    import torch


class TorchKinematics:
    """Sphere centres in the base frame as a function of a torch configuration.

    The chain is built from float64 matrices, not from URDF text: the URDF reader
    of pytorch-kinematics rounds offsets to float32, ignores mimic joints and gives
    continuous joints with an effort limit the range (0, 0). One chain is kept per
    dtype and device.
    """

    def __init__(self, arrays: KinematicArrays) -> None:
        self._arrays = arrays
        self._chains: dict[tuple[torch.dtype, torch.device], _Chain] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_arrays": self._arrays, "_chains": {}}

    def sphere_centers(self, q: torch.Tensor) -> torch.Tensor:
        """(B, dof) -> (B, S, 3) in the base frame, metres."""
        key = (q.dtype, q.device)
        if key not in self._chains:
            self._chains[key] = _Chain(self._arrays, *key)
        return self._chains[key](q)


class _Chain:
    def __init__(self, arrays: KinematicArrays, dtype: torch.dtype, device: torch.device) -> None:
        import torch

        if dtype not in (torch.float32, torch.float64):
            raise RobotError(f"q has dtype {dtype}; valid: torch.float32, torch.float64")

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, device=device).to(
                dtype if values.dtype.kind == "f" else torch.int64
            )

        chain = _build_chain(arrays, dtype, device)
        names = chain.get_joint_parameter_names()
        order = np.array([int(name[1:]) for name in names])
        self._chain = chain
        self._q_index = tensor(arrays.q_index[order])
        self._q_mult = tensor(arrays.q_mult[order])
        self._q_offset = tensor(arrays.q_offset[order])
        placed = [chain.frame_to_idx[f"f{f}"] for f in arrays.sphere_frame]
        self._frame = torch.tensor(placed, device=device)
        self._center = tensor(arrays.sphere_center)

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        import torch

        joints = q[:, self._q_index] * self._q_mult + self._q_offset
        # The chain's own backward is analytic and wrong when differentiated again;
        # the plain graph is right at every order.
        poses = self._chain.forward_kinematics_tensor(joints, analytical_grad=False)[self._frame]
        rotated = torch.einsum("sbij,sj->bsi", poses[..., :3, :3], self._center)
        return rotated + poses[..., :3, 3].transpose(0, 1)


def _build_chain(arrays: KinematicArrays, dtype: torch.dtype, device: torch.device) -> Any:
    """The frames as a pytorch-kinematics chain; joint and frame f are "j<f>", "f<f>"."""
    import torch
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Joint
    from pytorch_kinematics.frame import Link as ChainLink
    from pytorch_kinematics.transforms import Transform3d

    nodes: list[Frame] = []
    for f in range(len(arrays.parent)):
        node = Frame(f"f{f}", link=ChainLink(f"f{f}"))
        if f > 0:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = arrays.R_off[f], arrays.t_off[f]
            node.joint = Joint(
                f"j{f}",
                offset=Transform3d(matrix=torch.tensor(matrix, dtype=dtype, device=device)),
                joint_type="prismatic" if arrays.kind[f] == KIND_PRISMATIC else "revolute",
                axis=torch.tensor(arrays.axis[f], dtype=dtype, device=device),
                dtype=dtype,
                device=device,
            )
            nodes[arrays.parent[f]].add_child(node)
        nodes.append(node)
    return Chain(nodes[0], dtype=dtype, device=device)
