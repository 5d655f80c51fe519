from dataclasses import replace

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_tools.training import models, structured
from uwb_tdoa_tools.training.labels import labels, thinned

CIRCLE = {"trajectory": "circle", "yaw_angle": 0.3}
OPTIONS = structured.StructuredPriors(centres=40, link_centres=60)


def trained(flights, path):
    known = thinned([labels(one) for one in flights], 0.02, np.random.default_rng(0))
    model, _ = models.fit_structured(known, 0, OPTIONS)
    model.floor = 0.03
    path.write_bytes(model.onnx({"clip": 1.0, "name": "structured"}).SerializeToString())
    return model, Network(path)


@pytest.fixture(scope="module")
def one_place(tmp_path_factory):
    return trained(
        [flight(seed, **CIRCLE) for seed in (0, 1)], tmp_path_factory.mktemp("one") / "model.onnx"
    )


@pytest.fixture(scope="module")
def two_places(tmp_path_factory):
    flights = [
        flight(seed, name) for seed, name in enumerate(("corners", "pillars", "corners", "pillars"))
    ]
    return trained(flights, tmp_path_factory.mktemp("two") / "model.onnx")


def rms(values):
    return np.sqrt(np.mean(values**2))


@pytest.mark.parametrize("which", ["one_place", "two_places"])
def test_its_file_says_what_it_says(which, request):
    model, network = request.getfixturevalue(which)
    found = labels(flight(5, **CIRCLE))
    bias, std, known = network.predict(found.samples)
    np.testing.assert_allclose(bias, model.mean(found.samples), atol=2e-4)
    assert bool(model.links) == (which == "two_places")
    expected = np.sqrt(model.variance(found.samples) + model.floor**2)
    assert (
        std >= expected - 2e-3
    ).all()  # directions of the posterior that are left out count as unknown
    np.testing.assert_allclose(np.median(std / expected), 1.0, atol=0.35)
    assert ((known >= 0.0) & (known <= 1.0)).all() and np.median(known) > 0.3
    assert rms(found.error - bias) < 0.9 * rms(found.error)


def test_a_pair_turned_round_has_the_opposite_error(two_places):
    _, network = two_places
    s = labels(flight(5)).samples
    one, other = network.predict(s), network.predict(replace(s, a=s.b, b=s.a))
    np.testing.assert_allclose(one[0], -other[0], atol=1e-5)
    np.testing.assert_allclose(one[1:], other[1:], atol=1e-5)


def test_carries_over_to_pairs_never_seen(one_place):
    _, network = one_place  # TDoA2: neighbours in a ring only
    found = labels(flight(7, protocol="tdoa3", **CIRCLE))
    apart = (found.samples.b - found.samples.a) % 8
    new = (apart != 1) & (apart != 7)
    assert new.sum() > 500
    error = found.error - network.predict(found.samples)[0]
    assert rms(error[new]) < 0.9 * rms(found.error[new])


def test_carries_over_to_a_constellation_never_seen(two_places):
    _, network = two_places
    found = labels(flight(7, "wall_middles"))
    assert rms(found.error - network.predict(found.samples)[0]) < 0.9 * rms(found.error)


def test_knows_nothing_of_anchors_in_new_places_unless_it_saw_several(one_place):
    model, network = one_place
    found = labels(flight(7, "wall_middles"))
    bias, std, known = network.predict(found.samples)
    np.testing.assert_allclose(bias, 0.0, atol=1e-4)
    np.testing.assert_allclose(known, 0.0, atol=1e-3)
    np.testing.assert_allclose(std, np.sqrt(2.0 * model.prior + model.floor**2), rtol=1e-3)
    np.testing.assert_array_equal(model.mean(found.samples), 0.0)
    np.testing.assert_allclose(model.variance(found.samples), 2.0 * model.prior, rtol=1e-6)


def test_fades_away_from_where_it_was(one_place):
    model, network = one_place
    s = labels(flight(5, **CIRCLE)).samples
    near, far = network.predict(s), network.predict(replace(s, p=s.p + [0.0, 0.0, 60.0]))
    assert np.abs(far[0]).max() < 0.05 * np.abs(near[0]).max()
    assert (far[1] > near[1].max()).all() and (far[2] < 0.1).all()


def test_flights_with_and_without_attitude_together(tmp_path):
    flights = [
        flight(0),
        flight(1, "pillars"),
        without_attitude(flight(2)),
        without_attitude(flight(3, "pillars")),
    ]
    model, network = trained(flights, tmp_path / "model.onnx")
    assert list(model.links) == ["T", "A"]
    found = labels(flight(5))
    assert rms(found.error - network.predict(found.samples)[0]) < 0.95 * rms(found.error)
