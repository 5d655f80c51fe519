# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Training data of a bias model, both kinds of models, and the share of a model that is applied."""

from dataclasses import replace

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.model import FEATURES, Network
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.scoring.metrics import SHARES, Shrinkage, best_share
from uwb_tdoa_tools.training import models
from uwb_tdoa_tools.training.models import labels, split, thinned, white_noise

# --- labels ---


@pytest.fixture(scope="module")
def one():
    return flight()


def changed(one, **columns):
    return replace(one, tdoa=replace(one.tdoa, **columns))


def test_labels_are_measured_minus_geometry_at_the_true_pose(one):
    found = labels(one)
    rows = np.searchsorted(one.tdoa.t, found.samples.t)
    at = np.stack(
        [np.interp(found.samples.t, one.truth.t, one.truth.p[:, k]) for k in range(3)], axis=1
    )
    expected = one.tdoa.d[rows] - tdoa(at, found.samples.position_a, found.samples.position_b)
    np.testing.assert_allclose(found.error, expected, atol=1e-12)
    assert np.abs(found.error).max() <= 1.0 and found.samples.p[:, 2].min() > 0.3
    assert white_noise([found]) == pytest.approx(0.06, rel=0.1)
    assert (labels(without_attitude(one)).samples.q == [0.0, 0.0, 0.0, 1.0]).all()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda one: replace(one, truth=None), "holds no ground truth"),
        (
            lambda one: changed(one, a=np.where(one.tdoa.a == 2, 99, one.tdoa.a)),
            "anchor 99 is heard but not in",
        ),
        (
            lambda one: changed(one, d=np.where(one.tdoa.a == 2, np.nan, one.tdoa.d)),
            r"\d+ TDOAs are not finite",
        ),
        (lambda one: changed(one, d=one.tdoa.d + 30.0), "only 0 TDOAs are right to 1 m"),
        (lambda one: replace(one, truth=replace(one.truth, p=one.truth.p * np.nan)), "truth"),
        (lambda one: flight(noise_std=0.0, bias=False, outlier_probability=0.0), "all labels are"),
    ],
)
def test_says_what_it_cannot_learn_from(one, spoil, message):
    with pytest.raises(InputError, match=message):
        labels(spoil(one))


def test_split_is_by_flight_and_by_seed():
    names = [f"flight {k}" for k in range(10)]
    training, validation = split(names, 3)
    assert sorted([*training, *validation]) == names and len(validation) == 2
    assert split(names, 3) == (training, validation)
    assert any(split(names, seed)[1] != validation for seed in range(9))
    assert split(["a", "b", "c"], 0, ["b"]) == (["a", "c"], ["b"])


@pytest.mark.parametrize(
    ("names", "validation", "message"),
    [
        (["a"], None, "1 is too few"),
        (["a", "b", "a"], None, "a is there twice"),
        (["a", "b"], ["c"], "c is not one of the flights"),
        (["a", "b"], ["a", "b"], "leaves no flight to train"),
    ],
)
def test_split_says_what_is_wrong(names, validation, message):
    with pytest.raises(InputError, match=message):
        split(names, 0, validation)


# --- network ---


@pytest.fixture(scope="module")
def data():
    thin = thinned([labels(flight(seed)) for seed in range(3)], 0.02, np.random.default_rng(0))
    return thin[:2], thin[2:]


def test_learns_stops_early_and_says_the_same_as_its_file(data, tmp_path):
    model, (training, validation) = models.fit(*data, 1)
    assert len(training) == len(validation)
    assert model.names == FEATURES and len(FEATURES) == 14
    best = int(np.argmin(validation))
    assert len(validation) in (best + 1 + models.PATIENCE, models.MOST_EPOCHS)
    (held,) = data[1]
    error = held.error - model.mean(held.samples)
    # the best weights, not the last
    assert np.sqrt(np.mean(error**2)) == pytest.approx(validation[best])
    assert validation[best] < 0.9 * np.sqrt(np.mean(held.error**2))

    model.std = 0.07
    path = tmp_path / "model.onnx"
    path.write_bytes(model.onnx({"clip": 1.0, "name": "paper"}).SerializeToString())
    bias, std, known = Network(path).predict(held.samples)
    np.testing.assert_allclose(bias, np.clip(model.mean(held.samples), -1.0, 1.0), atol=1e-5)
    np.testing.assert_allclose(std, 0.07, rtol=1e-6)
    assert (known == 1.0).all()


@pytest.mark.slow
def test_the_seed_decides_and_unknown_orientations_are_no_inputs(data):
    blind = [
        replace(
            one,
            samples=replace(
                one.samples, anchors=Anchors.from_positions(one.samples.anchors.positions)
            ),
        )
        for one in data[0]
    ]
    found, curves = zip(*(models.fit(blind, data[1], seed) for seed in (0, 0, 1)))
    assert curves[0] == curves[1] != curves[2]
    without = ["azimuth_A_a", "azimuth_A_b", "elevation_A_a", "elevation_A_b"]
    assert [name for name in FEATURES if name not in found[0].names] == without


