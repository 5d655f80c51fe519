# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Train the network of Zhao et al. (RA-L 2021).

The network has three layers of 30 neurons. If the orientation of an anchor is unknown, it has no inputs
that need orientations. As published (section V-B), inputs are scaled, and mini-batch gradient descent
minimizes squared errors. It stops if the validation error has not fallen for five epochs in a row. The
standard deviation is that on the validation flights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import copy
from typing import Any

import numpy as np
from onnx import ModelProto
from sklearn.neural_network import MLPRegressor

from uwb_tdoa_bias.correction.features import FEATURES, columns
from uwb_tdoa_bias.effects import Samples

from ..exporting.onnx_file import GraphBuilder
from .labels import Labels

LAYERS = (30, 30, 30)
PATIENCE, MOST_EPOCHS = 5, 200
BATCH, RATE = 64, 0.005
WITHOUT = tuple(name for name in FEATURES if "_A_" not in name)  # without anchor orientations


class Paper:
    """Hold the fitted network of the paper, see `fit`."""

    def __init__(
        self,
        names: Sequence[str],
        offset: np.ndarray,
        scale: np.ndarray,
        layers: list[tuple[np.ndarray, np.ndarray]],
        std: float,
    ) -> None:
        """Store the network.

        Parameters
        ----------
        names : sequence of str
            Features.
        offset, scale : numpy.ndarray
            Scaling of the features (k,).
        layers : list
            (weights (i, o), biases (o,)) of each layer.
        std : float
            Standard deviation, m.
        """
        self.names, self.offset, self.scale, self.layers, self.std = (
            names,
            offset,
            scale,
            layers,
            std,
        )
        self.validity_features = tuple(name for name in names if name[0] == "d")

    def mean(self, samples: Samples) -> np.ndarray:
        """Return the predicted errors (n,), m."""
        x = (columns(samples, self.names) - self.offset) / self.scale
        for k, (weights, biases) in enumerate(self.layers):
            x = x @ weights + biases
            x = np.maximum(x, 0.0) if k < len(self.layers) - 1 else x
        return x[:, 0]

    def onnx(self, meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model with the outputs bias and standard deviation."""
        graph = GraphBuilder()
        x = graph.input
        for k, (weights, biases) in enumerate(self.layers):
            x = graph.op("Gemm", x, weights, biases)
            x = graph.op("Relu", x) if k < len(self.layers) - 1 else x
        std = graph.op("Add", graph.op("Mul", x, [0.0]), [self.std])
        meta = {
            **meta,
            "features": list(self.names),
            "offset": self.offset.tolist(),
            "scale": self.scale.tolist(),
        }
        graph.op("Concat", x, std, axis=1)
        return graph.model(len(self.names), 2, meta)


def fit(
    training: Sequence[Labels],
    validation: Sequence[Labels],
    seed: int,
    progress: Callable[[int, float], object] = lambda epoch, error: None,
) -> tuple[Paper, tuple[list[float], list[float]]]:
    """Train the network of the paper.

    Parameters
    ----------
    training, validation : sequence of Labels
    seed : int
    progress : callable
        Called with epoch and validation error, m.

    Returns
    -------
    tuple
        Paper, and RMS errors per epoch of training and validation, m.
    """
    oriented = all(np.isfinite(one.anchors.orientations).all() for one in (*training, *validation))
    names = FEATURES if oriented else WITHOUT
    (x, y), (x_held, y_held) = (_table(group, names) for group in (training, validation))
    low, high = x.min(axis=0), x.max(axis=0)
    offset, scale = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-6)
    x, x_held = (x - offset) / scale, (x_held - offset) / scale
    network = MLPRegressor(
        hidden_layer_sizes=LAYERS,
        solver="sgd",
        batch_size=BATCH,
        learning_rate_init=RATE,
        random_state=seed,
    )
    curve: tuple[list[float], list[float]] = ([], [])
    best: tuple[float, tuple[list[np.ndarray], list[np.ndarray]]] | None = None
    since = 0
    for epoch in range(MOST_EPOCHS):
        network.partial_fit(x, y)
        for errors, inputs, outputs in zip(curve, (x, x_held), (y, y_held)):
            errors.append(float(np.sqrt(np.mean((network.predict(inputs) - outputs) ** 2))))
        progress(epoch, curve[1][-1])
        if best is None or curve[1][-1] < best[0]:
            best, since = (curve[1][-1], copy.deepcopy((network.coefs_, network.intercepts_))), 0
        else:
            since += 1
            if since == PATIENCE:
                break
    assert best is not None  # after one epoch at least
    return Paper(names, offset, scale, list(zip(*best[1])), best[0]), curve


def _table(group: Sequence[Labels], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.concatenate([columns(one.samples, names) for one in group]),
        np.concatenate([one.error for one in group]),
    )
