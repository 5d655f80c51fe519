# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of single streams: series of a log, ranges, and axes of the inertial sensor."""

from dataclasses import replace

from known_effects import sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_tools.diagnosis import diagnose, output
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.channels.views import extra_at
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing
from uwb_tdoa_tools.diagnosis.report.page import html
from uwb_tdoa_tools.scoring.evaluation import align_truth
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# --- series of a log ---


def temperature(t):
    """Rises and falls by 4 degrees, independent of the motion of the vehicle."""
    return 30.0 + np.interp(t, [0.0, 9.0, 13.0, 28.0, 31.0, 50.0], [0.0, 4.0, 0.5, 3.5, 1.0, 2.0])


@pytest.fixture(scope="module")
def flight():
    """Return a flight with a temperature in its log, and with series that cannot be covariates."""
    flight = sparse_flight(103, 40.0)
    t = np.linspace(flight.imu.t[0], flight.imu.t[-1], 200)
    log = {
        "t": t,
        "temperature": temperature(t),
        "constant": np.ones(200),
        "names": np.array(["a"] * 200),
    }
    return replace(
        flight,
        extra={"baro": log, "short": {"t": t[:5], "x": t[:5]}, "pose_truth": {"t": t, "x": t}},
    )


def test_what_changes_in_a_log_is_a_covariate(flight):
    (name,) = extra_at(flight, flight.tdoa.t)
    assert name == "baro.temperature"
    assert extra_at(flight, flight.tdoa.t[:3])[name] == pytest.approx(
        temperature(flight.tdoa.t[:3]), abs=0.01
    )


@pytest.mark.slow
def test_a_gyroscope_that_drifts_with_the_temperature_is_told_in_words(flight):
    gyro = flight.imu.gyro.copy()
    gyro[:, 1] += 0.02 * (extra_at(flight, flight.imu.t)["baro.temperature"] - 30.0)
    warm = replace(flight, imu=replace(flight.imu, gyro=gyro))
    (finding,) = attribute([warm], GroundTruth()).findings()
    assert (
        finding.effect.covariate == "extra.baro.temperature" and finding.effect.channel == "gyro.y"
    )
    assert not finding.effect.usable
    what, why = finding.effect.advice()
    assert "too much about y" in what and "baro temperature" in what
    assert why.startswith("Likely causes: what warms, loads or supplies it. To tell: ")
    ends = finding.effect.curve(np.array(finding.effect.knots)[[0, -1]])
    assert np.diff(ends) / np.ptp(finding.effect.knots) == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
def test_one_anchor_that_changes_with_the_log_is_found(flight):
    """The fitted function may have any shape. At most a tenth of the error may remain."""
    warm = extra_at(flight, flight.tdoa.t)["baro.temperature"]
    late = 0.1 * (warm - 30.0)
    of_anchor = (flight.tdoa.b == 2) | (flight.tdoa.a == 2)
    d = flight.tdoa.d + late * (1.0 * (flight.tdoa.b == 2) - (flight.tdoa.a == 2))
    (finding,) = attribute(
        [replace(flight, tdoa=replace(flight.tdoa, d=d))], GroundTruth()
    ).findings()
    assert finding.effect.covariate == "extra.baro.temperature" and finding.effect.form == "anchor"
    assert "baro temperature" in finding.effect.advice()[0]
    left = late - finding.effect.curve(warm, "2.")
    assert np.sqrt(np.mean(left[of_anchor] ** 2)) < 0.1 * np.std(late[of_anchor])
    assert all(key.startswith("2.") for key in finding.effect.values)


