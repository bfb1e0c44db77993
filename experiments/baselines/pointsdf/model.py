# SPDX-License-Identifier: BSD-3-Clause
"""The network: a PointConv encoder of a partial cloud, and a head that answers query points.

PointSDF (Van der Merwe et al. 2020, arXiv 1910.00983) embeds a partial cloud by four PointConv
layers (Wu, Qi and Fuxin 2019, arXiv 1811.07246) and lets a fully connected network map the
embedding and a query point to a signed distance, with a skip connection half way. Here, as in
the comparison of V-PRISM, a sigmoid comes last and the answer is the probability that the query
lies inside. This one is sized for a CPU: three PointConv layers, the last over the whole cloud,
and layer normalisation, which unlike the original's batch normalisation answers an object the
same whatever stands beside it.

One thing is added in the competitor's favour: the head is also told where the query lies from
the observed points nearest to it. Through the embedding alone it takes days on a GPU to learn
to draw what was seen sharply; `Architecture(nearest=0, octaves=0)` is the published form.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from experiments.baselines.pointsdf.cloud import CONTEXT
from experiments.stored import Stored
from vprism_plan.errors import ConfigError


@dataclass(frozen=True)
class Architecture(Stored):
    """Sizes of the network.

    Attributes:
        cloud: points that an object is given by.
        centers: points that the first and the second layer keep.
        neighbours: that a centre sees in each of them.
        features: of the first, second and last layer.
        kernels: functions of the relative position that weigh the neighbours.
        width: of the head's layers.
        depth: number of the head's layers before the last; the input enters again half way.
        bandwidths: of the density estimate of each layer, in the network's coordinates.
        nearest: observed points that the head is told a query's offset from (the nearest one,
            and the mean over these); 0: none, as published.
        octaves: of sines and cosines that a query's coordinates are also given as; 0: none, as
            published.
    """

    cloud: int = 256
    centers: tuple[int, int] = (96, 24)
    neighbours: int = 16
    features: tuple[int, int, int] = (48, 80, 116)
    kernels: int = 8
    width: int = 128
    depth: int = 6
    bandwidths: tuple[float, float, float] = (0.1, 0.2, 0.4)
    nearest: int = 4
    octaves: int = 2

    def __post_init__(self) -> None:
        first, second = self.centers
        if not self.cloud >= first >= second >= 1 or not 1 <= self.neighbours <= second:
            raise ConfigError(
                f"cloud {self.cloud}, centers {self.centers}, neighbours {self.neighbours}: each "
                "layer must keep at most the points before it and see at most those it is given"
            )
        if not 0 <= self.nearest <= self.cloud or self.octaves < 0:
            raise ConfigError(
                f"nearest is {self.nearest}, octaves {self.octaves}; give 0 or more, and at most "
                f"the {self.cloud} points of the cloud"
            )
        if self.depth < 2:
            raise ConfigError(f"depth is {self.depth}; the head needs at least 2 layers")


_OFFSET_GAIN = 4.0

# Of every centre the indices of its neighbours (b, m, k), or None for "all points"; and their
# relative sparsity (b, m, k, 1).
Surroundings = tuple[Tensor | None, Tensor]


class PointConv(nn.Module):
    """A convolution over a point set whose weights are functions of relative position.

    Of the neighbours k of a centre, with lifted features h_k, inverse densities s_k and
    weights w_k = W(x_k - x), the outer products s_k h_k w_k^T are summed and mapped linearly:
    the reordered form of the convolution in section 3.2 of Wu et al., which needs no weight
    matrix per neighbour.

    The centres are the first `centers` points given: they come farthest first, so that these
    are what farthest point sampling would choose. None: one centre, at the origin, that
    sees everything.
    """

    def __init__(
        self,
        features: int,
        out: int,
        *,
        centers: int | None,
        neighbours: int,
        kernels: int,
        bandwidth: float,
    ) -> None:
        super().__init__()
        self.centers, self.neighbours, self.bandwidth = centers, neighbours, bandwidth
        hidden = max(32, (features + out) // 3)
        self.lift = nn.Sequential(nn.Linear(3 + features, hidden), nn.ReLU())
        self.weigh = nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, kernels), nn.ReLU())
        self.dense = nn.Sequential(nn.Linear(1, 8), nn.ReLU(), nn.Linear(8, 1), nn.Sigmoid())
        self.mix = nn.Linear(hidden * kernels, out)
        self.norm = nn.LayerNorm(out)

    def surroundings(self, points: Float[Tensor, "b n 3"]) -> Surroundings:
        """Return who neighbours whom and how thinly: only distances between points matter."""
        sparse = self._inverse_density(points)
        if self.centers is None:
            index = None
            sparse = sparse[:, None]
        else:
            index = nearest(points[:, : self.centers], points, self.neighbours)
            sparse = gather(sparse, index)
        # Relative to the sparsest neighbour, as only differences between neighbours matter.
        return index, sparse / sparse.amax(dim=2, keepdim=True)

    def forward(
        self,
        points: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n f"],
        surroundings: Surroundings | None = None,
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m out"]]:
        """Return the centres and their features; `surroundings` if they are known already."""
        index, sparse = self.surroundings(points) if surroundings is None else surroundings
        if index is None:
            centers = points.new_zeros(len(points), 1, 3)
            offset, seen = points[:, None], torch.cat([points, features], -1)[:, None]
        else:
            centers = points[:, : index.shape[1]]
            offset = gather(points, index) - centers[:, :, None]
            seen = torch.cat([offset, gather(features, index)], -1)
        lifted = self.lift(seen) * self.dense(sparse)
        kernel = self.weigh(offset / self._reach(offset))
        outer = torch.einsum("bmkc,bmkw->bmcw", lifted, kernel) / lifted.shape[2]
        return centers, torch.relu(self.norm(self.mix(outer.flatten(2))))

    def _inverse_density(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 1"]:
        """One over a Gaussian kernel density estimate (up to a constant factor)."""
        square = distances(points, points).square()
        # Below exp(-20) nothing counts, and subnormal numbers are slow.
        density = torch.exp((square / (-2.0 * self.bandwidth**2)).clamp_min(-20.0)).mean(dim=2)
        return (1.0 / density)[..., None]

    @staticmethod
    def _reach(offset: Float[Tensor, "b m k 3"]) -> Float[Tensor, "b 1 1 1"]:
        """Typical distance of a cloud's neighbours: the weights' unit of length."""
        return offset.square().sum(-1).mean(dim=(1, 2)).sqrt().clamp_min(1e-3)[:, None, None, None]


class PointSDF(nn.Module):
    """Partial cloud and query points in, logit of "inside" out."""

    def __init__(self, architecture: Architecture | None = None) -> None:
        super().__init__()
        a = architecture or Architecture()
        self.architecture = a
        given = (4, a.features[0], a.features[1])
        self.encoder = nn.ModuleList(
            PointConv(
                given[i], a.features[i], centers=(*a.centers, None)[i],
                neighbours=a.neighbours, kernels=a.kernels, bandwidth=a.bandwidths[i],
            )
            for i in range(3)
        )  # fmt: skip
        half = a.width // 2
        told = 4 + 6 * a.octaves + (8 if a.nearest else 0)
        self.query = nn.Sequential(
            nn.Linear(told, half), nn.ReLU(), nn.Linear(half, half), nn.ReLU()
        )
        self.cloud_in = nn.Linear(a.features[2] + CONTEXT, a.width)
        self.query_in = nn.Linear(half, a.width, bias=False)
        self.cloud_skip = nn.Linear(a.features[2] + CONTEXT, a.width)
        self.query_skip = nn.Linear(half, a.width, bias=False)
        self.layers = nn.ModuleList(nn.Linear(a.width, a.width) for _ in range(a.depth - 1))
        self.last = nn.Linear(a.width, 1)

    def surroundings(self, cloud: Float[Tensor, "b n 3"]) -> list[Surroundings]:
        """Return what each layer finds near its centres; turning or mirroring changes nothing."""
        found, points = [], cloud
        for layer in self.encoder:
            assert isinstance(layer, PointConv)
            found.append(layer.surroundings(points))
            points = points[:, : layer.centers]
        return found

    def embed(
        self,
        cloud: Float[Tensor, "b n 3"],
        context: Float[Tensor, "b c"],
        surroundings: Sequence[Surroundings] | None = None,
    ) -> Float[Tensor, "b e"]:
        """Return the embedding of clouds in their normalised frame, farthest point first."""
        points, features = cloud, with_height(cloud, context)
        for i, layer in enumerate(self.encoder):
            points, features = layer(
                points, features, None if surroundings is None else surroundings[i]
            )
        return torch.cat([features[:, 0], context], dim=-1)

    def answer(
        self,
        embedding: Float[Tensor, "b e"],
        cloud: Float[Tensor, "b n 3"],
        queries: Float[Tensor, "b q 3"],
    ) -> Float[Tensor, "b q"]:
        """Return the logit that each query (normalised frame) lies inside its object."""
        asked = self.query(self._told(embedding[:, -CONTEXT:], cloud, queries))
        # The first layer of [embedding, query] in two parts: the embedding's once per object.
        x = torch.relu(self.query_in(asked) + self.cloud_in(embedding)[:, None])
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i == len(self.layers) // 2:
                x = x + self.query_skip(asked) + self.cloud_skip(embedding)[:, None]
            x = torch.relu(x)
        return self.last(x)[..., 0]

    def forward(
        self,
        cloud: Float[Tensor, "b n 3"],
        context: Float[Tensor, "b c"],
        queries: Float[Tensor, "b q 3"],
        surroundings: Sequence[Surroundings] | None = None,
    ) -> Float[Tensor, "b q"]:
        """Embed and answer."""
        return self.answer(self.embed(cloud, context, surroundings), cloud, queries)

    def _told(
        self,
        context: Float[Tensor, "b c"],
        cloud: Float[Tensor, "b n 3"],
        queries: Float[Tensor, "b q 3"],
    ) -> Float[Tensor, "b q t"]:
        """Everything the head is told of a query: place, height, waves, offsets."""
        told = [with_height(queries, context)]
        for octave in range(self.architecture.octaves):
            angle = queries * (math.pi * 2.0 ** (octave - 1))
            told += [angle.sin(), angle.cos()]
        if self.architecture.nearest:
            index = nearest(queries, cloud, self.architecture.nearest)
            offset = queries[:, :, None] - gather(cloud, index)
            length = offset.norm(dim=-1, keepdim=True)
            closest = length.argmin(dim=2, keepdim=True)
            for d in (offset.take_along_dim(closest, 2)[:, :, 0], offset.mean(dim=2)):
                away = torch.cat([d, d.norm(dim=-1, keepdim=True)], dim=-1)
                # Fine near the surface; how far is far does not matter.
                told.append((_OFFSET_GAIN * away).clamp(-2.0, 2.0))
        return torch.cat(told, dim=-1)


def with_height(
    points: Float[Tensor, "b n 3"], context: Float[Tensor, "b c"]
) -> Float[Tensor, "b n 4"]:
    """Append each point's height above the table, in units of the cloud's scale."""
    return torch.cat([points, points[..., 2:] + context[:, None, 1:2]], dim=-1)


def distances(a: Float[Tensor, "b m 3"], b: Float[Tensor, "b n 3"]) -> Float[Tensor, "b m n"]:
    """Distances by differences: exactly zero for duplicates, unlike the expanded square."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def nearest(a: Float[Tensor, "b m 3"], b: Float[Tensor, "b n 3"], k: int) -> Tensor:
    """Indices (b, m, k) of the k points of `b` nearest to each of `a`."""
    with torch.no_grad():
        return distances(a, b).topk(k, dim=2, largest=False, sorted=False).indices


def gather(values: Float[Tensor, "b n f"], index: Tensor) -> Float[Tensor, "b m k f"]:
    """Return values[b, index[b, m, k]]."""
    rows = torch.arange(len(values))[:, None, None]
    return values[rows, index.long()]
