# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Healthy recordings of ten kinds, which `./dev study checking --healthy` judges.

Nine kinds are simulated, with the radio errors of `simulate`. The tenth are pieces of measured
flights.
"""

from dataclasses import replace

from halls import fly, hall
import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import constellation, facing

from .any_path import Path
from .situations import _pocket, _round

ROOMS = "corners", "tilted", "wall_middles", "staircase", "pillars", "small_room"
PATHS = "sines", "square", "rising_circle", "circle"
PIECE = 10.0, 40.0  # s, of a measured flight
BRIEF = {"imu_rate": 250.0, "truth_rate": 50.0}
HALL = "200 x 100 m, 231 anchors"


def _seconds(rng):
    return float(rng.uniform(25.0, 60.0))


def level(rng, height):
    """Six to eight Anchors at one height around 8 to 14 m."""
    count = int(rng.integers(6, 9))
    angle = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count
    half = rng.uniform(4.0, 7.0, 2)
    places = np.column_stack([half[0] * np.cos(angle), half[1] * np.sin(angle)])
    return facing(np.column_stack([places, np.full(count, height)]), (0.0, 0.0, height))


def rover(seed, rng):
    """A rover below or above anchors of one height."""
    anchors = level(rng, rng.choice([0.6, 2.2, 2.8]))
    radius = float(rng.uniform(1.5, 3.0))
    path = str(rng.choice(PATHS[:2]))
    given = {"anchors": anchors, "duration": _seconds(rng), "radius": radius, "trajectory": path}
    flight = simulate(SimulationConfig.of("rover", seed=seed, **given))
    return flight.without("velocity") if seed % 2 else flight


def ceiling(seed, rng):
    """A multirotor below anchors at a ceiling."""
    anchors = level(rng, float(rng.uniform(2.6, 4.0)))
    path = Path(
        duration := _seconds(rng),
        _round((0.0, 0.0, 1.3), float(rng.uniform(1.0, 2.5)), float(rng.uniform(0.6, 1.5))),
        running=(-1.0, duration + 1.0),
    )
    return _simulated(seed, path, anchors=anchors, duration=duration)


def line(seed, rng):
    """A hand in front of a line of six anchors."""
    along = np.linspace(-5.0, 5.0, 6) + rng.uniform(-0.3, 0.3, 6)
    anchors = facing(
        np.column_stack([np.zeros(6), rng.permutation(along), np.full(6, rng.uniform(0.5, 2.5))]),
        (3.0, 0.0, 1.5),
    )
    duration = _seconds(rng)
    motion = _round((float(rng.uniform(2.0, 4.0)), 0.0, 1.2), 1.0, float(rng.uniform(0.5, 1.2)))
    path = Path(duration, motion, _turning(1.0, 0.1))
    return _simulated(seed, path, anchors=anchors, duration=duration)


def in_a_hall(seed, rng):
    """A person in a hall of many anchors."""
    flight = fly(hall(HALL, seed=seed), seed, _seconds(rng))
    return flight.without("imu") if seed % 3 == 0 else flight


def swarm(seed, rng):
    """A quadrotor of a swarm, which has a share of the air time."""
    rate = 10.0 if seed % 2 else 50.0
    return _flight(seed, rng, tdoa_rate=rate, protocol="tdoa3")


def person(seed, rng):
    """A tag in a pocket: no IMU, and anchors behind the body are late."""
    common = {**BRIEF, "seed": seed, "protocol": ("tdoa2", "tdoa3")[seed % 2]}
    anchors = constellation(str(rng.choice(ROOMS[:4])))
    return _pocket(rng, {**common, "anchors": anchors}).without("imu")


def tdoa2(seed, rng):
    """A quadrotor in a room, TDOA2."""
    return _flight(seed, rng, protocol="tdoa2")


def tdoa3(seed, rng):
    """A quadrotor in a room, TDOA3."""
    return _flight(seed, rng, protocol="tdoa3")


def outdoors(seed, rng):
    """A tag outside of anchors on tripods and masts."""
    angle = 2.0 * np.pi * np.arange(8) / 8.0 + rng.uniform(-0.2, 0.2, 8)
    heights = np.where(np.arange(8) % 2, rng.uniform(2.5, 4.0, 8), rng.uniform(0.5, 1.5, 8))
    anchors = facing(
        np.column_stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), heights]), (0.0, 0.0, 1.5)
    )
    duration, away = _seconds(rng), float(rng.uniform(10.0, 16.0))
    motion = _round((away, 0.0, 2.0), 4.0, float(rng.uniform(1.0, 2.0)), 0.5)
    path = Path(duration, motion, running=(-1.0, duration + 1.0))
    return _simulated(seed, path, anchors=anchors, duration=duration, multipath=False)


def measured(rng, found, reading):
    """A piece of one of the measured flights `found`, [(path, survey)]."""
    flight = reading.read(found[int(rng.integers(len(found)))])
    t = flight.tdoa.t
    length = min(float(rng.uniform(*PIECE)), float(np.ptp(t)))
    begin = float(rng.uniform(t[0], t[-1] - length))
    streams = {name: getattr(flight, name) for name in ("tdoa", "imu", *SENSORS)}
    return flight.replaced(
        **{
            name: rows_of(stream, slice(*np.searchsorted(stream.t, [begin, begin + length])))
            for name, stream in streams.items()
            if stream is not None
        }
    )


KINDS = {
    "rover, anchors at one height": rover,
    "anchors at the ceiling": ceiling,
    "anchors in a line": line,
    "hall": in_a_hall,
    "swarm, 50 or 10 TDOAs/s": swarm,
    "person, no IMU": person,
    "quadrotor, TDOA2": tdoa2,
    "quadrotor, TDOA3": tdoa3,
    "outside of its anchors": outdoors,
    "piece of a measured flight": None,
}


def healthy(kind, seed, found=(), reading=None):
    """The Flight of a kind of KINDS, without ground truth.

    found, reading : measured flights [(path, survey)], and their Reading, for pieces of them
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    made = KINDS[kind]
    return replace(made(seed, rng) if made else measured(rng, found, reading), truth=None)


def _flight(seed, rng, **given):
    room = str(rng.choice([*ROOMS, f"random-{seed}-8"]))
    path = {"trajectory": str(rng.choice(PATHS)), "speed": float(rng.uniform(0.6, 1.8))}
    yaw = str(rng.choice(["fixed", "rotating", "along_track"]))
    return simulate(
        SimulationConfig(
            seed=seed, constellation=room, duration=_seconds(rng), yaw=yaw, **BRIEF, **path, **given
        )
    )


def _simulated(seed, path, **given):
    protocol = ("tdoa2", "tdoa3")[seed % 2]
    return simulate(SimulationConfig(seed=seed, protocol=protocol, **BRIEF, **given), path)


def _turning(rate, swing):
    """An attitude for Path that turns at about `rate`, rad/s, and swings."""
    return lambda t: Rotation.from_euler(
        "zyx",
        np.column_stack(
            [rate * t, swing * np.sin(2.0 * t) * np.ones(len(t)), swing * np.cos(1.3 * t)]
        ),
    )
