"""Pictures of risk, entropy and margins show the library's own numbers, whole and readable."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

import vprism_plan as vp
from vprism_plan.collision.margins import margin_profile
from vprism_plan.viz import margin_figure, risk_figure, save_figure
from vprism_plan.viz.plan_plot import GOAL_COLOR, HAND_COLOR, START_COLOR
from vprism_plan.viz.risk_plot import _cut, _horizontal, _Sweep, body_style, densified


@pytest.fixture(scope="module")
def checker(demo_world, repository):
    base = np.eye(4)
    base[:3, 3] = [-0.535, -0.2, 0.0]
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)
    config = vp.CheckerConfig(margin=0.005, allowed_contacts={"hand": {1}})
    return vp.CollisionChecker(demo_world, robot, config)


@pytest.fixture(scope="module")
def path(checker):
    """A sweep of the hand through the objects, low over the table."""
    low = checker.robot.neutral.copy()
    low[1], low[3], low[5] = 0.5, -1.9, 2.4
    return np.stack([low + turn * np.eye(7)[0] for turn in (0.0, 0.4, 0.8)])


def pixels(figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(float) / 255.0


def near(picture, color, tolerance=0.08) -> int:
    return int((np.abs(picture - np.asarray(color)).max(axis=-1) < tolerance).sum())


def test_every_waypoint_stays_and_steps_are_even():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0], [1.0, 3.0]])
    dense, places = densified(path, 40)
    for number, waypoint in enumerate(path):
        np.testing.assert_array_equal(dense[places == number], waypoint[None])
    steps = [np.linalg.norm(b - a) for a, b in pairwise(dense)]
    assert max(steps) == pytest.approx(0.1)
    assert places[-1] == 3.0


def test_the_drawn_sweep_is_where_spheres_cut_the_slice(demo_map):
    plane = _horizontal(demo_map, 0.1, 0.02)
    rng = np.random.default_rng(0)
    centers = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.2], (30, 3))
    radii = rng.uniform(0.02, 0.08, 30)
    inside = _cut(centers, radii, plane) > 0
    gaps = np.linalg.norm(plane.points()[:, None] - centers, axis=2) - radii
    np.testing.assert_array_equal(inside, plane.image((gaps < 0).any(axis=1)))
    assert 0 < inside.sum() < inside.size


@pytest.fixture(scope="module")
def risk(checker, path):
    return risk_figure(checker, path, height=0.12, resolution=0.01, title="sweep")


@pytest.mark.slow
def test_the_risk_picture_shows_map_sweep_and_curves(checker, path, risk):
    picture = pixels(risk)
    for color in (START_COLOR, GOAL_COLOR, HAND_COLOR):
        assert near(picture, color) > 300
    assert near(picture, (0.99, 0.91, 0.14)) > 1000  # surely occupied
    assert near(picture, (0.27, 0.0, 0.33)) > 5000  # surely empty
    dense, places = densified(path, 80)
    entropy = checker.path_entropy(dense)
    estimate = checker.collision_probability(dense)
    curves = {line.get_label(): line for axis in risk.axes for line in axis.get_lines()}
    mean = curves["mean over the supported volume"]
    np.testing.assert_array_equal(mean.get_xdata(), places)
    np.testing.assert_array_equal(mean.get_ydata(), entropy.waypoint_mean)
    np.testing.assert_array_equal(curves["largest of a sphere"].get_ydata(), entropy.waypoint_max)
    alone = curves["this configuration alone"].get_ydata()
    np.testing.assert_array_equal(alone, estimate.per_waypoint)
    titles = " ".join(axis.get_title() for axis in risk.axes)
    assert f"P(collision) of the path: {estimate.probability:.3f}" in titles
    assert "12.0 cm above the table" in titles
    assert not np.isnan(entropy.swept_mean)


def test_high_above_everything_nothing_is_swept(checker, demo_map, path):
    above = _Sweep.of(checker.robot, path, _horizontal(demo_map, 0.9, 0.02))
    there = _Sweep.of(checker.robot, path, _horizontal(demo_map, 0.12, 0.02))
    assert max(above.whole.max(), above.start.max(), above.goal.max()) < 0.0
    assert (np.maximum(there.start, there.goal) <= there.whole + 1e-12).all()
    assert there.whole.max() > 0.0


def test_the_margin_picture_shows_the_librarys_numbers(checker, path, tmp_path):
    figure = margin_figure(checker, path, tolerance=0.02, title="margins")
    margins = checker.safety_margin(path, 0.02)
    texts = [text.get_text() for text in figure.axes[1].texts]
    expected = [
        f"{1000 * margin.clearance:.0f}{'*' if margin.allowed else ''}"
        for margin in margins.margins
    ]
    assert sorted(texts) == sorted(expected)
    assert any(text.endswith("*") for text in texts)
    places, profile = margin_profile(checker, path, 0.02)
    drawn = {line.get_label().rsplit(": ", 1)[0]: line for line in figure.axes[0].get_lines()}
    assert set(drawn) == set(profile)
    for body, line in drawn.items():
        np.testing.assert_allclose(line.get_xdata(), places)
        np.testing.assert_allclose(line.get_ydata(), 1000 * profile[body])
    save_figure(figure, tmp_path / "margin.png")
    assert_whole(tmp_path / "margin.png")


def test_the_risk_picture_is_saved_whole(risk, tmp_path):
    save_figure(risk, tmp_path / "risk.png")
    assert_whole(tmp_path / "risk.png")


def assert_whole(path):
    """No ink at the picture's edges: no label is cut off."""
    with Image.open(path) as image:
        ink = np.asarray(image.convert("L")) < 200
    assert not ink[:, :2].any()
    assert not ink[:, -2:].any()
    assert not ink[:2].any()
    assert not ink[-2:].any()
    assert ink.mean() > 0.02


def test_no_two_obstacles_look_alike():
    names = ["object:1", "object:2", "support surface", "background", "occluded", "unobserved"]
    styles = [body_style(name) for name in [*names, "known:shelf"]]
    assert len(set(styles)) == len(styles)
