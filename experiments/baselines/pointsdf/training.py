# SPDX-License-Identifier: BSD-3-Clause
"""Training the network on one thread, so that the same data and seed give the same bits."""

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch.nn.functional import binary_cross_entropy_with_logits

from experiments.baselines.pointsdf.data import Examples
from experiments.baselines.pointsdf.model import Architecture, PointSDF, Surroundings
from vprism_plan.errors import ConfigError

LEVELS = (0.3, 0.4, 0.5, 0.6, 0.7)  # that validation looks at


@dataclass(frozen=True)
class Schedule:
    """How long, how fast and how varied.

    Attributes:
        steps: of the optimiser, at most.
        batch: objects per step.
        queries: points per object and step, drawn from those of its example.
        rate: highest learning rate of AdamW; linear up over `warmup` steps, cosine down to 0.
        warmup: steps.
        weight_decay: of AdamW.
        average: decay per step of the running mean of the weights, which is what is kept.
        turn: degrees, standard deviation of a random turn about the vertical.
        stretch: standard deviation of the logarithm of a random change of scale.
        check_every: steps between looks at the validation sets.
        patience: looks without a better IoU after which training stops.
        seed: of the weights, the order of the examples and their variation.
    """

    steps: int = 1200
    batch: int = 32
    queries: int = 160
    rate: float = 2e-3
    warmup: int = 100
    weight_decay: float = 1e-2
    average: float = 0.998
    turn: float = 8.0
    stretch: float = 0.1
    check_every: int = 200
    patience: int = 6
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "queries", "check_every", "patience"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}; it must be at least 1")

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ..."""
        rise = min(1.0, (step + 1) / max(self.warmup, 1))
        return self.rate * rise * 0.5 * (1.0 + math.cos(math.pi * step / self.steps))


@dataclass(frozen=True)
class Look:
    """State of training after some steps.

    Attributes:
        step: steps done.
        loss: mean binary cross entropy per query since the look before.
        iou: of each validation set the mean IoU at every level of `LEVELS`.
    """

    step: int
    loss: float
    iou: dict[str, tuple[float, ...]]

    @property
    def score(self) -> float:
        """Mean over the validation sets of the IoU, at the level where that is highest.

        Which level that is follows from how the queries were drawn, and is put right in the
        end (`calibrated`).
        """
        return float(np.mean(list(self.iou.values()), axis=0).max())


def train(
    examples: Examples,
    validation: Mapping[str, Examples],
    architecture: Architecture | None = None,
    schedule: Schedule | None = None,
    *,
    report: Callable[[Look], None] | None = None,
) -> tuple[PointSDF, list[Look]]:
    """Train a network; return it calibrated, and every look at the validation sets.

    Minimises the binary cross entropy of "inside" (as V-PRISM's authors trained theirs) under
    random mirroring about the line of sight, small turns about the vertical and changes of
    scale. The weights kept are those of the best `Look.score`. Queries near surfaces, which
    are learnt from most, lie inside more often than points at large do: the answers are
    calibrated on the validation sets, whose queries should be uniform in each object's box.

    Args:
        examples: to learn from.
        validation: by name, examples of objects that are not among them; at least one set.
        architecture: of the network.
        schedule: of the training.
        report: called at every look.

    Raises:
        ConfigError: no validation set, or a set without examples.
    """
    architecture, schedule = architecture or Architecture(), schedule or Schedule()
    if not validation or not len(examples) or not all(len(v) for v in validation.values()):
        raise ConfigError("training needs examples and at least one validation set with examples")
    with _one_thread():
        torch.manual_seed(schedule.seed)
        rng = np.random.default_rng([schedule.seed, 0x7EA1])
        model = PointSDF(architecture)
        averaged = copy.deepcopy(model).requires_grad_(False)
        optimiser = torch.optim.AdamW(model.parameters(), weight_decay=schedule.weight_decay)
        looks: list[Look] = []
        best = copy.deepcopy(averaged.state_dict())
        best_at, losses = 0, []
        batches = _batches(examples, schedule, rng)
        with torch.no_grad():
            neighbourhoods = _Neighbourhoods(model, examples)
        for step in range(schedule.steps):
            for group in optimiser.param_groups:
                group["lr"] = schedule.rate_at(step)
            batch, rows = next(batches)
            losses.append(_step(model, optimiser, batch, neighbourhoods[rows]))
            _average(averaged, model, min(schedule.average, (step + 1.0) / (step + 10.0)))
            if (step + 1) % schedule.check_every and step + 1 != schedule.steps:
                continue
            iou = {name: mean_iou(averaged, found) for name, found in validation.items()}
            looks.append(Look(step + 1, float(np.mean(losses)), iou))
            losses.clear()
            if report is not None:
                report(looks[-1])
            if looks[-1].score >= max(look.score for look in looks):
                best, best_at = copy.deepcopy(averaged.state_dict()), len(looks)
            elif len(looks) - best_at >= schedule.patience:
                break
        averaged.load_state_dict(best)
        return calibrated(averaged.eval(), Examples.joined(validation.values())), looks


def mean_iou(
    model: PointSDF, examples: Examples, levels: tuple[float, ...] = LEVELS, chunk: int = 32
) -> tuple[float, ...]:
    """Mean over objects of the IoU of each level set with the truth, over the examples' queries.

    An object without any point on either side counts 1.
    """
    p = torch.sigmoid(torch.from_numpy(logits(model, examples, chunk))).numpy()
    both = np.array([((p >= level) & examples.inside).sum(axis=1) for level in levels])
    either = np.array([((p >= level) | examples.inside).sum(axis=1) for level in levels])
    iou = np.where(either > 0, both / np.maximum(either, 1), 1.0)
    return tuple(float(v) for v in iou.mean(axis=1))


def logits(model: PointSDF, examples: Examples, chunk: int = 32) -> Float32[np.ndarray, "n q"]:
    """Return the network's answers to all queries, `chunk` objects at a time."""
    found = []
    for start in range(0, len(examples), chunk):
        clouds, contexts, queries, _ = _tensors(examples.subset(slice(start, start + chunk)))
        with torch.no_grad():
            found.append(model(clouds, contexts, queries).numpy())
    return np.concatenate(found)


def calibrated(model: PointSDF, examples: Examples) -> PointSDF:
    """Return the network with its logits z replaced by a z + b (Platt scaling).

    a > 0 and b minimise the cross entropy over the examples' queries. Done in the weights of
    the last layer.
    """
    from scipy.optimize import minimize

    z = logits(model, examples).astype(np.float64).ravel()
    y = examples.inside.ravel()

    def loss(x: Float[np.ndarray, "2"]) -> tuple[float, Float[np.ndarray, "2"]]:
        u = np.exp(x[0]) * z + x[1]
        error = 1.0 / (1.0 + np.exp(-u)) - y
        gradient = np.array([(error * np.exp(x[0]) * z).mean(), error.mean()])
        return float((np.logaddexp(0.0, u) - u * y).mean()), gradient

    found = minimize(loss, np.zeros(2), jac=True, method="L-BFGS-B", bounds=[(-2, 2), (-5, 5)])
    a, b = float(np.exp(found.x[0])), float(found.x[1])
    better = copy.deepcopy(model)
    with torch.no_grad():
        better.last.weight.mul_(a)
        better.last.bias.mul_(a).add_(b)
    return better


def varied(
    examples: Examples, schedule: Schedule, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n p 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n q 3"]]:
    """Return clouds, contexts and queries after a random mirroring, turn and change of scale."""
    n = len(examples)
    angle = np.deg2rad(schedule.turn) * rng.normal(size=n)
    flip = rng.choice([-1.0, 1.0], size=n)
    turn = np.zeros((n, 3, 3), dtype=np.float32)
    turn[:, 0, 0], turn[:, 0, 1] = np.cos(angle), np.sin(angle)
    turn[:, 1, 0], turn[:, 1, 1] = -np.sin(angle) * flip, np.cos(angle) * flip
    turn[:, 2, 2] = 1.0
    contexts = examples.contexts.copy()
    contexts[:, 0] += schedule.stretch * rng.normal(size=n)
    return examples.clouds @ turn, contexts, examples.queries.astype(np.float32) @ turn


Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def _batches(
    examples: Examples, schedule: Schedule, rng: np.random.Generator
) -> Iterator[tuple[Batch, Int[np.ndarray, "n"]]]:
    """Batches and who is in them, without end: each example once, then in another order."""
    waiting = np.empty(0, dtype=np.int64)
    while True:
        while len(waiting) < schedule.batch:
            waiting = np.concatenate([waiting, rng.permutation(len(examples))])
        index, waiting = waiting[: schedule.batch], waiting[schedule.batch :]
        part = examples.subset(index)
        asked = min(schedule.queries, part.queries.shape[1])
        columns = rng.choice(part.queries.shape[1], size=asked, replace=False)
        part = Examples(
            part.clouds, part.contexts, part.queries[:, columns], part.inside[:, columns]
        )
        clouds, contexts, queries = varied(part, schedule, rng)
        yield _tensors(Examples(clouds, contexts, queries, part.inside)), index


class _Neighbourhoods:
    """Who neighbours whom in every cloud, found once: the variations keep distances."""

    def __init__(self, model: PointSDF, examples: Examples, chunk: int = 64) -> None:
        parts = [
            model.surroundings(torch.from_numpy(examples.clouds[start : start + chunk]))
            for start in range(0, len(examples), chunk)
        ]
        self._layers: list[Surroundings] = []
        for layer in zip(*parts, strict=True):
            indices = [index.to(torch.int16) for index, _ in layer if index is not None]
            sparse = torch.cat([sparse for _, sparse in layer])
            self._layers.append((torch.cat(indices) if indices else None, sparse))

    def __getitem__(self, rows: Int[np.ndarray, "n"]) -> list[Surroundings]:
        return [
            (None if index is None else index[rows].long(), sparse[rows])
            for index, sparse in self._layers
        ]


def _tensors(part: Examples) -> Batch:
    return (
        torch.from_numpy(np.ascontiguousarray(part.clouds)),
        torch.from_numpy(np.ascontiguousarray(part.contexts)),
        torch.from_numpy(part.queries.astype(np.float32)),
        torch.from_numpy(part.inside.astype(np.float32)),
    )


def _step(
    model: PointSDF,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    surroundings: Sequence[Surroundings],
) -> float:
    """One step down the gradient; returns the loss before it."""
    clouds, contexts, queries, inside = batch
    optimiser.zero_grad(set_to_none=True)
    answers = model(clouds, contexts, queries, surroundings)
    loss = binary_cross_entropy_with_logits(answers, inside)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    return float(loss.detach())


def _average(averaged: PointSDF, model: PointSDF, decay: float) -> None:
    """Move the running mean of the weights towards the weights."""
    with torch.no_grad():
        for mean, now in zip(averaged.parameters(), model.parameters(), strict=True):
            mean.lerp_(now, 1.0 - decay)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch use one thread: sums in another order would be other bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
