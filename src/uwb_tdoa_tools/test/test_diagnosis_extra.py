# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.channels.views import extra_at
from uwb_tdoa_tools.diagnosis.references import GroundTruth


def temperature(t):
    """Rises and falls by 4 degrees, independent of the motion of the vehicle."""
    return 30.0 + np.interp(t, [0.0, 9.0, 13.0, 28.0, 31.0, 50.0], [0.0, 4.0, 0.5, 3.5, 1.0, 2.0])


@pytest.fixture(scope="module")
def flight():
    """Return a flight with a temperature in its log, and with series that cannot be covariates."""
    flight = clean_flight(103, 40.0)
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
