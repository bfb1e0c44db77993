# SPDX-License-Identifier: BSD-3-Clause
"""What a gap costs."""

import torch
from jaxtyping import Float
from torch import Tensor


def hinge(gap: Float[Tensor, "*shape"], margin: float) -> Float[Tensor, "*shape"]:
    """CHOMP's obstacle potential of a gap, metres: 0 from `margin` on, slope -1 below 0.

    (margin - gap)^2 / (2 margin) between, so that its derivative is continuous (Zucker et
    al., IJRR 32, 2013, section 3.4).
    """
    short = (margin - gap).clamp(min=0.0)
    return torch.where(gap < 0.0, 0.5 * margin - gap, short.square() / (2.0 * margin))


def soft_contact(depth: Float[Tensor, "*shape"], cut: float) -> Float[Tensor, "*shape"]:
    """ln(1 + e^x) (1 - e^-(x + cut))^2 of a depth x in units of softness; 0 below -cut.

    A logistic hazard whose tail ends, so that what is far away costs nothing.
    """
    kept = -torch.expm1(-(depth + cut).clamp(min=0.0))
    return torch.nn.functional.softplus(depth, threshold=40.0) * kept.square()
