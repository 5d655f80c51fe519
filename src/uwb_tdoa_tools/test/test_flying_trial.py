# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A flight of `fly`: its sensor data and its course."""

from dataclasses import replace
import math

import known_answer
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.sensors.pressure import SITE
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.flying.mission import DONE, FLYING, HEIGHT, LOST, RISE, Circles, Rules
from uwb_tdoa_tools.flying.simulator import IMU_RATE, Transport, integrate
from uwb_tdoa_tools.flying.trial import OwnFilter, Task, Trial, fly
from uwb_tdoa_tools.flying.vehicle import (
    ATTITUDE,
    HALL,
    POSITION,
    VELOCITY,
    WORLDS,
    AuxiliarySensor,
    InertialErrors,
    Radio,
    gusts,
)
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation.config import NO_IMU_ERRORS
from uwb_tdoa_tools.simulation.inject import parse_effect

# --- flying sensors ---


CLEAN = replace(HALL, floor_effect=False, noise=0.0, outlier_share=0.0, delay=0.0, bearing_bias=0.0)
HIGH, LEVEL = np.array([0.5, 0.3, 1.2]), np.array([0.0, 0.0, 0.0, 1.0])


def residual(world, p=HIGH, seed=0, duration=20.0, schedule_faults=(np.inf, np.inf)):
    """Return (Radio, TDOAs minus geometry (n,) m) at one position."""
    radio = Radio(world, seed, duration)
    radio.schedule_faults(*schedule_faults)
    d = radio.measured(slice(0, len(radio.t)), np.tile(p, (len(radio.t), 1)))
    distance = np.linalg.norm(p - radio.positions, axis=1)
    return radio, d - (distance[radio.b] - distance[radio.a])


def test_a_clean_world_is_geometry_alone():
    radio, rest = residual(CLEAN)
    np.testing.assert_allclose(rest, 0.0, atol=1e-12)
    assert len(radio.t) / 20.0 == pytest.approx(360.0, rel=0.02)


def test_the_rate_is_as_asked_for_with_either_protocol():
    radio = Radio(WORLDS["tdoa3"], 0, 60.0)
    assert len(radio.t) / 60.0 == pytest.approx(240.0, rel=0.05)
    assert len(np.unique(radio.a * 8 + radio.b)) == 56


def test_noise_and_outliers_are_as_large_as_asked_for():
    assert residual(replace(CLEAN, noise=0.08))[1].std() == pytest.approx(0.08, rel=0.03)
    _, rest = residual(replace(CLEAN, outlier_share=0.03, outlier_size=2.5))
    hit = rest[np.abs(rest) > 1e-9]
    assert len(hit) / len(rest) == pytest.approx(0.03, rel=0.2) and np.abs(hit).max() <= 2.5
    _, rest = residual(replace(CLEAN, outlier_share=0.1, outlier_size=0.0))
    kinds = [
        np.mean((np.abs(rest) > low) & (np.abs(rest) <= high))
        for low, high in ((0.4, 0.6), (3.0, 5.0), (20.0, 250.0))
    ]
    np.testing.assert_allclose(kinds, [0.06, 0.03, 0.01], rtol=0.25)


def test_low_anchors_are_late_or_not_up_to_their_own_height():
    world = replace(CLEAN, floor_effect=True)
    radio = Radio(world, 0, 1.0)
    late, limit, _ = radio.floor.of_each(world.anchors)
    low = radio.positions[:, 2] < 1.0
    assert ((late[low] >= 3.0) & (late[low] <= 3.9)).all() and (late[~low] == 0.0).all()
    assert ((limit[low] >= 0.06) & (limit[low] <= 0.2)).all()
    for height, share in ((0.03, 1.0), (0.31, 0.0), (float(limit[2]), 0.5)):
        radio, rest = residual(world, np.array([0.5, 0.3, height]), duration=60.0)
        first = 2  # a low anchor that follows a high one
        mine = (radio.b == first) & ~low[radio.a]
        hit = rest[mine] > 1.0
        assert hit.mean() == pytest.approx(share, abs=0.05)
        np.testing.assert_allclose(rest[mine], np.where(hit, late[first], 0.0), atol=1e-12)


def test_an_installation_is_the_same_in_every_flight():
    same, own = replace(HALL, installation=7), HALL
    for world, alike in ((same, True), (own, False)):
        first, second = Radio(world, 0, 5.0), Radio(world, 1, 5.0)
        assert (
            np.array_equal(first.constants, second.constants) == alike
            and (first.floor.values == second.floor.values) == alike
        )
        assert not np.array_equal(first.t[:100], second.t[:100])


