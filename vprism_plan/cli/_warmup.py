# SPDX-License-Identifier: BSD-3-Clause
"""`warmup`, which compiles the kernels before anybody waits for them, in a process for each half.

LLVM compiles one function at a time in a process. Maps and checks use different kernels, so two
processes keep two cores busy.
"""

import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np

from vprism_plan._resources import data_path, urdf_path
from vprism_plan.cli._console import Console
from vprism_plan.cli._parsing import Command
from vprism_plan.errors import VPrismError


def run_warmup(command: Command, console: Console) -> int:
    """Compile what is not cached yet."""
    with console.stage("compile"):
        running = {job: start(job, quiet=False) for job in _JOBS if not _is_done(job)}
        failed = [job for job, process in running.items() if process.wait() != 0]
    if failed:
        raise VPrismError(f"compiling the kernels of {' and '.join(failed)} failed; see above")
    console.finish({}, [f"kernels are compiled; {console.time_line()}"])
    return 0


def start(job: str, quiet: bool = True) -> "subprocess.Popen[bytes]":
    """Compile the kernels of "maps" or "checks" in another process."""
    out = subprocess.DEVNULL if quiet else None
    name = "vprism_plan.cli._warmup"
    return subprocess.Popen([sys.executable, "-m", name, job], stdout=out, stderr=out)


def compile_checks_meanwhile() -> None:
    """Have another process compile the checks, if nobody has, while this one makes a map."""
    if _is_done("checks") is False:  # a thread waits for it: nobody else does
        threading.Thread(target=start("checks").wait, daemon=True).start()


def _is_done(job: str) -> bool | None:
    """Whether the kernel that a job compiles last is cached; None where nothing can be kept."""
    from vprism_plan._kernels import risk, world
    from vprism_plan._kernels.jit import is_cached

    return is_cached({"maps": world.classify_points, "checks": risk.touch_one}[job])


def _compile_maps() -> None:
    """Compile what fits a map and bakes a world of it."""
    import vprism_plan as vp

    world = vp.World(vp.fit_map(vp.load_observation(data_path("demo_scene"))))
    point = np.zeros((1, 3))
    world.field.lower_bound(point)
    world.status(point)


def _compile_checks() -> None:
    """Compile what a collision checker does when it is made, and what counts drawn worlds."""
    from vprism_plan.collision import CheckerConfig, CollisionChecker
    from vprism_plan.mapping import MapConfig, VPrismMap
    from vprism_plan.mapping.em import Posterior, weight_prior
    from vprism_plan.mapping.features import FeatureSpace
    from vprism_plan.robots import Robot
    from vprism_plan.world import PosteriorWorlds, WorldConfig

    points, settings = np.zeros((1, 3)), MapConfig()
    space = FeatureSpace(points, settings.gamma, settings.cutoff_radius)
    posterior = Posterior(weight_prior(space, settings, 2), ())
    unfitted = VPrismMap(settings, (1,), None, (), space, posterior, 0)
    field = SimpleNamespace(
        origin=np.zeros(3), spacing=0.1, distance=np.ones((3, 3, 3), np.float32),
        source=np.zeros((3, 3, 3), np.int16),
    )  # fmt: skip
    world = SimpleNamespace(
        field=field, planes=np.zeros((0, 4)), plane_names=(), sources=("nothing",), map=unfitted,
        config=WorldConfig(), certain_field=lambda *_, **__: field,
        posterior_worlds=lambda *asked: PosteriorWorlds(
            unfitted, **dict(zip(("n_worlds", "seed", "reach", "resolution"), asked, strict=True))
        ),
    )  # fmt: skip
    # The draws last: the other half has compiled by then what they share with maps.
    checker = CollisionChecker(
        world, Robot.from_urdf(urdf_path("panda")), CheckerConfig(max_risk=None)
    )
    checker.collision_probability(np.zeros(7))


_JOBS = {"maps": _compile_maps, "checks": _compile_checks}

if __name__ == "__main__":
    _JOBS[sys.argv[1]]()
