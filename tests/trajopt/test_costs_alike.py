# SPDX-License-Identifier: BSD-3-Clause
"""What all costs promise: gradients, batches, dtypes, finite numbers, clear refusals."""

import copy

import numpy as np
import pytest
import torch

from vprism_plan._kernels import trajopt as kernels
from vprism_plan.errors import ConfigError, MapError, RobotError
from vprism_plan.trajopt import (
    ClearanceCost,
    EntropyCost,
    JointLimitCost,
    OccupancyCost,
    PoseCost,
    RiskCost,
    SelfCollisionCost,
    SmoothnessCost,
    SumCost,
)
from vprism_plan.trajopt.cost import (
    MAX_PARTS,
    MAX_TURN,
    PathKernels,
    Subdivision,
    sample_paths,
    turning_joints,
)

# Steps of finite differences; those of the exact posterior find features that end at a cutoff.
FINE, COARSE = {"eps": 1e-6, "atol": 1e-5, "rtol": 1e-5}, {"eps": 1e-7, "atol": 5e-2, "rtol": 1e-2}
MAKERS = {
    "clearance": lambda c: ClearanceCost(c, subsamples=2),
    "clearance of a world": lambda c: ClearanceCost(c.world, c.robot, subsamples=1),
    "clearance by length": lambda c: ClearanceCost(c, arc_length=True, subsamples=2),
    "self-collision": lambda c: SelfCollisionCost(c, subsamples=2),
    "hazard": lambda c: OccupancyCost(c, exact=False, subsamples=2),
    "hazard by length": lambda c: OccupancyCost(
        c.world, c.robot, exact=False, arc_length=True, subsamples=2
    ),
    "probability": lambda c: OccupancyCost(c, exact=False, measure="probability", subsamples=2),
    "entropy": lambda c: EntropyCost(c, exact=False, subsamples=2),
    "risk": lambda c: RiskCost(c, subsamples=2),
    "exact hazard": lambda c: OccupancyCost(c, subsamples=1),
    "exact entropy": lambda c: EntropyCost(c.world.map, c.robot, subsamples=1),
    "limits": lambda c: JointLimitCost(c.robot, margin=1.2),
    "smoothness": lambda c: SmoothnessCost(acceleration=0.1, jerk=0.01, robot=c.robot),
    "pose": lambda c: PoseCost(
        c.robot, "panda_hand", c.robot.link_poses(c.robot.neutral)["panda_hand"]
    ),
}
BY_KERNELS = [name for name in MAKERS if name not in ("limits", "smoothness", "pose")]


@pytest.fixture(scope="module")
def costs(arm_checker):
    made = {}

    def get(name):
        if name not in made:
            made[name] = MAKERS[name](arm_checker)
        return made[name]

    return get


@pytest.mark.parametrize("name", MAKERS)
def test_gradients_are_those_of_finite_differences(costs, colliding, name):
    q = colliding[:1, :2] if name in BY_KERNELS else colliding.reshape(1, 9, 7)
    q = q.clone().requires_grad_()
    cost = costs(name)
    assert float(cost(q).detach().sum()) > 0.0
    tolerance = COARSE if name.startswith("exact") else FINE
    assert torch.autograd.gradcheck(cost, (q,), **tolerance)


@pytest.mark.parametrize("name", [n for n in MAKERS if not n.startswith("exact")])
def test_second_derivatives_are_right(costs, colliding, name):
    """Compiled costs hand them to the plain graph; the spline's are constant in each cell."""
    q = colliding[:1, :2].clone().requires_grad_()
    assert torch.autograd.gradgradcheck(costs(name), (q,), fast_mode=True, atol=1e-4, rtol=1e-3)


def test_second_derivatives_of_the_exact_posterior_are_refused(costs, colliding):
    q = colliding[:1].clone().requires_grad_()
    (first,) = torch.autograd.grad(costs("exact hazard")(q).sum(), q, create_graph=True)
    with pytest.raises(MapError, match="second derivatives"):
        first.sum().backward()


