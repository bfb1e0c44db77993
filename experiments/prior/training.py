# SPDX-License-Identifier: BSD-3-Clause
"""Training of the shape prior's network on the CPU.

Binary cross entropy with the share that fills each voxel, AdamW with a cosine schedule, a
moving average of the weights (Polyak and Juditsky 1992), bfloat16 where the processor has it.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from experiments.prior.data import Examples
from vprism_plan.mapping.shape_network import ShapeNetwork

BATCH = 8
RATE, _DECAY = 3e-3, 1e-2
_WARM_UP = 200  # steps
_AVERAGE = 0.998  # of the moving average
_EVERY = 250  # steps between two looks
_VALIDATED = 320  # crops


_FIRST_FILES, _STEPS_PER_FILE = 20, 22  # what there is at first, and when one more is taken in


class Pool:
    """Examples of files that are still being written: more of them as training goes on.

    Which files step s draws from depends on s alone, so a run is repeatable; it waits for a
    file that is not there yet.
    """

    def __init__(self, files: Sequence[Path], rng: np.random.Generator, first: int) -> None:
        self._files, self._rng, self._first = files, rng, first
        self._parts: list[Examples] = []
        self._order: list[tuple[int, int]] = []

    @property
    def complete(self) -> bool:
        """Whether every file has been taken in."""
        return len(self._parts) == len(self._files)

    def draw(self, step: int) -> Examples:
        """Return a batch for a step: every example once, in random order, then again."""
        while len(self._parts) < min(len(self._files), self._first + step // _STEPS_PER_FILE):
            path = self._files[len(self._parts)]
            while not path.exists():
                time.sleep(1.0)
            self._parts.append(Examples.load(path))
        if len(self._order) < BATCH:
            every = [
                (f, k) for f, part in enumerate(self._parts) for k in range(len(part.features))
            ]
            self._order += [every[i] for i in self._rng.permutation(len(every))]
        chosen, self._order = self._order[:BATCH], self._order[BATCH:]
        return Examples(
            np.stack([self._parts[f].features[k] for f, k in chosen]),
            np.stack([self._parts[f].targets[k] for f, k in chosen]),
        )


def train(
    files: Sequence[Path],
    held_out: Examples,
    steps: int,
    seed: int,
    threads: int,
    log: Callable[[str], None],
    keep: Callable[[ShapeNetwork], None],
    start: ShapeNetwork | None = None,
    rate: float = RATE,
) -> ShapeNetwork:
    """Return the averaged network after `steps` batches; calls `keep` with it now and then.

    From random weights, or from those of `start`. `rate` is the largest step of the optimizer.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = _fast(ShapeNetwork())
    if start is not None:
        network.load_state_dict(start.state_dict())
    average = _fast(ShapeNetwork())
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=_DECAY)
    pool = Pool(files, rng, _FIRST_FILES if start is None else len(files))
    since, total = time.monotonic(), 0.0
    for step in range(steps):
        batch = pool.draw(step)
        torch.set_num_threads(threads if pool.complete else 1)  # the others make the data
        share = min((step + 1) / _WARM_UP, 0.5 * (1.0 + math.cos(math.pi * step / steps)))
        for group in optimizer.param_groups:
            group["lr"] = rate * share
        x, y = _tensors(batch, slice(None), bool(rng.random() < 0.5))
        loss = _loss(network, x, y)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        decay = min(_AVERAGE, (step + 1.0) / (step + 10.0))
        with torch.no_grad():
            for mean, now in zip(average.parameters(), network.parameters(), strict=True):
                mean.lerp_(now, 1.0 - decay)
        total += loss.item()
        if (step + 1) % _EVERY == 0:
            seen = validate(average, held_out)
            log(
                f"step {step + 1} of {steps}, {time.monotonic() - since:.0f} s: loss "
                f"{total / _EVERY:.4f}, held out {seen[0]:.4f}, IoU {seen[1]:.3f}"
            )
            keep(average)
            total = 0.0
    return average


def validate(network: ShapeNetwork, held_out: Examples) -> tuple[float, float]:
    """Return the mean loss, and the mean over crops of the object's IoU at the level 0.5."""
    losses, ious = [], []
    with torch.no_grad():
        for start in range(0, min(len(held_out.features), _VALIDATED), BATCH):
            x, y = _tensors(held_out, slice(start, start + BATCH))
            with torch.autocast("cpu", torch.bfloat16):
                z = network(x).float()
            losses.append(binary_cross_entropy_with_logits(z, y).item())
            found, there = z[:, 0] > 0.0, y[:, 0] > 0.5
            both = (found & there).sum(dim=(1, 2, 3)).float()
            ious.extend((both / (found | there).sum(dim=(1, 2, 3)).clamp_min(1)).tolist())
    return float(np.mean(losses)), float(np.mean(ious))


def _loss(network: ShapeNetwork, x: Tensor, y: Tensor) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16):
        z = network(x)
    return binary_cross_entropy_with_logits(z.float(), y)


def _fast(network: ShapeNetwork) -> ShapeNetwork:
    # Five times faster on a CPU than the default layout.
    return network.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


def _tensors(examples: Examples, rows: slice, mirrored: bool = False) -> tuple[Tensor, Tensor]:
    """Return features and targets of some crops, mirrored in y."""
    x = torch.from_numpy(examples.features[rows]).float().div_(127.0)
    y = torch.from_numpy(examples.targets[rows]).float().div_(255.0)
    if mirrored:
        x, y = x.flip(3), y.flip(3)
    return x.contiguous(memory_format=torch.channels_last_3d), y
