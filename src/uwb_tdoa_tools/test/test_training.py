# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Training data of a bias model, kinds of models, and the share of a model that is applied."""

from dataclasses import replace

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.features import FEATURES as INPUTS
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, EffectSet, TagLeverArm
from uwb_tdoa_tools.scoring.gains import SHARES, Shrinkage, best_share
from uwb_tdoa_tools.training import models, network, physics, shrinking, structured
from uwb_tdoa_tools.training.labels import labels, split, thinned, white_noise
from uwb_tdoa_tools.training.structured import Design, fit, predict

# --- training labels ---


PERFECT = {"noise_std": 0.0, "bias": False, "outlier_probability": 0.0}


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
    assert 0.0 < found.sample_weight < 0.1


def test_labels_without_effects_that_are_known():
    effects = EffectSet((AnchorDelay({"3": 0.2}), TagLeverArm({"z": 0.1})))
    late = flight(**PERFECT)
    for effect in effects.effects:
        late = effect.inject(late)
    assert np.sqrt(np.mean(labels(late).error ** 2)) > 0.05
    with pytest.raises(InputError, match="all labels are zero"):
        labels(late, effects)


def test_without_attitude_the_vehicle_is_level(one):
    found = labels(without_attitude(one))
    assert (found.samples.q == [0.0, 0.0, 0.0, 1.0]).all()


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
    ],
)
def test_says_what_it_cannot_learn_from(one, spoil, message):
    with pytest.raises(InputError, match=message):
        labels(spoil(one))


def test_split_is_by_flight_and_by_seed():
    names = [f"flight {k}" for k in range(10)]
    training, validation = split(names, 3)
    assert sorted([*training, *validation]) == names and len(validation) == 2
    assert split(names, 3) == (training, validation) and any(
        split(names, seed)[1] != validation for seed in range(9)
    )
    assert split(names, 0, ["flight 4"]) == (
        [name for name in names if name != "flight 4"],
        ["flight 4"],
    )


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


def test_thinned_samples_count_for_as_much_together(one):
    (few,) = thinned([labels(one)], 0.05, np.random.default_rng(0))
    assert len(few) < 0.2 * len(labels(one)) and (np.diff(few.samples.t) >= 0.0).all()
    assert few.sample_weight * len(few) == pytest.approx(
        labels(one).sample_weight * len(labels(one))
    )


def test_white_noise_is_what_changes_from_one_tdoa_to_the_next(one):
    assert white_noise([labels(one)]) == pytest.approx(0.06, rel=0.1)


# --- training linear ---


SITES, FEATURES, DENSE = 4, 6, 3


def design(noise, outliers, seed=0, n=4000):
    """Return (Design, weights of the sites, dense weights).

    The weights of the sites sum to zero, because differences do not determine a common weight.
    """
    random = np.random.default_rng(seed)
    weights, dense = random.normal(size=(SITES, FEATURES)), random.normal(size=DENSE)
    weights -= weights.mean(axis=0)
    a = random.integers(0, SITES, n)
    b = (a + random.integers(1, SITES, n)) % SITES
    phi, columns = random.normal(size=(n, FEATURES)), random.normal(size=(n, DENSE))
    made = Design(phi, a, b, columns, np.zeros(n), np.ones(n))
    y = predict(made, weights, dense) + noise * random.standard_normal(n)
    y[random.random(n) < outliers] += 5.0
    return Design(phi, a, b, columns, y, np.ones(n)), weights, dense


def test_finds_the_weights_despite_outliers():
    made, weights, dense = design(0.1, 0.1)
    found = fit(made, SITES, 0.1)
    np.testing.assert_allclose(found.site, weights, atol=0.02)
    np.testing.assert_allclose(found.dense, dense, atol=0.02)


def test_its_covariance_is_honest():
    errors, sizes = [], []
    for seed in range(40):
        made, _, dense = design(0.3, 0.0, seed, 300)
        found = fit(made, SITES, 0.3)
        errors.append(found.dense - dense)
        sizes.append(np.diag(found.dense_covariance))
    assert 0.5 < np.mean(np.square(errors) / sizes) < 1.5


def test_the_prior_is_as_large_as_the_weights():
    made, weights, dense = design(0.05, 0.0)
    found = fit(made, SITES, 0.05)
    assert 0.5 < found.site_std / weights.std() < 2.0 and 0.5 < found.dense_std / dense.std() < 2.0


# --- training network ---


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
    assert model.names == INPUTS and len(INPUTS) == 14
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


