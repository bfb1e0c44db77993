"""Shared settings: one torch thread, and property tests that repeat themselves exactly."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Two libraries spinning on two cores cost ten times what they gain.
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread():
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def real_frames(repository: Path) -> list[Path]:
    """Depth images of real tables, where the shared data lies beside the checkout."""
    frames = sorted((repository.parent / "shared" / "data" / "real").glob("frame*-depth.png"))
    if not frames:
        pytest.skip("the real depth images (../shared/data/real) are not on this machine")
    return frames
