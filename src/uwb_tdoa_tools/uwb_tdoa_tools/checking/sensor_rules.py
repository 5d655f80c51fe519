# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find sensors that contradict everything else, that draw the filter away from the TDOAs, or that are
off by a constant.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.common.sensors.sensor import Sensor
from uwb_tdoa_ekf.core.memory import INVALID, REJECTED, REPEATED, STARTUP
from uwb_tdoa_ekf.monitoring.explain import Unexplained, compare, in_words
from uwb_tdoa_ekf.monitoring.finding import NOTE, WARNING, Finding
from uwb_tdoa_ekf.offline import Run

from ..estimate import FlightEstimator

OF_SENSORS = CONTRADICTS, MISLEADS = "sensor_contradicts", "sensor_misleads"
MOST = 0.5  # share of the measurements of a second that are not used
# seconds with MOST, and their share, of a sensor that contradicts everything: healthy range finders
# 3 s, optical flow 6 s of 33
LASTS, SHARE = 5, 0.2
# ratio of the loss of the TDOAs without a sensor, and its standard errors. Healthy range finders
# 0.93 (TDOAs have errors of the height), optical flow 1.00; wheels that stand still 0.28 to 0.78.
RATIO, DEVIATIONS = 0.85, 2.5
FEWEST = 20  # ranges of an anchor
# m, common error of all ranges that is reported; more than the delays of usual antennas; and its
# least number of standard deviations
LARGE, DELAYS, SURE = 0.1, 0.6, 5.0


def judge_sensors(flight: Flight, run: Run, estimator: FlightEstimator) -> list[Finding]:
    """Return findings on the SENSORS of a Flight; `run` is that of the estimator over it, not smoothed.

    A sensor misleads if the TDOAs fit better without it. Only the one without which they fit best is
    named, and none beside a sensor that contradicts everything.
    """
    delay, found = [*tag_delay(flight, run)], list[Finding]()
    for name, rows in run.sensors.items():
        stream = getattr(flight, name)
        refused = (rows["verdict"] == INVALID) & np.isfinite(stream.values).all(axis=1)
        unused = refused | (rows["verdict"] == REJECTED)
        if name in LOCATING:
            found += _contradicting_anchors(stream.anchor, unused, SENSORS[name].plural)
        elif len(stream):
            found += _contradicting(stream.t, unused, SENSORS[name])
    return delay + (found or _misleading(flight, run, estimator))


def tag_delay(flight: Flight, run: Run) -> Iterator[Finding]:
    """Yield a finding if the filter finds a common error of all ranges: the antenna delay of the tag.

    TDOAs do not depend on it. Without `range_offset_std` the position error exceeds the delay where
    the anchors are on one side.
    """
    offset, std = run.range_offset or (0.0, np.inf)
    if abs(offset) < max(LARGE, SURE * std):
        return
    severity, cause = NOTE, "the antenna delay of the tag"
    if abs(offset) > DELAYS and flight.range is not None:
        size = float(np.nanmedian(flight.range.d))
        scale = size / (size - offset)
        severity, cause = WARNING, f"{cause}, or all are {scale:.2f} times the distances"
    yield Finding(
        "tag_delay",
        severity,
        cause=f"all ranges are too {'long' if offset > 0.0 else 'short'} by about as much: {cause}",
        evidence=f"{offset:.2f} m, standard deviation {std:.2f} m",
        remedy=(
            "calibrate it: survey, or diagnose where there is ground truth; until then leave "
            "range_offset_std above 0.0: the filter finds it after each start"
        ),
        value=offset,
    )


def _contradicting(t: np.ndarray, unused: np.ndarray, sensor: Sensor) -> Iterator[Finding]:
    """Yield a finding on a Sensor that contradicts everything else; stamps (n,) s, and (n,) bool."""
    _, second = np.unique(np.floor(t), return_inverse=True)
    share = np.bincount(second, unused) / np.bincount(second)
    bad = int(np.count_nonzero(share > MOST))
    if bad > max(LASTS, SHARE * len(share)):
        yield Finding(
            CONTRADICTS,
            WARNING,
            cause=f"the {sensor.plural} contradict everything else",
            evidence=f"in {bad} of {len(share)} s more than half of them are not used",
            remedy=f"check the sensor, {sensor.remedy}",
            value=bad / len(share),
        )


def _misleading(flight: Flight, run: Run, estimator: FlightEstimator) -> list[Finding]:
    """Return the finding on the sensor without which the TDOAs fit best, if much better."""
    found, loss = [], _loss(run)
    for name in run.sensors if loss.blocks else ():  # each costs a run of the filter
        ratio, z = compare(loss, _loss(estimator(flight.without(name))))
        if ratio < RATIO and z > DEVIATIONS:
            sensor = SENSORS[name]
            remedy = f"check the sensor, {sensor.remedy}; until then --without {name}"
            cause = f"the TDOAs fit much better without the {sensor.plural}"
            found.append(Finding(MISLEADS, WARNING, cause, in_words(ratio, z), remedy, ratio))
    return sorted(found, key=lambda finding: finding.value)[:1]


def _contradicting_anchors(
    anchor: np.ndarray, unused: np.ndarray, plural: str
) -> Iterator[Finding]:
    """Yield findings on anchors most of whose measurements are not used, (n,) ids and bool."""
    for one in np.unique(anchor).tolist():
        mine = unused[anchor == one]
        if len(mine) >= FEWEST and mine.mean() > MOST:
            yield Finding(
                CONTRADICTS,
                WARNING,
                cause=f"the {plural} of anchor {one} contradict everything else",
                evidence=f"{mine.mean():.0%} of {len(mine)} are not used",
                remedy="check where this anchor stands, and what its driver sends",
                value=float(mine.mean()),
            )


def _loss(run: Run) -> Unexplained:
    """Return the Unexplained of the TDOAs that the filter judged."""
    left = run.residuals
    order = np.argsort(left.t, kind="stable")
    order = order[~np.isin(left.verdict[order], (INVALID, STARTUP, REPEATED))]
    return Unexplained.of(left.t[order], left.innovation[order])