@pytest.mark.slow
def test_the_seed_decides(data):
    models, curves = zip(*(network.fit(*data, False, seed) for seed in (0, 0, 1)))
    assert curves[0] == curves[1] != curves[2]
    assert [name for name in INPUTS if name not in models[0].names] == [
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


# --- training physics ---


PLAIN = {"bias": False, "outlier_probability": 0.0, "yaw": "along_track"}
DELAY = EFFECTS["anchor_delay"]({"2": 0.3})
MOVED = EFFECTS["anchor_position"]({"5.x": 0.5})
PUSHED = EFFECTS["accel_bias"]({"x": 0.8})


def injected(flights, *effects):
    for effect in effects:
        flights = [effect.inject(one) for one in flights]
    return flights


@pytest.fixture(scope="module")
def one_place():
    return injected([flight(seed, **PLAIN) for seed in range(3)], DELAY, PUSHED)


@pytest.mark.slow
def test_finds_what_is_wrong_with_anchors_and_imu(one_place):
    found = physics.find_effects(one_place)
    values = {effect.name: effect.values for effect in found.effects.effects}
    assert values["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.03)
    assert values["accel_bias"]["x"] == pytest.approx(0.8, abs=0.1)
    for some in ([0], [0, 1]):
        fewer = {effect.name: effect.values for effect in found.fitted_to(some).effects}
        assert fewer["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.05)
        assert fewer["anchor_delay"] != values["anchor_delay"]


@pytest.mark.slow
def test_of_several_constellations_only_what_carries_over(one_place):
    elsewhere = [flight(seed, "pillars", **PLAIN) for seed in (3, 4)]
    flights = [*one_place[:2], *injected(elsewhere, DELAY, PUSHED)]
    flights = [*injected(flights[:2], MOVED), *flights[2:]]
    names = {effect.name for effect in physics.find_effects(flights).effects.effects}
    assert "anchor_delay" in names and names <= {
        *physics.PORTABLE,
        "noise_level",
        "noise_correlation",
    }


def test_network_learns_what_the_effects_leave(one_place):
    kinds = ("physics", "physics+structured")
    found = physics.find_effects(one_place)
    alone, both = (
        models.train(models.Recipe(kind, 0), one_place[:2], one_place[2:], kind, found=found)
        for kind in kinds
    )
    assert alone.model is None and alone.onnx() is None and both.onnx() is not None
    assert alone.effects == both.effects == found.effects
    for trained in (alone, both):
        ((before, after),) = trained.errors.values()
        assert (
            before == pytest.approx(np.sqrt(np.mean(labels(one_place[2]).error ** 2)))
            and after < 0.75 * before
        )
    left = labels(one_place[2], found.effects)
    assert np.sqrt(np.mean(both.model.mean(left.samples) ** 2)) < 0.02  # nothing is left to learn


# --- training structured ---


CIRCLE = {"trajectory": "circle", "yaw_angle": 0.3}


@pytest.fixture(autouse=True, scope="module")
def small():
    """Use few centres to make the fits fast."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structured, "CENTRES", 40)
        patch.setattr(structured, "LINK_CENTRES", 60)
        yield


def trained(flights, path):
    known = thinned([labels(one) for one in flights], 0.02, np.random.default_rng(0))
    model, _ = models.fit_structured(known, 0)
    model.floor = 0.03
    path.write_bytes(model.onnx({"clip": 1.0, "name": "structured"}).SerializeToString())
    return model, Network(path)


@pytest.fixture(scope="module")
def one_place_of_structured(tmp_path_factory):
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


@pytest.mark.slow
@pytest.mark.parametrize("which", ["one_place_of_structured", "two_places"])
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


def test_carries_over_to_pairs_never_seen(one_place_of_structured):
    _, network = one_place_of_structured  # TDoA2: neighbours in a ring only
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


def test_knows_nothing_of_anchors_in_new_places_unless_it_saw_several(one_place_of_structured):
    model, network = one_place_of_structured
    found = labels(flight(7, "wall_middles"))
    bias, std, known = network.predict(found.samples)
    np.testing.assert_allclose(bias, 0.0, atol=1e-4)
    np.testing.assert_allclose(known, 0.0, atol=1e-3)
    np.testing.assert_allclose(std, np.sqrt(2.0 * model.prior + model.floor**2), rtol=1e-3)
    np.testing.assert_array_equal(model.mean(found.samples), 0.0)
    np.testing.assert_allclose(model.variance(found.samples), 2.0 * model.prior, rtol=1e-6)


def test_fades_away_from_where_it_was(one_place_of_structured):
    model, network = one_place_of_structured
    s = labels(flight(5, **CIRCLE)).samples
    near, far = network.predict(s), network.predict(replace(s, p=s.p + [0.0, 0.0, 60.0]))
    assert np.abs(far[0]).max() < 0.05 * np.abs(near[0]).max()
    assert (far[1] > near[1].max()).all() and (far[2] < 0.1).all()


@pytest.mark.slow
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


# --- training shrinking ---


RECIPE = models.Recipe("structured", 0)


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


def test_effects_alone_are_taken_as_they_are():
    told = Shrinkage(best_share({"a": {None: 0.4, 1.0: 0.3}}), {"a": {None: 0.4, 1.0: 0.3}})
    assert (
        told.share == 1.0
        and "falls by 25 % +- 0 % (of 1 flights, each left out; on the worst it falls by 25 %)"
        in told.as_text()
    )


def test_a_flight_is_judged_by_what_it_took_no_part_in(monkeypatch):
    monkeypatch.setattr(structured, "CENTRES", 10)
    late = EFFECTS["anchor_delay"]({"3": 0.4, "5": -0.4})
    flights = [late.inject(flight(seed)) for seed in range(2)] + [flight(2)]
    told = shrinking.cross_validated(RECIPE, flights, shrinking.uncorrected(flights))
    assert set(told.errors) == {one.name for one in flights}
    alike, other = (told.errors[flights[k].name] for k in (0, 2))
    assert alike[1.0] < 0.95 * alike[None] and other[1.0] > 1.05 * other[None]
    assert told.share < 1.0 and told.as_dict()["worst"] == told.gains.min()
