# SPDX-License-Identifier: BSD-3-Clause
"""From logit moments to class probabilities, and their gradients.

E[softmax(z)]_k is approximated (Daunizeau 2017, with the sigmoid approximation of
section III) by q_k = 1 / (2 - K + sum_{i != k} 1 / E[sigmoid(z_k - z_i)]). With
u_ki = (m_k - m_i) / sqrt(1 + pi/8 (v_k + v_i)) that is 1 / (1 + sum_{i != k} exp(-u_ki)),
which never cancels. For K > 2 the q_k do not sum to 1: they are normalised here.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan._threads import run_chunked
from vprism_plan.errors import MapError

if TYPE_CHECKING:
    from vprism_plan.mapping.em import Weights


def class_log_probabilities(
    mean: Float[Tensor, "n k"], variance: Float[Tensor, "n k"]
) -> Float[Tensor, "n k"]:
    """Return the logarithm of the normalised prediction."""
    gap = mean[:, None, :] - mean[:, :, None]  # [n, k, i] = m_i - m_k
    spread = 1.0 + (math.pi / 8.0) * (variance[:, None, :] + variance[:, :, None])
    return torch.log_softmax(-torch.logsumexp(gap / torch.sqrt(spread), dim=2), dim=1)


class _NoSecondDerivative(torch.autograd.Function):
    """Identity whose backward says that second derivatives are not there."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, points: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        raise MapError(
            "second derivatives of a map are not provided on the CPU; differentiate once "
            "(create_graph=False)"
        )


class LogitMoments(torch.autograd.Function):
    """Logit mean, variance and kernel mass of points on the CPU, in float64.

    The backward pass is in closed form: grad m_k = sum_i w_ik grad phi_i and
    grad v_k = 2 sum_i (Sigma_k phi)_i grad phi_i, with grad phi_i = -2 gamma (x - h_i) phi_i.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, points: Tensor, classes: Sequence["Weights"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        from vprism_plan._kernels import mapping as kernels

        x = points.detach().contiguous().numpy()
        shapes = [(len(x), len(classes)), (len(x), len(classes)), (len(x),)]
        outputs = [torch.zeros(shape, dtype=torch.float64) for shape in shapes]
        slopes = [torch.zeros((*shape, 3), dtype=torch.float64) for shape in shapes]
        m, v, s, m_slope, v_slope, s_slope = (t.numpy() for t in (*outputs, *slopes))

        def chunk(piece: slice) -> None:
            # "Empty", which has all hinges, comes last: the mass of the kernels is that of its.
            for k in reversed(range(len(classes))):
                own, space = classes[k], classes[k].space
                kernels.point_jacobians(
                    x, piece.start, piece.stop, *space.kernel_arguments, space.gamma,
                    space.radius**2, own.mean, own.covariance, space.row_first, space.base, k,
                    m, v, s, m_slope, v_slope, s_slope,
                )  # fmt: skip

        run_chunked(chunk, len(x), 256)
        ctx.save_for_backward(points, *slopes)
        return outputs[0], outputs[1], outputs[2]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:  # noqa: D102
        grad_mean, grad_variance, grad_support = grad_outputs
        points, mean_slope, variance_slope, support_slope = ctx.saved_tensors
        gradient = (
            torch.einsum("nk,nka->na", grad_mean, mean_slope)
            + torch.einsum("nk,nka->na", grad_variance, variance_slope)
            + grad_support[:, None] * support_slope
        )
        if torch.is_grad_enabled():
            gradient = _NoSecondDerivative.apply(gradient, points)
        return gradient, None


def dense_moments(
    points: Float[Tensor, "n 3"],
    hinges: Float[Tensor, "h 3"],
    mean: Float[Tensor, "m k"],
    covariance: Float[Tensor, "k m m"],
    gamma: float,
    radius: float,
    chunk: int = 4096,
) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k"], Float[Tensor, " n"]]:
    """Compute the same with plain torch operations, on any device and in any dtype."""
    means, variances, masses = [], [], []
    # split() of an empty tensor gives one empty piece, so empty input works too.
    for x in points.split(chunk):
        square = ((x[:, None, :] - hinges[None]) ** 2).sum(dim=2)
        kernel = torch.where(square < radius**2, torch.exp(-gamma * square), 0.0)
        phi = torch.cat([kernel, torch.ones_like(kernel[:, :1])], dim=1)
        means.append(phi @ mean)
        variances.append(torch.einsum("nm,kmj,nj->nk", phi, covariance, phi).clamp_min(0.0))
        masses.append(kernel.sum(dim=1))
    return torch.cat(means), torch.cat(variances), torch.cat(masses)