@pytest.mark.parametrize("change", ["late", "silent"])
def test_one_anchor_changes_from_then_on(change):
    radio, rest = residual(replace(CLEAN, change=change), schedule_faults=(np.inf, 10.0))
    mine = (radio.t >= 10.0) & ((radio.a == radio.other) | (radio.b == radio.other))
    np.testing.assert_allclose(rest[~mine], 0.0, atol=1e-12)
    if change == "silent":
        assert np.isnan(rest[mine]).all()
    else:
        np.testing.assert_allclose(rest[mine], np.where(radio.b[mine] == radio.other, 0.3, -0.3))


def test_a_person_blocks_what_passes_through_him_for_a_while():
    _, rest = residual(replace(CLEAN, person=True), duration=120.0)
    hit = np.abs(rest) > 1e-9
    assert 0.01 < hit.mean() < 0.4 and np.abs(rest).max() < 2.0
    bursts = np.flatnonzero(np.diff(hit.astype(int)) == 1)
    assert hit.sum() > 10 * len(bursts) / 8  # they come in bursts


def test_vibration_is_as_strong_as_asked_for_and_in_its_band():
    world = replace(HALL, vibration=(0.4, 0.5, 0.35), vibration_band=30.0)
    shaking = InertialErrors(world, 0, 100.0).shaking
    np.testing.assert_allclose(shaking.std(axis=0), world.vibration, rtol=1e-6)
    power = np.abs(np.fft.rfft(shaking[:, 0])) ** 2
    f = np.fft.rfftfreq(len(shaking), 1.0 / IMU_RATE)
    assert power[f < 30.0].sum() > 0.8 * power.sum()
    offset = InertialErrors(replace(world, rectified=1.0), 0, 100.0).shaking.mean(axis=0)
    np.testing.assert_allclose(np.abs(offset), world.vibration, rtol=0.1)


def test_gusts_are_as_strong_as_asked_for_and_slow():
    wind = gusts(replace(HALL, gust=0.5), 0, 500.0)
    np.testing.assert_allclose(wind.std(axis=0), 0.5, rtol=0.15)
    assert np.corrcoef(wind[:-40, 0], wind[40:, 0])[0, 1] == pytest.approx(np.exp(-0.1), abs=0.03)


def test_other_sensors_say_what_is_true_but_for_their_noise():
    n, ground = 100, 0.2  # rows; m
    p, v = np.tile(HIGH, (n, 1)), np.tile([0.5, 0.0, 0.1], (n, 1))
    q = np.tile([np.sin(0.1), 0.0, 0.0, np.cos(0.1)], (n, 1))
    sensors = {name: AuxiliarySensor(name, HALL, 0, 10.0) for name in SENSORS}
    found = {name: one.measured(slice(50, 150), p, q, v, ground) for name, one in sensors.items()}
    ranges = found["range"]
    assert ranges.anchor.tolist() == np.resize(HALL.anchors.ids, 150)[50:].tolist()
    distance = np.linalg.norm(HIGH - HALL.anchors.positions, axis=1)
    true = {
        "height": [(HIGH[2] - ground) / np.cos(0.2)],
        "pressure": [SITE + HIGH[2]],
        "velocity": Rotation.from_quat(q[0]).inv().apply(v[0]),
        "range": distance[HALL.anchors.index(ranges.anchor)][:, None],
    }
    for name, stream in found.items():
        std = SENSORS[name].noise[2]
        off = stream.values - true[name]
        assert np.abs(off.mean(axis=0)).max() < 4.0 * std / n**0.5, name
        np.testing.assert_allclose(off.std(axis=0), std, rtol=0.3, err_msg=name)
        assert len(sensors[name].t) == int(10.0 * SENSORS[name].rate)
        none = sensors[name].measured(slice(9, 9), p[:0], q[:0], v[:0], ground)
        assert len(none) == 0 and type(none) is type(stream)


def test_what_takes_its_time_arrives_in_order_and_whole():
    def sent(k):
        t = 0.01 * k + 0.0025 * np.arange(1, 5)
        imu = Imu(t, np.zeros((4, 3)), np.zeros((4, 3)))
        return {"imu": imu, "tdoa": Tdoas(t, np.zeros(4, int), np.ones(4, int), t)}

    transport, came = Transport(0.05, 0.01, np.random.default_rng(0)), []
    for k in range(200):
        now = 0.01 * (k + 1)
        arrived = transport.arrived(sent(k), now)
        tdoa = arrived["tdoa"]
        assert (arrived["imu"].t <= now - 0.05 + 1e-9).all() and (tdoa.t == tdoa.d).all()
        came.append(arrived["imu"].t)
    came = np.concatenate(came)
    np.testing.assert_allclose(came, 0.0025 * np.arange(1, len(came) + 1))
    assert 2.0 - came[-1] == pytest.approx(0.07, abs=0.04)
    at_once = Transport(0.0, 0.0, np.random.default_rng(0))
    assert len(at_once.arrived(sent(0), 0.01)["imu"]) == 4


