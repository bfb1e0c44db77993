"""A part too thin for the map's kernels was still seen, so it must stop the robot."""

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box


def upright(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = [x, y, z]
    return pose


def scene_with_a_thin_bar(noise=None):
    """A box with a 4 mm bar standing out from its top, both labelled as one object."""
    box = Box((0.04, 0.04, 0.05), pose=upright(0.0, 0.0, 0.05))
    bar = Box((0.002, 0.15, 0.002), pose=upright(0.0, 0.1, 0.13))
    camera = Camera.orbit(np.array([0.0, 0.05, 0.08]), 0.7, np.pi, 0.6)
    return Scene((box, bar), (1, 1), camera, noise, 3), bar


def test_a_thin_bar_that_was_seen_is_an_obstacle_even_where_the_map_says_free():
    scene, bar = scene_with_a_thin_bar(DepthNoise())
    m = vp.fit_map(scene.observation)
    world = vp.World(m, vp.WorldConfig(occluded="free"))
    points, labels = scene.observation.points()
    on_bar = points[(labels == 1) & (np.abs(bar.signed_distance(points)) < 0.004)]
    on_bar = on_bar[on_bar[:, 1] > 0.08]
    assert len(on_bar) > 100
    missed = on_bar[m.occupancy(on_bar) < world.config.level]
    assert len(missed) > 20  # else this test would test nothing
    # One voxel is what the level set itself may lack beside a seen point.
    assert world.field.lower_bound(missed).max() <= 2 * world.config.resolution
    assert (world.field.lower_bound(on_bar) <= 0.0).mean() > 0.5


@pytest.mark.slow
def test_flying_pixels_are_no_forgotten_surfaces():
    from vprism_plan.simulation.scenes import demo_scene

    scene = demo_scene()
    world = vp.World(vp.fit_map(scene.observation), vp.WorldConfig(occluded="free"))
    rng = np.random.default_rng(0)
    lower, upper = world.grid.origin, world.grid.upper
    points = rng.uniform(lower, upper, (20_000, 3))
    far = points[scene.signed_distance(points, table=True) > 0.08]
    assert (world.field.lower_bound(far) > 0.0).mean() > 0.999


def test_contacts_allowed_with_an_object_include_its_thin_parts():
    scene, bar = scene_with_a_thin_bar()
    world = vp.World(vp.fit_map(scene.observation), vp.WorldConfig(occluded="free"))
    at = bar.center + np.array([0.0, 0.1, 0.0])
    assert world.field.lower_bound(at[None])[0] <= 0.005
    assert world.fields_without([1]).lower_bound(at[None])[0] > 0.03
