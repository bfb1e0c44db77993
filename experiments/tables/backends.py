# SPDX-License-Identifier: BSD-3-Clause
"""Where the cases of an experiment run: processes here, a Dask cluster, or Ray."""

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from vprism_plan.errors import ConfigError, MissingDependencyError

if TYPE_CHECKING:
    import joblib

BACKENDS = ("loky", "dask", "ray")
_VARIABLES = ("VPRISM_PLAN_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread() -> None:
    """Let this process, a worker that is one of many, compute with one thread from now on."""
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    if "torch" in sys.modules:  # loaded later, it reads the variables
        import torch

        torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread in this block, as workers do, so that the answers are the same."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    torch_before = None
    if "torch" in sys.modules:
        import torch

        torch_before = torch.get_num_threads()
    use_one_thread()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if torch_before is not None:
            torch.set_num_threads(torch_before)


@contextmanager
def parallel(backend: str, jobs: int, cluster: Any = None) -> Iterator["joblib.Parallel"]:
    """Yield a joblib.Parallel whose results come as they finish, in any order.

    Args:
        backend: one of `BACKENDS`.
        jobs: processes, 1 for this one; a cluster that exists already has its own number.
        cluster: `distributed.Client` or address of a Dask scheduler, or address of a Ray
            cluster; None starts one on this machine with `jobs` processes.

    Raises:
        ConfigError: unknown backend, or not at least one job.
        MissingDependencyError: the backend is not installed.
    """
    if backend not in BACKENDS:
        raise ConfigError(f"backend is {backend!r}; it must be one of {', '.join(BACKENDS)}")
    if jobs < 1:
        raise ConfigError(f"jobs is {jobs}; it must be at least 1")
    try:
        import joblib
    except ImportError as error:
        raise MissingDependencyError(
            "experiments run through joblib: pip install 'vprism_plan[experiments]'"
        ) from error
    with ExitStack() as stack:
        if backend == "dask":
            client = _dask_client(stack, jobs, cluster)
            stack.enter_context(joblib.parallel_config("dask", client=client))
            yield joblib.Parallel(return_as="generator_unordered", batch_size=1)
        elif backend == "ray":
            _start_ray(stack, jobs, cluster)
            stack.enter_context(joblib.parallel_config("ray", n_jobs=jobs))
            # Ray's pool has no way to hand results over one by one.
            yield joblib.Parallel(batch_size=1)
        elif jobs == 1:
            yield joblib.Parallel(n_jobs=1, return_as="generator")
        else:
            stack.enter_context(joblib.parallel_config("loky", inner_max_num_threads=1))
            yield joblib.Parallel(
                n_jobs=jobs, return_as="generator_unordered", batch_size=1, pre_dispatch=2 * jobs
            )


def _dask_client(stack: ExitStack, jobs: int, cluster: Any) -> Any:
    """Return a client of the given or of a new local cluster, closed with `stack`."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise MissingDependencyError(
            "the dask backend needs distributed: pip install 'vprism_plan[cluster]'"
        ) from error
    if cluster is None:
        local = LocalCluster(
            n_workers=jobs, threads_per_worker=1, dashboard_address=None, memory_limit=0
        )
        return stack.enter_context(Client(stack.enter_context(local), set_as_default=False))
    if isinstance(cluster, Client):
        return cluster
    return stack.enter_context(Client(cluster, set_as_default=False))


def _start_ray(stack: ExitStack, jobs: int, cluster: Any) -> None:
    """Register Ray with joblib; connect to a cluster or start one, stopped with `stack`."""
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise MissingDependencyError(
            "the ray backend needs ray: pip install 'vprism_plan[cluster]'"
        ) from error
    register_ray()
    if not ray.is_initialized():
        if cluster is None:
            ray.init(num_cpus=jobs, include_dashboard=False)
        else:
            ray.init(address=cluster)
        stack.callback(ray.shutdown)