# --- flying trial ---


SHORT = Circles(turns=1)
PLAIN = replace(HALL, floor_effect=False)
PERFECT = replace(
    PLAIN, noise=0.01, outlier_share=0.0, delay=0.0, bearing_bias=0.0, imu=NO_IMU_ERRORS
)


@pytest.fixture(scope="module")
def plain():
    return fly(Task(PERFECT, seed=3, given="place", path=SHORT))


def test_it_takes_off_follows_the_path_and_lands(plain):
    verdict = verdict_of(plain)
    assert verdict["landed"] and verdict["why"] == ""
    assert plain.missions[0].state == DONE and plain.missions[0].started == 4.0
    assert verdict["tracking"] < 0.2 and verdict["place"] < 0.1 and verdict["touchdown"] < 0.4
    assert plain.flight.truth.p[:, 2].max() == pytest.approx(HEIGHT, abs=0.2)
    assert [*verdict["phases"]] == ["before", "lift_off", "air", "landing", "after"]


@pytest.mark.slow
def test_the_same_task_is_the_same_flight_and_another_seed_another_one(plain):
    again = fly(plain.task)
    np.testing.assert_array_equal(again.states, plain.states)
    np.testing.assert_array_equal(again.flight.tdoa.d, plain.flight.tdoa.d)
    other = fly(replace(plain.task, seed=4))
    assert not np.array_equal(other.states[0], plain.states[0])


