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
    from vprism_plan._kernels import checking, risk
    from vprism_plan._kernels.jit import is_cached

    return is_cached({"maps": risk.touch_each, "checks": checking.pair_gaps}[job])


def _compile_maps() -> None:
    """Compile what fits a map, bakes a world of it and draws worlds from it."""
    import vprism_plan as vp
    from vprism_plan.world import PosteriorWorlds

    fitted = vp.fit_map(vp.load_observation(data_path("demo_scene")))
    world, point = vp.World(fitted), np.zeros((1, 3))
    world.field.lower_bound(point)
    world.status(point)
    PosteriorWorlds(fitted, n_worlds=64).touched(point, np.array([0.02]))


def _compile_checks() -> None:
    """Compile what a collision checker does when it is made."""
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.robots import Robot

    field = SimpleNamespace(
        origin=np.zeros(3), spacing=0.1, distance=np.ones((3, 3, 3), np.float32),
        source=np.zeros((3, 3, 3), np.int16),
    )  # fmt: skip
    world = SimpleNamespace(
        field=field, planes=np.zeros((0, 4)), plane_names=(), sources=("nothing",), map=None,
        config=SimpleNamespace(occluded="occupied", unobserved="free"),
    )  # fmt: skip
    CollisionChecker(world, Robot.from_urdf(urdf_path("panda")))


_JOBS = {"maps": _compile_maps, "checks": _compile_checks}

if __name__ == "__main__":
    _JOBS[sys.argv[1]]()
