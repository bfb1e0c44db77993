# SPDX-License-Identifier: BSD-3-Clause
"""The paper's EM as a textbook would write it: dense, float64, one formula per line.

Slow on purpose. Shares no code with the package.
"""

import math
from dataclasses import dataclass

import numpy as np


def features(
    points: np.ndarray, hinges: np.ndarray, gamma: float, radius: float = math.inf
) -> np.ndarray:
    """Equation (1): kernel values, then 1 for the bias; (N, H + 1)."""
    square = ((points[:, None, :] - hinges[None, :, :]) ** 2).sum(axis=2)
    kernel = np.exp(-gamma * square)
    kernel[square >= radius**2] = 0.0
    return np.concatenate([kernel, np.ones((len(points), 1))], axis=1)


def lam(xi: float) -> float:
    """(sigmoid(xi) - 1/2) / (2 xi), 1/8 at 0."""
    if xi == 0.0:
        return 0.125
    return (1.0 / (1.0 + math.exp(-xi)) - 0.5) / (2.0 * xi)


@dataclass
class DensePosterior:
    """Means (K, M), covariances (K, M, M) and the bound after each iteration."""

    mean: np.ndarray
    covariance: np.ndarray
    bounds: list[float]


def bouchard_right_side(z: np.ndarray, alpha: float, xi: np.ndarray) -> float:
    """Right-hand side of theorem 1."""
    total = alpha
    for z_k, xi_k in zip(z, xi, strict=True):
        total += (z_k - alpha - xi_k) / 2.0
        total += lam(xi_k) * ((z_k - alpha) ** 2 - xi_k**2)
        total += np.logaddexp(0.0, xi_k)
    return float(total)


def fit(
    phi: np.ndarray,
    labels: np.ndarray,
    prior_mean: np.ndarray,
    prior_covariance: np.ndarray,
    iterations: int,
    variational_updates: int = 1,
    offset: np.ndarray | None = None,
    members: np.ndarray | None = None,
) -> DensePosterior:
    """Algorithm 1. `prior_mean` (K, M), `prior_covariance` (K, M, M); z = offset + phi W.

    `members` (K, M): features that a class does not have are 0 for it. Around an offset it
    starts from the alpha and xi of logits of that mean and variance 1, else from xi = 1.
    """
    n, size = phi.shape
    classes = len(prior_mean)
    y = np.eye(classes)[labels]
    own = np.ones((classes, size)) if members is None else members.astype(float)
    mean = np.array(prior_mean, dtype=float)
    covariance = np.array(prior_covariance, dtype=float)
    xi = np.ones((n, classes))
    alpha = np.zeros(n)
    bounds = []
    o = np.zeros((n, classes)) if offset is None else offset
    for _ in range(0 if offset is None else variational_updates):
        alpha, xi = climb(o, np.ones_like(o), xi)
    for _ in range(iterations):
        weight = np.vectorize(lam)(xi)
        for k in range(classes):
            prior_precision = np.linalg.inv(prior_covariance[k])
            precision = prior_precision.copy()
            information = prior_precision @ prior_mean[k]
            for i in range(n):
                f = own[k] * phi[i]
                precision += 2.0 * weight[i, k] * np.outer(f, f)
                linear = y[i, k] - 0.5 + 2.0 * (alpha[i] - o[i, k]) * weight[i, k]
                information = information + linear * f
            covariance[k] = np.linalg.inv(precision)
            mean[k] = np.linalg.solve(precision, information)
        m = o + phi @ (own * mean).T
        v = np.stack(
            [np.einsum("im,mj,ij->i", phi * f, s, phi * f)
             for f, s in zip(own, covariance, strict=True)], axis=1,
        )  # fmt: skip
        for _ in range(variational_updates):
            alpha, xi = climb(m, v, xi)
        bounds.append(
            bound(y, m, v, alpha, xi) - kl(mean, covariance, prior_mean, prior_covariance)
        )
    return DensePosterior(mean, covariance, bounds)


def climb(m: np.ndarray, v: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The updates of alpha and xi for logits with these moments."""
    weight = np.vectorize(lam)(xi)
    alpha = np.empty(len(m))
    new = np.empty_like(xi)
    for i in range(len(m)):
        top = 0.5 * (m.shape[1] / 2.0 - 1.0) + (weight[i] * m[i]).sum()
        alpha[i] = top / weight[i].sum()
        new[i] = np.sqrt(v[i] + m[i] ** 2 + alpha[i] ** 2 - 2.0 * alpha[i] * m[i])
    return alpha, new


def bound(y: np.ndarray, m: np.ndarray, v: np.ndarray, alpha: np.ndarray, xi: np.ndarray) -> float:
    """E_W[sum_i ln Q(y_i | x_i, W; alpha, xi)]."""
    total = 0.0
    for i in range(len(y)):
        total += (y[i] * m[i]).sum() - alpha[i]
        for k in range(y.shape[1]):
            square = v[i, k] + (m[i, k] - alpha[i]) ** 2
            total -= (m[i, k] - alpha[i] - xi[i, k]) / 2.0
            total -= lam(xi[i, k]) * (square - xi[i, k] ** 2) + np.logaddexp(0.0, xi[i, k])
    return float(total)


def kl(mean: np.ndarray, covariance: np.ndarray, mean0: np.ndarray, cov0: np.ndarray) -> float:
    """KL(N(mean, covariance) || N(mean0, cov0)), summed over classes."""
    total = 0.0
    for k in range(len(mean)):
        inverse = np.linalg.inv(cov0[k])
        gap = mean[k] - mean0[k]
        total += 0.5 * (
            np.trace(inverse @ covariance[k])
            - len(gap)
            + gap @ inverse @ gap
            + np.linalg.slogdet(cov0[k])[1]
            - np.linalg.slogdet(covariance[k])[1]
        )
    return float(total)


def predict(phi: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Section IV-B, then normalised: (N, K)."""
    classes = len(mean)
    out = np.empty((len(phi), classes))
    for row, f in enumerate(phi):
        m = [mu @ f for mu in mean]
        v = [f @ s @ f for s in covariance]
        for k in range(classes):
            total = 2.0 - classes
            for i in range(classes):
                if i != k:
                    u = (m[k] - m[i]) / math.sqrt(1.0 + math.pi / 8.0 * (v[k] + v[i]))
                    total += 1.0 + math.exp(-u)  # 1 / sigmoid(u)
            out[row, k] = 1.0 / total
    return out / out.sum(axis=1, keepdims=True)
