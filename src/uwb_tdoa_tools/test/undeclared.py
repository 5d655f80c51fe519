# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects that are not declared: `diagnose` must find them in tests and benchmarks.

Each takes a Flight and returns the Flight with the effect.

CASES : {name: (function, channel, covariates that name it)}
"""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects import true_samples


def _tdoa(flight, error):
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] += error(samples)
    return replace(flight, tdoa=replace(flight.tdoa, d=d))


def _arrivals(late):
    def error(samples):
        to_a, to_b = samples.position_a - samples.p, samples.position_b - samples.p
        return late(to_b) - late(to_a)

    return error


def _imu(flight, gyro=0.0, accel=0.0):
    imu = flight.imu
    return replace(flight, imu=replace(imu, gyro=imu.gyro + gyro, accel=imu.accel + accel))


def _since(flight):
    return (flight.imu.t - flight.imu.t[0])[:, None]


def drag_on_cable(flight):
    """TDOAs grow with the square of the speed."""
    return _tdoa(flight, lambda s: 0.1 * np.sum(s.velocity**2, axis=1))


def warming_tag(flight):
    """All TDOAs are too large at first. The error decays with a time constant of 15 s."""
    return _tdoa(flight, lambda s: 0.3 * np.exp(-(s.t - s.start) / 15.0))


def layered_air(flight):
    """TDOAs have a wave over the height of the tag."""
    return _tdoa(flight, lambda s: 0.15 * np.sin(3.0 * s.p[:, 2]))


def standing_wave(flight):
    """Arrivals have a wave over the range."""
    return _tdoa(flight, _arrivals(lambda to: 0.15 * np.sin(2.0 * np.linalg.norm(to, axis=1))))


def mirror_wall(flight):
    """One anchor is late on one side of the room."""
    anchor = flight.anchors.ids[2]
    ids = flight.anchors.ids

    def error(s):
        late = 0.2 * np.tanh(2.0 * (s.p[:, 0] - np.median(s.p[:, 0])))
        return late * (1.0 * (ids[s.b] == anchor) - (ids[s.a] == anchor))

    return _tdoa(flight, error)


def cooling_gyro(flight):
    """The x axis of the gyroscope drifts after it is switched on."""
    return _imu(flight, gyro=np.array([0.05, 0.0, 0.0]) * np.exp(-_since(flight) / 20.0))


def loaded_gyro(flight):
    """The z axis of the gyroscope changes with the load on the vehicle."""
    force = np.linalg.norm(flight.imu.accel, axis=1, keepdims=True)
    return _imu(flight, gyro=np.array([0.0, 0.0, 0.05]) * (force - 9.81) ** 2)


def spun_accelerometer(flight):
    """The accelerometer is off-centre: its y axis changes with the square of the turning rate."""
    rate = np.linalg.norm(flight.imu.gyro, axis=1, keepdims=True)
    return _imu(flight, accel=np.array([0.0, 0.8, 0.0]) * rate**2)


# Effects that `diagnose` once failed to name


def slow_wave(flight):
    """One anchor is alternately late and early, with a period of 17 s."""
    return _of_anchor(flight, 3, lambda s: 0.3 * np.sin(2.0 * np.pi * (s.t - s.start) / 17.0))


def fast_and_high(flight):
    """One anchor is late where the tag is both fast and high."""

    def late(s):
        speed, height = np.linalg.norm(s.velocity, axis=1), s.p[:, 2]
        return 0.8 * ((speed > np.quantile(speed, 0.6)) & (height > np.quantile(height, 0.6)))

    return _of_anchor(flight, 3, late)


def late_by_speed(flight):
    """The delay of one anchor grows with the speed of the tag."""
    return _of_anchor(flight, 5, lambda s: 0.3 * np.linalg.norm(s.velocity, axis=1))


def leaning_accel(flight):
    """The bias of the accelerometer's z changes with the height."""
    height = np.interp(flight.imu.t, flight.truth.t, flight.truth.p[:, 2])
    return _imu(flight, accel=0.3 * (height - height.mean())[:, None] * [0.0, 0.0, 1.0])


def accel_of_place_beside_drift(flight):
    """The bias of the accelerometer's z grows with y; x and y wander by 2 m/s^2 within 1.5 s."""
    t = flight.imu.t
    y = np.interp(t, flight.truth.t, flight.truth.p[:, 1])
    step = np.median(np.diff(t)) / 1.5
    drift = np.zeros((len(t), 3))
    kicks = np.random.default_rng(0).normal(0.0, 2.0 * np.sqrt(2.0 * step), (len(t), 2))
    for k in range(1, len(t)):
        drift[k, :2] = (1.0 - step) * drift[k - 1, :2] + kicks[k]
    return _imu(flight, accel=drift + 1.2 * np.maximum(y, 0.0)[:, None] * [0.0, 0.0, 1.0])


def _of_anchor(flight, anchor, late):
    ids = flight.anchors.ids
    return _tdoa(
        flight, lambda s: late(s) * (1.0 * (ids[s.b] == anchor) - 1.0 * (ids[s.a] == anchor))
    )


CASES = {
    "drag_on_cable": (drag_on_cable, "tdoa", ("speed",)),
    "warming_tag": (warming_tag, "tdoa", ("time",)),
    "layered_air": (layered_air, "tdoa", ("height",)),
    "standing_wave": (standing_wave, "tdoa", ("range",)),
    "mirror_wall": (mirror_wall, "tdoa", ("x",)),
    "cooling_gyro": (cooling_gyro, "gyro.x", ("time",)),
    "loaded_gyro": (loaded_gyro, "gyro.z", ("accel", "accel_z")),
    "spun_accelerometer": (spun_accelerometer, "accel.y", ("turning_rate", "rate_z")),
}