def test_what_was_measured_is_a_flight_of_the_truth(plain):
    flight = plain.flight
    truth, tdoa = flight.truth, flight.tdoa
    p = np.stack([np.interp(tdoa.t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    at = (
        flight.anchors.positions[flight.anchors.index(tdoa.b)],
        flight.anchors.positions[flight.anchors.index(tdoa.a)],
    )
    residual = tdoa.d - (np.linalg.norm(p - at[0], axis=1) - np.linalg.norm(p - at[1], axis=1))
    assert np.std(residual) == pytest.approx(0.01, rel=0.05)
    assert len(tdoa) / (truth.t[-1] - truth.t[0]) == pytest.approx(360.0, rel=0.03)
    still = (flight.imu.t > 1.0) & (flight.imu.t < 3.9)
    np.testing.assert_allclose(flight.imu.accel[still].mean(axis=0), [0.0, 0.0, 9.81], atol=1e-3)


def test_through_a_silence_and_by_late_samples_it_flies_on():
    world = replace(PERFECT, silence=("circle", 3.0), latency=0.05)
    flown = fly(Task(world, seed=3, given="place", path=SHORT))
    heard = flown.flight.tdoa.t
    gap = np.argmax(np.diff(heard))
    began = flown.missions[0].started + RISE + 4.0
    assert heard[gap : gap + 2] == pytest.approx([began, began + 3.0], abs=0.02)
    assert flown.flight.truth.t[-1] - flown.odometry.t[-1] >= 0.05 - 1e-9
    assert verdict_of(flown)["safe"]


def test_inertial_samples_propagate_position_velocity_and_attitude(plain):
    flight, states = plain.flight, plain.states
    begin, end = np.searchsorted(flight.truth.t, (9.0, 11.0))  # on the circle
    p, v, q = (states[begin, of].copy() for of in (POSITION, VELOCITY, ATTITUDE))
    rows = slice(*np.searchsorted(flight.imu.t, (flight.truth.t[begin] + 1e-6, 11.0 - 1e-6)))
    samples = np.hstack([flight.imu.gyro, flight.imu.accel])[rows]
    integrate(flight.truth.t[begin], p, v, q, flight.imu.t[rows], samples)
    np.testing.assert_allclose(p, states[end - 1, POSITION], atol=0.2)
    np.testing.assert_allclose(v, states[end - 1, VELOCITY], atol=0.15)
    assert abs(q @ states[end - 1, ATTITUDE]) > math.cos(math.radians(0.5))


class Wrong(OwnFilter):
    """An estimate that is certain, and wrong from 12 s on."""

    speed, decay, turn, unsure, yaw_known = 0.0, math.inf, 0.0, False, True

    @property
    def pose(self):
        pose = super().pose
        if pose is None or pose[0] < 12.0:
            return pose
        t, p, v, q = pose
        turned = Rotation.from_euler("z", self.turn * (t - 12.0)) * Rotation.from_quat(q)
        speed = self.speed * math.exp((12.0 - t) / self.decay)
        return t, p, v + [0.0, speed, 0.0], turned.as_quat()

    @property
    def deviation(self):
        return 2.0 if self.unsure else super().deviation


@pytest.mark.parametrize(("speed", "turn"), [(1.5, 0.0), (0.0, 0.5)], ids=["velocity", "yaw"])
def test_an_estimate_that_the_imu_contradicts_is_not_flown_by(speed, turn):
    source = Wrong(PERFECT.anchors, FilterConfig())
    source.speed, source.turn = speed, turn
    trial = Trial(Task(PERFECT, 3, "place", path=SHORT), source)
    trial.fly()
    verdict = verdict_of(trial.result)
    assert verdict["safe"] and 12.0 < verdict["reported_lost"] < 13.5


def test_an_estimate_that_becomes_right_again_is_flown_by():
    source = Wrong(PERFECT.anchors, FilterConfig())
    source.speed, source.decay, source.yaw_known = 1.2, 0.1, False
    trial = Trial(Task(PERFECT, 3, "place", path=SHORT), source)
    trial.begin()
    while not trial.over:
        source.yaw_known = trial.simulator.now > 12.0  # so the wrong estimates are compared with
        trial.turn()
    verdict = verdict_of(trial.result)
    assert verdict["landed"] and verdict["reported_lost"] is None


def test_without_a_yaw_a_lost_vehicle_does_not_go_on():
    source = Wrong(PERFECT.anchors, FilterConfig())
    trial = Trial(Task(PERFECT, 3, "place", path=SHORT), source)
    trial.begin()
    states = []
    for end, source.unsure, source.yaw_known in (
        (10.0, False, True),
        (10.1, True, True),
        (10.3, False, False),
        (10.4, False, True),
    ):
        while trial.simulator.now < end:
            trial.turn()
        states.append(trial.missions[0].state)
    assert states == [FLYING, LOST, LOST, FLYING]


def test_an_effect_is_in_the_loop_what_inject_makes_of_it(plain):
    """On the same true path, it changes each TDOA as `inject` changes a recording."""
    effect = parse_effect("nlos", ["2.delay=0.4", "2.start=1", "2.end=3"])
    rules = Rules(rest=3.5, patience=0.0, arm=1e-6)  # the vehicle does not move
    task = Task(PERFECT, seed=3, given="place", path=SHORT, rules=rules)
    without, with_it = (
        fly(task).flight,
        fly(replace(task, world=replace(PERFECT, effects=EffectSet((effect,))))).flight,
    )
    np.testing.assert_allclose(with_it.tdoa.d, effect.inject(without).tdoa.d, atol=1e-9)
    assert not np.array_equal(with_it.tdoa.d, without.tdoa.d)


@pytest.mark.slow
def test_after_a_minute_it_flies_once_more_from_where_it_was_carried():
    flown = fly(
        Task(replace(PERFECT, outlier_share=0.01), seed=3, given="place", path=SHORT, again=True)
    )
    first, second = flown.missions
    assert np.linalg.norm(first.place - second.place) == pytest.approx(2.0, abs=0.3)
    assert second.begin - first.ended > 60.0 and second.started == pytest.approx(
        second.begin + 4.0, abs=0.02
    )
    truth, imu = flown.flight.truth, flown.flight.imu
    carried = truth.p[(truth.t > second.begin - 6.0) & (truth.t < second.begin)]
    assert carried[:, 2].max() == pytest.approx(0.53, abs=0.02)
    lifted = (imu.t > second.begin - 6.0) & (imu.t < second.begin - 4.0)
    assert np.abs(imu.accel[lifted, 2] - 9.81).max() > 0.3  # its sensors measure the lift
    verdict = verdict_of(flown)
    assert verdict["started"] == second.started
    assert position_at(np.array([truth.t[-1]]), truth)[0, 2] < 0.05


@pytest.mark.slow
def test_it_is_flown_by_what_a_network_corrects(tmp_path):
    path = Circles(turns=1, turn_time=4.0)
    task = Task(PERFECT, seed=1, given="place", path=path, model=str(known_answer.write(tmp_path)))
    plain, corrected = fly(replace(task, model=None)), fly(task)
    # the same samples until the vehicle moves, but different estimates
    np.testing.assert_array_equal(plain.flight.tdoa.d[:100], corrected.flight.tdoa.d[:100])
    n = min(len(plain.odometry.t), len(corrected.odometry.t))
    assert np.abs(plain.odometry.p[:n] - corrected.odometry.p[:n]).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table", "jitter"])
def test_a_world_that_changes_more_than_the_radio_can_be_flown_in(name):
    world = replace(WORLDS[name], sensors=("height", "pressure", "velocity"))
    flown = fly(
        Task(world, seed=1, path=Circles(turns=1, turn_time=2.0, radius=0.0), given="place")
    )
    assert (
        flown.missions[0].started is not None
        and len(flown.flight.height)
        and len(flown.flight.velocity)
    )
    assert flown.flight.truth.p[0, 2] == pytest.approx(world.table + 0.03, abs=0.005)