# --- physics ---


PLAIN = {"bias": False, "outlier_probability": 0.0, "yaw": "along_track"}
DELAY = EFFECTS["anchor_delay"]({"2": 0.3})
PUSHED = EFFECTS["accel_bias"]({"x": 0.8})


def injected(flights, *effects):
    for effect in effects:
        flights = [effect.inject(one) for one in flights]
    return flights


@pytest.mark.slow
def test_finds_what_is_wrong_with_anchors_and_imu():
    flights = injected([flight(seed, **PLAIN) for seed in range(3)], DELAY, PUSHED)
    found = models.find_effects(flights)
    values = {effect.name: effect.values for effect in found.effects}
    assert values["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.03)
    assert values["accel_bias"]["x"] == pytest.approx(0.8, abs=0.1)
    fewer = {effect.name: effect.values for effect in found.fitted_to([0])}
    assert fewer["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.05)
    assert fewer["anchor_delay"] != values["anchor_delay"]

    trained = models.train(models.Recipe("physics", 0), flights[:2], flights[2:], "", found=found)
    assert trained.model is None and trained.effects == found.effects
    ((before, after),) = trained.errors.values()
    assert before == pytest.approx(np.sqrt(np.mean(labels(flights[2]).error ** 2)))
    assert after < 0.75 * before


@pytest.mark.slow
def test_of_several_constellations_only_what_carries_over():
    flights = injected(
        [flight(seed, **PLAIN) for seed in range(2)], EFFECTS["anchor_position"]({"5.x": 0.5})
    )
    flights += [flight(seed, "pillars", **PLAIN) for seed in (3, 4)]
    found = models.find_effects(injected(flights, DELAY, PUSHED))
    names = {effect.name for effect in found.effects}
    assert "anchor_delay" in names
    assert names <= {*models.PORTABLE, "noise_level", "noise_correlation"}


def test_an_error_that_belongs_to_a_place_is_not_taken_for_a_delay():
    """One anchor is blocked in a part of one room, another is late in both rooms."""
    delays = EffectSet((EFFECTS["anchor_delay"](dict.fromkeys("01234567", 0.0)),))
    known = [
        labels(one) for one in injected([flight(0, **PLAIN), flight(1, "pillars", **PLAIN)], DELAY)
    ]
    s = known[0].samples
    blocked = 0.5 * np.exp(-0.5 * np.sum((s.p - s.p.mean(axis=0)) ** 2, axis=1))
    known[0] = replace(known[0], error=known[0].error + blocked * ((s.b == 5) * 1.0 - (s.a == 5)))
    (found,) = models.beside_places(delays, known)
    late = found.values["2"] - np.median([*found.values.values()])
    assert late == pytest.approx(0.3, abs=0.05)
    assert found.values["5"] - np.median([*found.values.values()]) < 0.5 * blocked.mean()


# --- share ---


def errors(*ratios):
    """Return errors as in Shrinkage: 0.5 m per flight, times the ratios at all SHARES."""
    return {
        str(k): {None: 0.5} | dict(zip(SHARES, (0.5 * ratio for ratio in some)))
        for k, some in enumerate(ratios)
    }


@pytest.mark.parametrize(
    "ratios, share",
    [
        ([(1.0, 0.8, 0.7, 0.6), (1.0, 0.8, 0.7, 0.6)], 1.0),  # all gain
        ([(1.0, 1.0, 1.1, 1.2), (1.0, 1.1, 1.1, 1.1)], 0.0),  # none gains
        # the mean alone would choose a larger share
        ([(1.0, 0.8, 0.7, 0.6), (1.0, 0.96, 1.0, 1.15)], 0.5),
    ],
)
def test_takes_what_gains_without_harm(ratios, share):
    assert best_share(errors(*ratios)) == share


def test_the_gain_of_a_larger_deviation_is_stated_apart():
    told = Shrinkage(1.0, errors((0.8, 0.7, 0.6, 0.4), (0.9, 0.8, 0.8, 0.9)))
    assert told.parts == pytest.approx((0.15, 0.25))


@pytest.mark.slow
def test_a_flight_is_judged_by_what_it_took_no_part_in():
    late = EFFECTS["anchor_delay"]({"3": 0.4, "5": -0.4})
    flights = [late.inject(flight(seed)) for seed in range(2)] + [flight(2)]
    told = models.cross_validated(models.Recipe("paper", 0), flights)
    assert set(told.errors) == {one.name for one in flights}
    alike, other = (told.errors[flights[k].name] for k in (0, 2))
    assert alike[1.0] < 0.95 * alike[None] and other[1.0] > 1.05 * other[None]
    assert told.share < 1.0 and told.as_dict()["worst"] == told.gains.min()