def test_what_nodes_cannot_take_out_leaves_no_residual_under_a_model_that_has_it(flight):
    """Otherwise a fit about its own values would count the effect twice."""
    gyro = flight.imu.gyro.copy()
    gyro[:, 1] += 0.02 * (extra_at(flight, flight.imu.t)["baro.temperature"] - 30.0)
    warm, reference = replace(flight, imu=replace(flight.imu, gyro=gyro)), GroundTruth()
    term = SmoothTerm(
        {"c0": 0.04, "c1": 0.08},
        {},
        "",
        "gyro.y",
        "extra.baro.temperature",
        "common",
        (30.0, 34.0),
        "line",
    )
    plain, modelled = (
        residuals(reference.prepare(one), reference, EffectSet(effects))["gyro"].residual
        for one, effects in ((flight, ()), (warm, (term,)))
    )
    assert modelled == pytest.approx(plain, abs=1e-3)


# --- ranges, alone and with TDOAs ---

DELAY, MOVED = (
    EFFECTS["anchor_delay"]({"3": 0.3}),
    EFFECTS["anchor_position"]({"5.x": 0.3, "5.y": -0.3, "5.z": 0.2}),
)
LATE, LONG = EFFECTS["range_delay"]({"offset": 0.05}), EFFECTS["range_scale"]({"scale": 0.03})
OWN = EFFECTS["range_offset"]({"1": 0.3, "2": -0.2})
KINDS = (
    "anchor_delay",
    "anchor_position",
    "range_delay",
    "range_scale",
    "range_offset",
    "pair_offset",
)
FLOWN = dict(
    duration=40.0,
    floor_time=1.0,
    tdoa_rate=200.0,
    imu_rate=200.0,
    truth_rate=100.0,
    noise_std=0.1,
    range_noise=0.1,
    bias=False,
    multipath=False,
)


@pytest.fixture(scope="module")
def both():
    """Return a flight with TDOAs and ranges and white noise only."""
    return simulate(SimulationConfig(seed=11, trajectory="sines", **FLOWN))


def alone(flight):
    """Return the Flight without TDOAs."""
    return replace(
        flight, tdoa=type(flight.tdoa)(*(column[:0] for column in vars(flight.tdoa).values()))
    )


def sizes_found(flight, kinds=KINDS):
    """Return {name: values} of the effects found in a Flight."""
    effects = attribute([flight], GroundTruth(), kinds=kinds, undeclared=False).effects
    return {effect.name: effect.values for effect in effects}


@pytest.mark.parametrize(
    "effect, taken",
    [
        (DELAY, alone),
        (LATE, alone),
        (LONG, alone),
        *((each, lambda flight: flight) for each in (DELAY, MOVED, LATE, OWN)),
    ],
    ids=lambda each: getattr(each, "name", None),
)
def test_what_is_wrong_with_ranges_is_found(both, effect, taken):
    """TDOAs and ranges together give one finding for an anchor."""
    values = sizes_found(taken(effect.inject(both)))
    assert set(values) == {effect.name}
    for key in {*effect.values, *values[effect.name]}:
        assert values[effect.name].get(key, 0.0) == pytest.approx(
            effect.values.get(key, 0.0), abs=0.01 if effect is LATE else 0.1
        )


def test_nothing_is_found_where_nothing_is_wrong(both):
    assert sizes_found(both) == {} and sizes_found(alone(both)) == {}


def test_the_residual_is_what_the_model_leaves(both):
    wrong = DELAY.inject(alone(both))
    part = residuals(wrong, GroundTruth(), EffectSet())["range"]
    at = part.samples.anchors.ids[part.samples.b]
    assert (
        np.median(part.residual[at == 3]) == pytest.approx(0.3, abs=0.03)
        and abs(np.median(part.residual[at != 3])) < 0.03
    )
    assert set(residuals(wrong, GroundTruth(), EffectSet())) == {"range", "gyro", "accel"}
    after = residuals(wrong, GroundTruth(), EffectSet((DELAY,)))["range"]
    assert abs(np.median(after.residual[at == 3])) < 0.03
    rows = part.rows()
    assert {part.place_in_room(series) for series in np.unique(rows.series).tolist()} == {
        str(i) for i in both.anchors.ids
    }


