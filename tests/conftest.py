"""Shared settings: one torch thread, and property tests that repeat themselves exactly."""

import functools
import os
import sys
import typing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Two libraries spinning on two cores cost ten times what they gain.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Every checked call asks whether its arguments follow numpy's and our own protocols. Python 3.11
# collects a protocol's names anew each time, which took half of such calls; 3.12 keeps them.
if sys.version_info < (3, 12):
    typing._get_protocol_attrs = functools.cache(typing._get_protocol_attrs)

settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items):
    """What only measures, and what only draws, is for the long run."""
    for item in items:
        if item.path.parent.name in {"experiments", "viz"}:
            item.add_marker(pytest.mark.slow)


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


@pytest.fixture(scope="session")
def demo_map():
    """Default map of the bundled scene."""
    import vprism_plan as vp

    return vp.fit_map(vp.load_observation(vp_data("demo_scene")), vp.MapConfig(), seed=0)


@pytest.fixture(scope="session")
def demo_world(demo_map):
    """Default world of the bundled scene."""
    import vprism_plan as vp

    return vp.World(demo_map)


@pytest.fixture(scope="session")
def flat_world():
    """World of the bundled scene as a map sees it that guesses nothing."""
    import vprism_plan as vp

    return vp.World(vp.fit_map(vp.load_observation(vp_data("demo_scene")), prior=None))


def vp_data(name: str) -> Path:
    """Path of bundled data."""
    import vprism_plan

    return Path(vprism_plan.__file__).parent / "data" / name


_BALL_URDF = """<robot name="ball">
  <link name="world"/><link name="x"/><link name="y"/><link name="ball"/>
  {joints}
</robot>"""
_SLIDE = """<joint name="{n}" type="prismatic"><parent link="{p}"/><child link="{c}"/>
  <axis xyz="{a}"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>"""


@pytest.fixture(scope="session")
def ball_robot(tmp_path_factory):
    """A function that makes a sphere of a given radius (metres) that moves freely in space."""
    import vprism_plan as vp

    chain = [("x", "world", "x", "1 0 0"), ("y", "x", "y", "0 1 0"), ("z", "y", "ball", "0 0 1")]
    joints = "\n".join(_SLIDE.format(n=n, p=p, c=c, a=a) for n, p, c, a in chain)
    path = tmp_path_factory.mktemp("robots") / "ball.urdf"
    path.write_text(_BALL_URDF.format(joints=joints))

    def make(radius: float):
        spheres = {"ball": [{"center": [0.0, 0.0, 0.0], "radius": radius}]}
        return vp.Robot.from_urdf(path, spheres=spheres)

    return make
