# SPDX-License-Identifier: BSD-3-Clause
"""The learned baseline: its layers against a slow oracle, its training, what it ships with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import pointconv_oracle as oracle

from experiments.baselines.pointsdf import LEVEL, fit
from experiments.baselines.pointsdf import data as pd
from experiments.baselines.pointsdf import training as tr
from experiments.baselines.pointsdf.cloud import farthest_first, prepare_cloud
from experiments.baselines.pointsdf.model import Architecture, PointConv, PointSDF
from experiments.baselines.pointsdf.reconstruction import reconstruct
from experiments.baselines.pointsdf.shapes import assembly, training_scene
from experiments.baselines.pointsdf.weights import (
    SHIPPED,
    load_network,
    save_network,
)
from vprism_plan.errors import ConfigError, MapError, ObservationError
from vprism_plan.perception import Observation, Plane
from vprism_plan.simulation import random_scene

TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
TINY = Architecture(
    cloud=32, centers=(12, 6), neighbours=4, features=(8, 8, 16), kernels=4, width=24, depth=3
)


@pytest.fixture(scope="module")
def views():
    return training_scene(190_900, views=2)


@pytest.fixture(scope="module")
def examples(views):
    return pd.examples_of(views, seed=1, points=TINY.cloud, queries=96)


@pytest.fixture(scope="module")
def scene():
    return random_scene(4, 190_901)


@pytest.fixture(scope="module")
def found(scene):
    return fit(scene.observation, 0)


def object_points(scene, k=1):
    points, labels = scene.observation.points()
    return points[labels == k]


# ------------------------------------------------------------------ the cloud


def test_order_of_the_points_does_not_matter(scene):
    points = object_points(scene)
    shuffled = np.random.default_rng(0).permutation(points)
    a, b = (prepare_cloud(p, TABLE, scene.camera.center, 64) for p in (points, shuffled))
    np.testing.assert_array_equal(a[0], b[0])
    np.testing.assert_array_equal(a[1].context, b[1].context)
    assert a[1].scale == b[1].scale


def test_cloud_is_centred_scaled_and_seen_along_x(scene):
    points = object_points(scene)
    cloud, frame = prepare_cloud(points, TABLE, scene.camera.center, 256)
    # Of the sampled points, the farthest is first chosen or among the next few.
    assert np.linalg.norm(cloud, axis=1).max() == pytest.approx(1.0, abs=0.05)
    assert frame.rotation @ frame.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    camera = frame.to_object(scene.camera.center[None])[0]
    assert camera[0] < 0 < camera[2]
    # Level to the mean of the points; the middle of their box is a little beside it.
    assert abs(camera[1]) < 0.05 * abs(camera[0])
    back = frame.to_world(frame.to_object(points))
    np.testing.assert_allclose(back, points, atol=1e-12)
    heights = cloud[:, 2] * frame.scale + frame.height
    np.testing.assert_allclose(heights, frame.to_world(cloud)[:, 2], atol=1e-6)


@settings(max_examples=8)
@given(angle=st.floats(-3.1, 3.1), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_turning_and_moving_the_scene_changes_nothing(scene, angle, x, y):
    points = object_points(scene)[::7]
    c, s = np.cos(angle), np.sin(angle)
    turn, shift = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, 0.0])
    _, a = prepare_cloud(points, TABLE, scene.camera.center, 32)
    moved = scene.camera.center @ turn.T + shift
    _, b = prepare_cloud(points @ turn.T + shift, TABLE, moved, 32)
    np.testing.assert_allclose(a.context, b.context, atol=1e-5)
    np.testing.assert_allclose([a.lower, a.upper], [b.lower, b.upper], atol=1e-5)
    np.testing.assert_allclose(a.center @ turn.T + shift, b.center, atol=1e-6)


@settings(max_examples=15)
@given(n=st.integers(1, 40), size=st.integers(1, 50), seed=st.integers(0, 1000))
def test_farthest_first_takes_the_farthest_each_time(n, size, seed):
    points = np.random.default_rng(seed).normal(size=(n, 3))
    order = farthest_first(points, size)
    assert len(order) == size
    taken = order[: min(n, size)]
    assert len(set(taken.tolist())) == len(taken)
    for i in range(1, len(taken)):
        gaps = [min(np.sum((p - points[j]) ** 2) for j in taken[:i]) for p in points]
        assert gaps[taken[i]] == pytest.approx(max(gaps))
    np.testing.assert_array_equal(order, np.resize(taken, size))


def test_stray_points_are_left_out_and_single_points_are_not():
    wall = np.stack(np.meshgrid([0.0], np.arange(20), np.arange(20)), -1).reshape(-1, 3) * 0.002
    stray = np.array([[0.2, 0.02, 0.1]])
    camera = np.array([-1.0, 0.0, 0.5])
    _, with_stray = prepare_cloud(np.concatenate([wall, stray]), TABLE, camera, 16)
    assert with_stray.scale < 0.03
    cloud, single = prepare_cloud(stray, TABLE, camera, 16)
    assert cloud.shape == (16, 3)
    assert np.isfinite(single.context).all()
    from_above, _ = prepare_cloud(wall, TABLE, wall.mean(axis=0) + np.array([0, 0, 1]), 16)
    assert np.isfinite(from_above).all()
    with pytest.raises(ObservationError, match="without a single point"):
        prepare_cloud(np.zeros((0, 3)), TABLE, camera, 16)


# ------------------------------------------------------------------ the network


def layers_of(sequence):
    linear = [m for m in sequence if isinstance(m, torch.nn.Linear)]
    return [(m.weight.detach().numpy(), m.bias.detach().numpy()) for m in linear]


@pytest.mark.parametrize("centers", [5, None])
def test_point_convolution_is_its_definition(centers):
    torch.manual_seed(3)
    layer = PointConv(2, 7, centers=centers, neighbours=4, kernels=3, bandwidth=0.3).double()
    points, features = torch.randn(2, 9, 3).double(), torch.randn(2, 9, 2).double()
    points[1, 8] = points[1, 7]  # clouds of few points are repeated
    at, got = layer(points, features)
    assert at.shape == (2, centers or 1, 3)
    for b in range(2):
        want = oracle.pointconv(
            points[b].numpy(), features[b].numpy(), centers, 4, 0.3,
            layers_of(layer.lift), layers_of(layer.weigh), layers_of(layer.dense),
            layers_of([layer.mix])[0], layers_of_norm(layer.norm),
        )  # fmt: skip
        np.testing.assert_allclose(got[b].detach().numpy(), want, atol=1e-9)


def layers_of_norm(norm):
    return norm.weight.detach().numpy(), norm.bias.detach().numpy()


def test_every_weight_gets_a_gradient():
    torch.manual_seed(0)
    model = PointSDF(TINY)
    logits = model(torch.randn(3, 32, 3), torch.randn(3, 3), torch.randn(3, 50, 3))
    assert logits.shape == (3, 50)
    logits.square().sum().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().sum() > 0, name


def test_the_head_is_told_the_offset_from_what_was_seen():
    torch.manual_seed(2)
    model = PointSDF(replace(TINY, nearest=3, octaves=1))
    context, cloud, queries = torch.randn(1, 3), torch.randn(1, 32, 3) / 9, torch.randn(1, 5, 3)
    told = model._told(context, cloud, queries)[0].numpy()
    for row, q in zip(told, queries[0].numpy(), strict=True):
        offsets = sorted((q - p for p in cloud[0].numpy()), key=np.linalg.norm)[:3]
        height = q[2] + context[0, 1].item()
        want = [*q, height, *np.sin(q * np.pi / 2), *np.cos(q * np.pi / 2)]
        for d in (offsets[0], np.mean(offsets, axis=0)):
            want += [np.clip(4 * v, -2, 2) for v in (*d, np.linalg.norm(d))]
        np.testing.assert_allclose(row, want, atol=1e-5)
    published = PointSDF(replace(TINY, nearest=0, octaves=0))
    assert published._told(context, cloud, queries).shape == (1, 5, 4)
    with pytest.raises(ConfigError, match="nearest is 33"):
        replace(TINY, nearest=33)


def test_later_points_of_equal_layers_may_change_places():
    """Beyond the centres, order has no meaning to the network."""
    torch.manual_seed(1)
    model = PointSDF(TINY)
    cloud, context = torch.randn(1, 32, 3), torch.randn(1, 3)
    order = torch.cat([torch.arange(12), 12 + torch.randperm(20)])
    a, b = model.embed(cloud, context), model.embed(cloud[:, order], context)
    torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_architectures_that_cannot_work_are_refused():
    with pytest.raises(ConfigError, match="each layer must keep"):
        Architecture(cloud=64)
    with pytest.raises(ConfigError, match="depth is 1"):
        Architecture(depth=1)
    assert Architecture.from_dict(TINY.to_dict()) == TINY


# ------------------------------------------------------------------ examples and training


def test_examples_say_the_truth_of_their_queries(views, examples):
    shown = [k for view in views for k in view.observation.object_ids]
    assert len(examples) <= len(shown)
    assert examples.clouds.shape[1:] == (TINY.cloud, 3)
    assert 0.05 < examples.inside.mean() < 0.6
    again = pd.examples_of(views, seed=1, points=TINY.cloud, queries=96)
    np.testing.assert_array_equal(again.queries, examples.queries)
    only = pd.examples_of(views, seed=1, points=TINY.cloud, queries=96, only={1})
    assert 0 < len(only) < len(examples)
    points, labels = views[0].observation.points()
    own = points[labels == 1]
    _, frame = prepare_cloud(own, TABLE, views[0].camera.center, TINY.cloud)
    world = frame.to_world(only.queries[0].astype(float))
    truth = views[0].object_of(world) == 1
    # The example's table is off by a millimetre or so, which moves the frame's height alone.
    assert (truth == only.inside[0]).mean() > 0.95


def test_examples_survive_a_file(examples, tmp_path):
    examples.save(tmp_path / "a.npz")
    back = pd.Examples.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.inside, examples.inside)
    assert back.queries.dtype == np.float16
    with pytest.raises(ConfigError, match="no examples to join"):
        pd.Examples.joined([])


@pytest.mark.parametrize("seed", range(8))
def test_assemblies_rest_on_the_table(seed):
    body = assembly(np.random.default_rng(seed))
    lowest = min(solid.surface_points(0.004)[:, 2].min() for solid in body)
    assert -0.003 < lowest < 0.003


def test_training_learns_and_repeats_to_the_bit(examples):
    schedule = tr.Schedule(
        steps=24, batch=8, queries=64, warmup=4, average=0.8, check_every=12, rate=5e-3
    )
    (a, looks), (b, _) = (tr.train(examples, {"same": examples}, TINY, schedule) for _ in range(2))
    assert looks[-1].loss < 0.9 * np.log(2)
    assert looks[-1].loss < looks[0].loss
    for name, weight in a.state_dict().items():
        assert torch.equal(weight, b.state_dict()[name]), name
    other, _ = tr.train(examples, {"same": examples}, TINY, replace(schedule, steps=2, seed=1))
    assert not torch.equal(other.last.weight, a.last.weight)
    with pytest.raises(ConfigError, match="validation set"):
        tr.train(examples, {}, TINY, schedule)


def test_calibration_lowers_the_cross_entropy_and_meets_the_mean(examples):
    torch.manual_seed(5)
    model = PointSDF(TINY)
    y = examples.inside.ravel()

    def entropy(network):
        z = tr.logits(network, examples).ravel().astype(float)
        return (np.logaddexp(0, z) - y * z).mean(), 1 / (1 + np.exp(-z))

    better = tr.calibrated(model, examples)
    before, _ = entropy(model)
    after, p = entropy(better)
    assert after < before
    assert p.mean() == pytest.approx(y.mean(), abs=1e-3)


def test_iou_is_that_of_a_loop_over_objects(examples):
    torch.manual_seed(6)
    model = tr.calibrated(PointSDF(TINY), examples)
    p = 1 / (1 + np.exp(-tr.logits(model, examples)))
    want = []
    for row, inside in zip(p, examples.inside, strict=True):
        both = sum(a >= 0.25 and b for a, b in zip(row, inside, strict=True))
        either = sum(a >= 0.25 or b for a, b in zip(row, inside, strict=True))
        want.append(both / either if either else 1.0)
    assert tr.mean_iou(model, examples, (0.25,)) == pytest.approx((np.mean(want),))


def test_mirroring_and_turning_keep_queries_where_they_are_in_the_cloud(examples):
    clouds, contexts, queries = tr.varied(
        examples, tr.Schedule(stretch=0.0), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(contexts, examples.contexts)
    before = np.linalg.norm(examples.clouds[:, :5] - examples.queries[:, :5].astype(float), axis=2)
    after = np.linalg.norm(clouds[:, :5] - queries[:, :5], axis=2)
    np.testing.assert_allclose(after, before, atol=1e-5)
    np.testing.assert_array_equal(clouds[..., 2], examples.clouds[..., 2])
    assert np.abs(clouds - examples.clouds).max() > 0.05


# ------------------------------------------------------------------ what is shipped


def test_shipped_network_beats_the_box_around_what_is_seen(scene, found):
    assert SHIPPED.stat().st_size < 1_000_000
    assert found.object_ids == scene.observation.object_ids
    grid = np.stack(np.meshgrid(*[np.arange(-0.3, 0.3, 0.012)] * 2, np.arange(0.006, 0.25, 0.012)))
    points = grid.reshape(3, -1).T
    true, proba = scene.object_of(points), found.predict_proba(points)
    network, box = [], []
    for column, k in enumerate(found.object_ids, 1):
        own = object_points(scene, k)
        low, high = own.min(axis=0), own.max(axis=0)
        low[2] = 0.0
        boxed = ((points >= low) & (points <= high)).all(axis=1)
        for ious, inside in ((network, proba[:, column] >= LEVEL), (box, boxed)):
            ious.append((inside & (true == k)).sum() / (inside | (true == k)).sum())
    assert np.mean(network) > np.mean(box)
    assert np.mean(network) > 0.6


def test_batches_answer_as_single_points_do(scene, found):
    rng = np.random.default_rng(2)
    points = rng.uniform([-0.2, -0.2, -0.01], [0.2, 0.2, 0.2], (5000, 3))
    proba = found.predict_proba(points)
    some = rng.choice(len(points), 40, replace=False)
    single = np.concatenate([found.predict_proba(points[i : i + 1]) for i in some])
    np.testing.assert_allclose(proba[some], single, atol=1e-6)
    np.testing.assert_allclose(proba[:, 0], (1 - proba[:, 1:]).prod(axis=1), atol=1e-12)
    assert ((proba >= 0) & (proba <= 1)).all()
    far = found.predict_proba(np.array([[5.0, 0.0, 0.1]]))
    np.testing.assert_array_equal(far, [[1.0] + [0.0] * len(found.object_ids)])
    assert found.predict_proba(np.zeros((0, 3))).shape == (0, 1 + len(found.object_ids))
    np.testing.assert_array_equal(fit(scene.observation, 0).predict_proba(points), proba)


def test_wrong_input_is_named(scene, found):
    with pytest.raises(MapError, match=r"shape \(3,\)"):
        found.predict_proba(np.zeros(3))
    obs = scene.observation
    with pytest.raises(ObservationError, match="no labels"):
        fit(Observation(obs.depth, None, obs.intrinsics, obs.T_world_camera), 0)


def test_weights_survive_a_file_and_bad_files_are_named(tmp_path, scene):
    torch.manual_seed(0)
    model = PointSDF(TINY).eval()
    save_network(model, tmp_path / "a.safetensors", {"data": "none"})
    back, history = load_network(tmp_path / "a.safetensors")
    assert history == {"data": "none"}
    assert back.architecture == TINY
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    a, b = (reconstruct(scene.observation, 0, m).predict_proba(points) for m in (model, back))
    np.testing.assert_array_equal(a, b)
    with pytest.raises(MapError, match="train_pointsdf"):
        load_network(tmp_path / "missing.safetensors")
    (tmp_path / "b.safetensors").write_bytes(b"not weights")
    with pytest.raises(MapError, match="damaged"):
        load_network(tmp_path / "b.safetensors")
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(2)}, tmp_path / "c.safetensors")
    with pytest.raises(MapError, match="no PointSDF weights of version"):
        load_network(tmp_path / "c.safetensors")


def test_shipped_weights_say_how_they_came_about():
    model, history = load_network()
    assert history["schedule"]["seed"] == 0
    assert history["data"]["solids"][0] >= 100_000
    assert "359" in history["data"]["objects"]
    assert sum(p.numel() for p in model.parameters()) < 250_000
