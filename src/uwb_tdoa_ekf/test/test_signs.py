# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detection of a wrong sign of all TDOAs in flight.

The flights are simulated or measured.
"""

from dataclasses import replace

from flights import fly
import numpy as np
import pytest

from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.stream_rules import StreamWatch


def watched(flight, sign):
    """Return [Finding on the sign or None] of a StreamWatch over a Flight, for each second.

    sign : callable of the stamps; factor of the TDOAs.
    """
    watch, tdoa, said = StreamWatch(flight.anchors, 0.25), flight.tdoa, []
    second = np.floor(tdoa.t - tdoa.t[0])
    for k in range(int(second[-1])):
        rows = second == k
        t = tdoa.t[rows]
        watch.add_tdoa(t, t + 0.002, tdoa.a[rows], tdoa.b[rows], tdoa.d[rows] * sign(t))
        found = {finding.rule: finding for finding in watch.findings()}
        said.append(found.get("tdoa_sign"))
    return said


@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_sign_is_named_and_a_right_one_is_not(seed):
    flight = fly(seed, 20.0)
    right, wrong = (watched(flight, lambda t, sign=sign: sign) for sign in (1.0, -1.0))
    assert not any(right)
    assert wrong[-1].rule == "tdoa_sign" and "less stays unexplained" in wrong[-1].evidence


def test_a_driver_that_is_put_right_is_believed():
    said = watched(fly(1, 50.0), lambda t: np.where(t < 20.0, -1.0, 1.0))
    assert said[18] is not None and said[-1] is None


def test_a_tag_that_lies_still_says_nothing_of_it():
    assert not any(watched(fly(0, 30.0, hover=True), lambda t: 1.0))


def test_disorder_and_nonsense():
    watch, flight = StreamWatch(fly(0, 1.0).anchors, 0.25), fly(0, 4.0)
    rng = np.random.default_rng(0)
    for rows in np.array_split(rng.permutation(len(flight.tdoa)), 5):
        t = np.where(rng.random(len(rows)) < 0.1, np.nan, flight.tdoa.t[rows])
        a = np.where(rows % 7, flight.tdoa.a[rows], 999)
        watch.add_tdoa(t, t, a, flight.tdoa.b[rows], flight.tdoa.d[rows] * 1e9)
    watch.add_tdoa(*(np.empty(0) for _ in range(5)))
    assert "tdoa_sign" not in {finding.rule for finding in watch.findings()}


def test_a_sign_that_changes_without_a_count_is_named_after_twenty_seconds():
    said = watched(fly(0, 40.0), lambda t: np.where(t < 16.0, 1.0, -1.0))
    assert not any(said[:17]) and said[-1].rule == "tdoa_sign"


def flown(flight, sign, seconds):
    """Return [(s, rules)] of the findings of an Estimator and a StreamWatch, for each second.

    sign : callable of the stamps; factor of the TDOAs.
    """
    flight = replace(flight, tdoa=replace(flight.tdoa, d=flight.tdoa.d * sign(flight.tdoa.t)))
    estimator, watch, said = Estimator(flight.anchors), StreamWatch(flight.anchors, 0.25), []
    for now in np.arange(0.1, seconds, 0.1):
        for stream, add, keep in (
            (flight.imu, estimator.add_imu, watch.add_imu),
            (flight.tdoa, estimator.add_tdoa, watch.add_tdoa),
        ):
            inside = (stream.t >= now - 0.1) & (stream.t < now)
            t, *columns = (
                column[inside] for column in list(vars(stream).values())[:4] if column is not None
            )
            add(t, *columns)
            keep(t, t + 0.002, *columns)
        estimator.advance()
        if abs(now - round(now)) < 1e-6:
            said.append((now, {finding.rule for finding in watch.findings(estimator.sign_turns)}))
    return said


def test_a_sign_that_changes_in_flight_is_named_within_two_seconds_and_later_its_end(seed=2):
    said = flown(fly(seed, 45.0), lambda t: np.where((t > 18.3) & (t < 24.0), -1.0, 1.0), 45.0)
    assert not any(rules for at, rules in said if at < 18.3)
    assert all("tdoa_sign" in rules for at, rules in said if 20.3 < at < 24.0)
    assert not any("tdoa_sign" in rules for at, rules in said if at > 44.0)
