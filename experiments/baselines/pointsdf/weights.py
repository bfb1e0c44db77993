# SPDX-License-Identifier: BSD-3-Clause
"""Trained networks on disk: one safetensors file with its whole history in the header."""

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file

from experiments.baselines.pointsdf.model import Architecture, PointSDF
from vprism_plan._files import reading, replacing
from vprism_plan.errors import MapError

SHIPPED = Path(__file__).with_name("weights.safetensors")
FORMAT_VERSION = 1
_HEADER = "pointsdf"


def save_network(model: PointSDF, path: str | Path, history: dict[str, Any]) -> None:
    """Write weights and architecture, whole or not at all.

    Args:
        model: the network.
        path: of the .safetensors file.
        history: how it came about (data, schedule, losses, commit), ready for JSON.
    """
    header = {
        "version": FORMAT_VERSION,
        "architecture": model.architecture.to_dict(),
        "history": history,
    }
    tensors = {name: value.contiguous() for name, value in model.state_dict().items()}
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata={_HEADER: json.dumps(header)})


def load_network(path: str | Path = SHIPPED) -> tuple[PointSDF, dict[str, Any]]:
    """Read a network, ready to answer, and its history.

    Raises:
        MapError: no such file, no network of this package, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise MapError(
            f"no PointSDF weights at {path}; install the package again, or train them: "
            "python -m experiments.benchmarks.train_pointsdf"
        )
    with reading(path, "a safetensors file of weights, or damaged", MapError):
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(_HEADER, "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if header.get("version") != FORMAT_VERSION:
            raise MapError(
                f"{path} holds no PointSDF weights of version {FORMAT_VERSION} (version: "
                f"{header.get('version')!r}); train them again: "
                "python -m experiments.benchmarks.train_pointsdf"
            )
        model = PointSDF(Architecture.from_dict(header["architecture"]))
        try:
            model.load_state_dict(tensors)
        except RuntimeError as error:
            raise MapError(f"{path} does not fit its own architecture: {error}") from error
        return model.requires_grad_(False).eval(), header["history"]


@lru_cache(maxsize=1)
def shipped_network() -> PointSDF:
    """Return the network that comes with the package."""
    return load_network()[0]
