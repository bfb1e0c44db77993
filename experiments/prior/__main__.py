# SPDX-License-Identifier: BSD-3-Clause
"""Make the data of the shape prior, train its network, write the weights.

    python -m experiments.prior [--scenes 1200] [--steps 9000] [--data DIR] [--start FILE]

Examples go to the data folder, scene by scene; started again, it goes on where it stopped.
"""

import argparse
import multiprocessing
import time
from pathlib import Path

from experiments.prior.data import Examples, data_files, write
from experiments.prior.training import RATE, train
from experiments.tables.scoring import commit
from vprism_plan.mapping.shape_network import ShapeNetwork, ShapePrior

WEIGHTS = Path(__file__).parents[2] / "vprism_plan" / "data" / "shape_prior.safetensors"


def origin_of(chosen: argparse.Namespace) -> dict[str, str]:
    """Return the command and the commit, behind those that weights to start from came from."""
    from safetensors import safe_open

    decides = [f"--{name} {getattr(chosen, name)}" for name in ("scenes", "steps", "seed", "rate")]
    origin = {
        "command": " ".join(["python -m experiments.prior", *decides]),
        "commit": commit(),
    }
    if chosen.start is None:
        return origin
    with safe_open(chosen.start, "pt") as weights:
        former = weights.metadata()
    return {name: f"{former[name]}; then {origin[name]}" for name in origin}


def save_network(network: ShapeNetwork, path: Path, origin: dict[str, str]) -> None:
    """Write the weights, float16, and where they come from."""
    import torch
    from safetensors.torch import save_file

    state = network.state_dict()
    save_file({k: v.to(torch.float16).contiguous() for k, v in state.items()}, path, origin)


def main() -> int:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=1200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--data", type=Path, default=Path("build/prior"))
    parser.add_argument("--steps", type=int, default=9000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=RATE)
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    chosen = parser.parse_args()
    origin = origin_of(chosen)
    held_out, files = data_files(chosen.scenes, chosen.data)
    chosen.data.mkdir(parents=True, exist_ok=True)
    makers = multiprocessing.get_context("spawn").Pool(chosen.jobs)
    making = makers.map_async(write, [*held_out, *files], chunksize=1)
    while not all(path.exists() for path in held_out):
        time.sleep(1.0)
    network = train(
        files,
        Examples.merged([Examples.load(path) for path in held_out]),
        chosen.steps,
        chosen.seed,
        chosen.jobs,
        lambda line: print(line, flush=True),  # noqa: T201
        lambda found: save_network(found, chosen.data / "latest.safetensors", origin),
        None if chosen.start is None else ShapePrior(chosen.start).network,
        chosen.rate,
    )
    making.get()
    makers.close()
    save_network(network, chosen.output, origin)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
