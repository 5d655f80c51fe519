"""The network of Zhao et al."""

from dataclasses import replace

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.features import FEATURES
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_tools.training import network
from uwb_tdoa_tools.training.labels import labels, thinned


@pytest.fixture(scope="module")
def data():
    known = [labels(flight(seed)) for seed in range(3)]
    thin = thinned(known, 0.02, np.random.default_rng(0))
    return thin[:2], thin[2:]


def test_learns_stops_early_and_says_the_same_as_its_file(data, tmp_path):
    epochs = []
    model, (training, validation) = network.fit(
        *data, True, 1, lambda epoch, error: epochs.append(error)
    )
    assert epochs == validation and len(training) == len(validation)
    assert model.names == FEATURES and len(FEATURES) == 14
    best = int(np.argmin(validation))
    assert len(validation) in (best + 1 + network.PATIENCE, network.MOST_EPOCHS)
    (held,) = data[1]
    error = held.error - model.mean(held.samples)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(
        validation[best]
    )  # the best weights, not the last
    assert validation[best] < 0.9 * np.sqrt(np.mean(held.error**2))

    model.std = 0.07
    path = tmp_path / "model.onnx"
    path.write_bytes(model.onnx({"clip": 1.0, "name": "paper"}).SerializeToString())
    bias, std, known = Network(path).predict(held.samples)
    np.testing.assert_allclose(bias, np.clip(model.mean(held.samples), -1.0, 1.0), atol=1e-5)
    np.testing.assert_allclose(std, 0.07, rtol=1e-6)
    assert (known == 1.0).all()


def test_the_seed_decides(data):
    models, curves = zip(*(network.fit(*data, False, seed) for seed in (0, 0, 1)))
    assert curves[0] == curves[1] != curves[2]
    assert [name for name in FEATURES if name not in models[0].names] == [
        "azimuth_A_a",
        "azimuth_A_b",
        "elevation_A_a",
        "elevation_A_b",
    ]


def test_needs_orientations_of_anchors():
    blind = flight()
    blind = replace(blind, anchors=Anchors.from_positions(blind.anchors.positions))
    with pytest.raises(InputError, match="anchor 0 has no orientation"):
        network.fit([labels(without_attitude(blind))], [labels(blind)], True, 0)
