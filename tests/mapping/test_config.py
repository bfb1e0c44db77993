# SPDX-License-Identifier: BSD-3-Clause
"""Parameters: the paper's table, what is refused, and what the prior means."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig
from vprism_plan.mapping.em import empty_logit, prior_means
from vprism_plan.mapping.prediction import class_log_probabilities


def test_paper_holds_table_three():
    paper = MapConfig.paper()
    assert (paper.gamma, paper.surface_hinges, paper.iterations) == (1000.0, 32, 3)
    assert (paper.hinge_spacing, paper.object_radius) == (0.05, 0.25)
    assert (paper.object_resolution, paper.empty_resolution) == (0.01, 0.015)
    assert paper.front_distance is None
    assert paper.prior_occupancy is None
    assert paper.weight_variance == 1e4


def test_the_paper_follows_no_default():
    """Answers of the paper's preset are kept without its settings: no default may change them."""
    given = []

    class Recorder(MapConfig):
        def __init__(self, **settings):
            given.append(settings)

    Recorder.paper()
    assert list(given[0]) == [field.name for field in dataclasses.fields(MapConfig)]
    assert MapConfig.paper() == MapConfig(**given[0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gamma", 0.0), ("gamma", float("nan")), ("gamma", True), ("iterations", 0),
        ("iterations", 2.5), ("relaxation", 2.0), ("hinge_spacing", -0.05), ("kernel_cutoff", 1.0),
        ("prior_occupancy", 0.0), ("prior_occupancy", 1.0), ("surface_hinges", -1),
        ("bias_variance", float("inf")), ("hinge_shift", (0.0, 1.0)),
        ("hinge_shift", (0.0, 0.0, float("nan"))), ("prior_logit_variance", None),
        ("prior_weight_variance", 100.0), ("max_points", 0), ("ray_step", "10cm"),
        ("ray_sampling", "stratify"), ("object_resolution", 0.0), ("empty_resolution", -0.01),
    ],
)  # fmt: skip
def test_an_invalid_value_is_named(name, value):
    # Under the suite's type checks a value of a wrong type is refused before ours looks.
    with pytest.raises((ConfigError, TypeError), match=name):
        MapConfig(**{name: value})


def test_a_wrong_type_is_named_without_type_checks_too():
    for name, value in (("iterations", 2.5), ("gamma", True), ("ray_step", "10cm")):
        config = object.__new__(MapConfig)
        for field in dataclasses.fields(MapConfig):
            object.__setattr__(config, field.name, field.default)
        object.__setattr__(config, name, value)
        with pytest.raises(ConfigError, match=name):
            config.__post_init__()


def test_it_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        MapConfig().gamma = 2.0


def test_the_fine_lattice_leaves_next_to_no_trace():
    """The prior logit variance at a node and at a cell centre differ by a few percent."""
    config = MapConfig.fine()
    assert config.hinge_spacing <= 1.3 * config.kernel_length
    axis = config.hinge_spacing * np.arange(-8, 9)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]]) * config.hinge_spacing
    square = ((points[:, None] - nodes[None]) ** 2).sum(2)
    at_node, at_centre = (np.exp(-config.gamma * square) ** 2).sum(1)
    assert at_centre == pytest.approx(at_node, rel=0.04)


@pytest.mark.parametrize("spacing", [0.02, 0.03, 0.04, 0.05])
def test_mean_feature_sums_are_those_of_a_lattice(spacing):
    config = MapConfig(hinge_spacing=spacing)
    axis = spacing * np.arange(-12, 13)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = np.random.default_rng(0).uniform(-spacing / 2, spacing / 2, (500, 3))
    square = ((points[:, None] - nodes[None]) ** 2).sum(2)
    phi = np.exp(-config.gamma * square)
    assert phi.sum(1).mean() == pytest.approx(config.mean_feature_sum, rel=0.05)
    assert (phi**2).sum(1).mean() == pytest.approx(config.mean_squared_feature_sum, rel=0.1)
    assert config.weight_variance * (phi**2).sum(1).mean() == pytest.approx(
        config.logit_variance, rel=0.1
    )


@given(occupancy=st.floats(0.01, 0.99), classes=st.integers(2, 20), variance=st.floats(0.0, 1e4))
def test_a_flat_posterior_means_the_same_for_every_number_of_objects(occupancy, classes, variance):
    mean = torch.zeros(1, classes, dtype=torch.float64)
    mean[0, 0] = empty_logit(occupancy, classes, variance)
    log_p = class_log_probabilities(mean, torch.full_like(mean, variance))
    flat = log_p[:, 1:].exp().sum(dim=1)
    assert float(flat[0]) == pytest.approx(occupancy, rel=1e-9)


def test_without_a_prior_occupancy_the_means_are_zero():
    assert prior_means(MapConfig.paper(), 5) == (0.0, 0.0)
