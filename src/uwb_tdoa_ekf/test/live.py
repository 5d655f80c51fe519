# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Feed a flight to an Estimator message by message."""

from dataclasses import fields, replace

import numpy as np

from uwb_tdoa_ekf.core.sensors import STREAMS
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import VERDICTS

IMU, TDOA, FIRST_SENSOR = range(3)


def messages(flight):
    """Return all (stamp, stream, place in the stream) in stamp order, inertial samples first."""
    parts = [flight.imu, flight.tdoa, *(getattr(flight, name) for name in STREAMS)]
    streams = enumerate(part.t if part is not None else () for part in parts)
    return sorted((t, stream, i) for stream, stamps in streams for i, t in enumerate(stamps))


def send(estimator, flight, stream, i):
    """Give one message to the estimator."""
    imu, tdoa = flight.imu, flight.tdoa
    if stream == IMU:
        estimator.add_imu(imu.t[i], imu.gyro[i], imu.accel[i])
    elif stream == TDOA:
        estimator.add_tdoa(tdoa.t[i], tdoa.a[i], tdoa.b[i], tdoa.d[i])
    else:
        name = STREAMS[stream - FIRST_SENSOR]
        part = getattr(flight, name)
        estimator.add(name, type(part)(*(column[i : i + 1] for column in part.columns)))


def arriving(flight, rng, imu_delay=0.0, tdoa_delay=0.0, imu_jitter=0.0, tdoa_jitter=0.0):
    """Return the messages in their order of arrival.

    Each delay is the sum of a constant and a uniform value between 0 and the jitter, in s.
    """
    delay, jitter = {IMU: imu_delay, TDOA: tdoa_delay}, {IMU: imu_jitter, TDOA: tdoa_jitter}
    return sorted(
        messages(flight),
        key=lambda m: m[0] + delay.get(m[1], 0.0) + jitter.get(m[1], 0.0) * rng.random(),
    )


def feed(estimator, flight, order=None, advance=None):
    """Return (Odometry, Residuals) of the estimator for all messages.

    Parameters
    ----------
    order : list of messages, optional
        Order of the messages; default: by stamp.
    advance : callable, optional
        Whether to advance after a message; default: always.
    """
    parts = []
    for _t, stream, i in messages(flight) if order is None else order:
        send(estimator, flight, stream, i)
        if advance is None or advance():
            parts.append(estimator.advance())
    parts.append(estimator.finish())
    return tuple(joined([part[k] for part in parts]) for k in range(2))


def joined(parts):
    """Concatenate many Odometry or Residuals."""
    kind = type(parts[0])
    return kind(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(kind))
    )


def assert_same(left, right, tolerance=0.0):
    """Check that two Odometry, or two Residuals, agree in every field."""
    for field in fields(left):
        a, b = getattr(left, field.name), getattr(right, field.name)
        assert len(a) == len(b), field.name
        np.testing.assert_allclose(a, b, rtol=0.0, atol=tolerance, err_msg=field.name)


def assert_same_as_offline(flight, config=None, **feeding):
    estimator = Estimator(flight.anchors, config)
    odometry, residuals = feed(estimator, flight, **feeding)
    expected = run_offline(flight, config)
    assert_same(odometry, expected.odometry)
    # Residuals of refused TDOAs come at once, so compare by stamp.
    assert_same(by_stamp(residuals), by_stamp(expected.residuals))
    assert {name: estimator.counts[name] for name in VERDICTS.values()} == expected.counts


def by_stamp(residuals):
    order = np.argsort(residuals.t, kind="stable")
    return replace(
        residuals,
        **{field.name: getattr(residuals, field.name)[order] for field in fields(residuals)},
    )