@pytest.mark.parametrize("name", BY_KERNELS)
def test_kernels_and_torch_agree(costs, colliding, name):
    fast = costs(name)
    plain = copy.copy(fast)
    plain._compiled = None  # what backend="torch" leaves out; fields need no baking twice
    found = []
    for cost in (fast, plain):
        q = colliding.clone().requires_grad_()
        value = cost(q)
        found.append((value.detach(), *torch.autograd.grad(value.sum(), q)))
    for a, b in zip(*found, strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("waypoints", [1, 2, 3])
@pytest.mark.parametrize(("spacing", "parts"), [(0.01, None), (1.0, None), (0.05, 3)])
def test_kernels_divide_edges_as_torch_does(arm, colliding, spacing, parts, waypoints):
    q = colliding[:, :waypoints]
    fast = PathKernels(arm)
    expected = sample_paths(arm, q, Subdivision(spacing, parts), fast.sphere_centers)
    how = turning_joints(arm), spacing, MAX_TURN, MAX_PARTS, parts or 0
    found = [kernels.divide(Q, fast.floats, fast.ints, *how) for Q in q.numpy()]
    rows, _, _, weights = map(np.concatenate, zip(*found, strict=True))
    np.testing.assert_array_equal(rows, expected.q)
    np.testing.assert_array_equal(weights, expected.weight)


def test_torch_alone_on_request(arm_checker):
    assert ClearanceCost(arm_checker)._compiled is not None
    assert ClearanceCost(arm_checker, backend="torch")._compiled is None


@pytest.mark.parametrize("name", MAKERS)
def test_a_batch_is_its_trajectories(costs, colliding, name):
    cost = costs(name)
    alone = torch.stack([cost(q) for q in colliding])
    assert torch.allclose(cost(colliding), alone, rtol=1e-12, atol=1e-14)
    order = torch.tensor([2, 0, 1])
    assert torch.allclose(cost(colliding[order]), alone[order], rtol=1e-12, atol=1e-14)
    assert torch.allclose(cost(colliding[None, order, None]), alone[order][None, :, None])
    assert cost(colliding[0]).shape == ()
    assert cost(colliding[:0]).shape == (0,)


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize(
    "make", [ClearanceCost, SelfCollisionCost, OccupancyCost, EntropyCost, RiskCost]
)
def test_no_trajectories_cost_nothing_with_edges_divided_by_their_length(
    arm_checker, make, backend
):
    cost = make(arm_checker, backend=backend)
    for shape in ((0, 3, 7), (0, 1, 7), (2, 0, 3, 7)):
        q = torch.zeros(shape, dtype=torch.float64, requires_grad=True)
        value = cost(q)
        assert value.shape == shape[:-2]
        assert torch.autograd.grad(value.sum(), q)[0].shape == shape


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("name", MAKERS)
def test_other_dtypes(costs, colliding, name, dtype):
    q = colliding.to(dtype).requires_grad_()
    value = costs(name)(q)
    assert value.dtype == dtype
    (grad,) = torch.autograd.grad(value.sum(), q)
    assert grad.dtype == dtype
    assert torch.isfinite(grad).all()
    if dtype == torch.float32:
        assert torch.allclose(value.double(), costs(name)(colliding), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", MAKERS)
def test_finite_everywhere(costs, arm, name):
    rng = np.random.default_rng(2)
    wild = [
        rng.uniform(-1e4, 1e4, (2, 2, 7)),
        rng.uniform(arm.lower, arm.upper, (2, 2, 7)),
        np.zeros((1, 2, 7)),
        np.stack([arm.lower, arm.upper])[None],
    ]
    q = torch.from_numpy(np.concatenate(wild)).requires_grad_()
    value = costs(name)(q)
    assert torch.isfinite(value).all()
    assert torch.isfinite(torch.autograd.grad(value.sum(), q)[0]).all()
    assert torch.isfinite(costs(name)(q[:, :1])).all()


@pytest.mark.parametrize("name", ["limits", "smoothness"])
def test_other_devices(costs, name):
    """A device without numbers: what would mix devices fails on it."""
    assert costs(name)(torch.empty(3, 5, 7, device="meta")).device.type == "meta"


@pytest.mark.parametrize("name", MAKERS)
def test_what_is_no_trajectory_is_refused(costs, name):
    cost = costs(name)
    with pytest.raises(RobotError, match="float"):
        cost(torch.zeros(3, 7, dtype=torch.int64))
    with pytest.raises(RobotError, match="T, dof"):
        cost(torch.zeros(7))
    if name == "smoothness":
        cost = SmoothnessCost(robot=cost.robot)
    with pytest.raises(RobotError, match=r"T, 7"):
        cost(torch.zeros(3, 5))
    if name in BY_KERNELS:
        with pytest.raises(RobotError, match="finite"):
            cost(torch.full((3, 7), torch.nan))


def test_costs_add_up(costs, colliding):
    a, b = costs("clearance"), costs("limits")
    whole = a + 2.0 * b + (a * 3.0 + b)
    assert isinstance(whole, SumCost)
    assert len(whole) == 4
    assert torch.allclose(whole(colliding), 4.0 * a(colliding) + 3.0 * b(colliding))
    terms = (0.5 * whole).terms(colliding)
    assert list(terms) == ["clearance", "joint limits", "clearance 2", "joint limits 2"]
    assert torch.allclose(sum(terms.values()), 0.5 * whole(colliding))
    assert torch.allclose((0.5 * whole + a)(colliding), 0.5 * whole(colliding) + a(colliding))
    assert a.weight == 1.0
    assert list(a.terms(colliding)) == ["clearance"]


def test_refusals_name_the_value(arm_checker, arm):
    for make, message in (
        (lambda: ClearanceCost(arm_checker, margin=0.0), "margin is 0.0"),
        (lambda: ClearanceCost(arm_checker, spacing=-1.0), "spacing is -1.0"),
        (lambda: ClearanceCost(arm_checker, subsamples=0), "subsamples is 0"),
        (lambda: ClearanceCost(arm_checker, backend="gpu"), "backend is 'gpu'"),
        (lambda: ClearanceCost(arm_checker, weight=float("nan")), "weight is nan"),
        (lambda: ClearanceCost(arm_checker.world), "no robot"),
        (lambda: ClearanceCost(arm_checker, arm.with_padding(0.01)), "own robot"),
        (lambda: OccupancyCost(arm_checker, measure="odds"), "measure is 'odds'"),
        (lambda: OccupancyCost(7, arm), "got a int"),
        (lambda: RiskCost(arm_checker, temperature=0.0), "temperature is 0.0"),
        (lambda: RiskCost(arm_checker, resolution=0.02), "resolution is 0.02"),
        (lambda: PoseCost(arm, "panda_hand", np.eye(3)), "pose has shape"),
        (lambda: SmoothnessCost(jerk=-1.0), "jerk is -1.0"),
        (SumCost, "at least one"),
    ):
        with pytest.raises(ConfigError, match=message):
            make()
    with pytest.raises(RobotError, match="no link 'thumb'"):
        PoseCost(arm, "thumb", np.eye(4))
    with pytest.raises(RobotError, match="no waypoint 3"):
        PoseCost(arm, "panda_hand", np.eye(4), at=3)(torch.zeros(3, 7))