def test_without_ground_truth_ranges_have_a_channel_where_there_are_no_tdoas(both):
    shown = [
        residuals(Nothing().prepare(flight), Nothing(), EffectSet())
        for flight in (both, alone(both))
    ]
    assert ["range" in one for one in shown] == [False, True] and [
        "tdoa" in one for one in shown
    ] == [True, False]
    assert np.sqrt(np.mean(shown[1]["range"].residual ** 2)) < 0.15


@pytest.mark.slow
def test_without_ground_truth_nothing_is_added_for_what_the_filter_finds_itself(both):
    assert not len(diagnose([without_offset(both, -0.3)], reference=Nothing()).effects)


@pytest.mark.slow
def test_without_ground_truth_the_delay_of_the_tag_is_found_with_that_of_an_anchor(both):
    result = diagnose([alone(without_offset(DELAY.inject(both), -0.3))], reference=Nothing())
    values = {effect.name: effect.values for effect in result.effects}["anchor_delay"]
    assert np.mean(list(values.values())) == pytest.approx(
        0.3 + DELAY.values["3"] / len(values), abs=0.05
    )
    assert {finding.effect.name for finding in result.findings if finding.added} == {
        "anchor_delay",
        "anchor_position",
    }
    assert result.after["pooled"]["nis_mean"] < result.before["pooled"]["nis_mean"]
    assert "predicted ranges" in output.as_text(result).replace("\n", " ")


@pytest.mark.slow
def test_without_ground_truth_nothing_is_added_where_nothing_is_wrong(both):
    result = diagnose([alone(both)], reference=Nothing())
    assert not result.effects and not any(finding.added for finding in result.findings)


@pytest.mark.slow
def test_a_function_of_ranges_that_nobody_declared_is_found(both):
    bend = SmoothTerm(
        {"c0": 0.0, "c1": 0.4},
        channel="range",
        covariate="range",
        form="arrival",
        knots=(2.0, 5.0, 9.0),
        shape="beyond",
    )
    terms = [
        effect
        for effect in attribute([bend.inject(alone(both))], GroundTruth(), kinds=()).effects
        if isinstance(effect, SmoothTerm)
    ]
    (mine,) = [term for term in terms if term.channel == "range"]
    at = np.linspace(2.5, 9.0, 20)
    assert mine.covariate == "range" and np.abs(np.ptp(mine.curve(at) - bend.curve(at))) < 0.15


def test_delays_of_all_anchors_do_not_turn_the_ground_truth(both):
    """The delays bend an estimate from ranges.

    The frame of the ground truth then seems different.
    """
    delays = EFFECTS["anchor_delay"]({str(i): 0.1 + 0.05 * i for i in range(8)})
    wrong = delays.inject(alone(both))
    flight, said = align_truth(wrong)
    np.testing.assert_array_equal(flight.truth.p, wrong.truth.p)
    assert said == ()
    turned = replace(wrong, truth=replace(wrong.truth, p=wrong.truth.p + [0.0, 2.0, 0.0]))
    flight, said = align_truth(turned)
    assert (
        len(said) == 1
        and "another frame" in said[0]
        and np.abs(flight.truth.p - wrong.truth.p).max() < 1.0
    )


@pytest.mark.slow
def test_ranges_alone_are_diagnosed_from_beginning_to_end(both):
    other = simulate(SimulationConfig(seed=12, trajectory="circle", **FLOWN))
    result = diagnose([DELAY.inject(alone(both))], [DELAY.inject(alone(other))])
    assert {effect.name: effect.values for effect in result.effects}["anchor_delay"][
        "3"
    ] == pytest.approx(0.3, abs=0.05)
    assert result.after["pooled"]["rmse_3d"] < 0.6 * result.before["pooled"]["rmse_3d"]
    assert (
        "range 3" in {row["axis"] for row in result.health["axes"]}
        and result.health["filter"][0]["nis_mean"] > 0.0
    )
    page, told = html(result), output.as_json(result)
    assert "anchor 3" in page and "nan" not in str(told["health"]["filter"]).lower()
