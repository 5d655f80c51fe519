# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Findings of `check` against ground truth: TDOAs of a pair, stamps and inertial samples."""

from dataclasses import replace
import re

from known_effects import CLEAN, clean_flight
from number_faults import FAULTS
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, true_samples
from uwb_tdoa_tools.checking import motion_rules, pair_rules
from uwb_tdoa_tools.checking.check import judge_against_truth, judge_flight, judge_truth
from uwb_tdoa_tools.checking.motion_rules import TrueMotion, judge_imu, truth_unit
from uwb_tdoa_tools.checking.pair_rules import KnownPath, delays, repairs, wrong_stamps
from uwb_tdoa_tools.scoring.evaluation import require_truth
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# --- checking flight rules ---


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


@pytest.mark.parametrize("unit, factor", [("mm", 1000.0), ("cm", 100.0), ("feet", 1.0 / 0.3048)])
def test_a_ground_truth_in_another_unit_is_named_and_not_judged_against(flight, unit, factor):
    truth = replace(flight.truth, p=factor * flight.truth.p)
    (finding,) = truth_unit(flight.replaced(truth=truth))
    assert finding.rule == "truth_unit" and f"is in {unit}," in finding.cause
    with pytest.raises(InputError, match=f"the ground truth is in {unit}, and is read as metres"):
        require_truth(flight.replaced(truth=truth))
    assert not [*truth_unit(flight)] and not [*truth_unit(flight.replaced(truth=None))]


@pytest.mark.parametrize("shift", [(3.0, 0.0, 0.0), (-40.0, 5.0, 0.0), (1e5, 4e6, 0.0)])
@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0])
def test_a_ground_truth_in_another_frame_is_in_no_other_unit(flight, shift, turn):
    p = Rotation.from_euler("z", turn, degrees=True).apply(flight.truth.p) + shift
    assert not [*truth_unit(flight.replaced(truth=replace(flight.truth, p=p)))]


@pytest.mark.parametrize("turn", [("z", 90), ("z", 180), ("x", 180)])
def test_a_mounting_that_the_recorded_attitude_contradicts_is_named_by_check(flight, turn):
    by, imu = Rotation.from_euler(*turn, degrees=True), flight.imu
    turned = flight.replaced(imu=Imu(imu.t, by.apply(imu.gyro), by.apply(imu.accel)))
    assert judge_imu(turned, stamps=False) and not judge_imu(flight, stamps=False)
    assert judge_imu(turned.replaced(truth=None)) == []


def test_holes_and_jumps_of_the_truth_are_found(flight):
    of = flight.truth
    hidden = (of.t > 8.0) & (of.t < 10.5)
    (hole,) = judge_truth(replace(flight, truth=Truth(of.t[~hidden], of.p[~hidden], of.q[~hidden])))
    assert hole.rule == "truth_hole" and hole.value == pytest.approx(2.5, abs=0.1)
    (leap,) = judge_truth(replace(flight, truth=Truth(of.t, of.p + 0.5 * hidden[:, None], of.q)))
    assert leap.rule == "truth_leap" and "0.87 m" in leap.evidence
    assert list(judge_truth(flight)) == []


def test_missing_streams_are_not_judged(flight):
    assert judge_against_truth(replace(flight, truth=None)) == []
    bare = Truth(flight.truth.t, flight.truth.p, np.full_like(flight.truth.q, np.nan))
    assert (
        judge_against_truth(replace(flight, truth=bare))
        == judge_against_truth(replace(flight, imu=None))
        == []
    )


def test_ids_are_corrected_before_signs_are_judged(flight):
    of = flight.tdoa
    a, b = (np.where(ids == 2, 3, np.where(ids == 3, 2, ids)) for ids in (of.a, of.b))
    assert [
        finding.rule for finding in judge_against_truth(replace(flight, tdoa=replace(of, a=a, b=b)))
    ] == ["ids_exchanged"]


HARD = ("pair_late",)  # hidden by the noise in most draws
QUICK = ("tdoa_rounded", "ids_exchanged", "truth_leap")


def rules_of(flight, fault):
    found = judge_flight(FAULTS[fault].put_in(flight, np.random.default_rng(1)))
    assert all(finding.cause and finding.evidence and finding.remedy for finding in found)
    return [finding.rule for finding in found]


def test_a_healthy_flight_has_no_finding(flight):
    assert judge_flight(flight) == []


@pytest.mark.parametrize(
    "fault",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in FAULTS
        if name not in HARD
    ],
)
def test_a_fault_is_named_by_its_rule_once(flight, fault):
    found = rules_of(flight, fault)
    assert set(found) & set(FAULTS[fault].rules) and len(found) == len(set(found))


# --- checking pair rules ---


T = np.arange(600) / 20.0
TRUE = 3.0 * np.sin(0.5 * T)
D = TRUE + 0.1 * np.random.default_rng(0).standard_normal(len(T))


def fault_of(d, true=TRUE):
    """Return the name and the value of the first rule that reports a fault of a pair."""
    for rule in pair_rules.OF_PAIR:
        found = rule(d, true, T)
        if found is not None:
            return rule.__name__[1:], found[3]
    return None


@pytest.mark.parametrize("grid", [0.1, 0.37, 1.0, 2.5, 0.00469])
def test_rounding_is_found_and_ticks_of_the_radio_are_none(grid):
    found = ("rounded", pytest.approx(grid)) if grid > 0.01 else None
    assert fault_of(np.round(D / grid) * grid) == found


@pytest.mark.parametrize("every", [2, 3, 8])
def test_interpolation_is_found(every):
    known = np.arange(0, len(D), every)
    late = T + 0.01 * np.random.default_rng(1).uniform(size=len(T))
    for place in (np.arange(len(D)), late):
        d = np.interp(place, place[known], D[known])
        assert pair_rules._interpolated(d, TRUE, late)[0] == "is interpolated"


@pytest.mark.parametrize("every", [2, 5, 12])
def test_repeated_values_are_found(every):
    assert fault_of(D[np.arange(len(D)) // every * every])[0] == "repeated"


STILL = np.where((np.arange(len(D)) >= 200) & (np.arange(len(D)) < 300), D[199], D)


@pytest.mark.parametrize(
    ("d", "fault"),
    [
        (D, None),
        (np.minimum(D, 2.0), ("clipped", 2.0)),
        (np.maximum(D, -2.0), ("clipped", -2.0)),
        (np.clip(D, -1.5, 1.5), ("clipped", 1.5)),
        (STILL, ("frozen", T[199])),
        (-D, ("sign", pytest.approx(0.07, abs=0.02))),
    ],
)
def test_a_fault_of_a_pair_is_found_with_its_number(d, fault):
    assert fault_of(d) == fault


def test_a_wrong_sign_is_not_found_at_rest():
    assert fault_of(TRUE - D, np.zeros(600)) is None


def test_a_fault_of_all_pairs_is_one_finding():
    path = KnownPath(FAULTS["tdoa_sign"].put_in(clean_flight(100, 20.0), None))
    (found,) = pair_rules.wrong_values(path)
    assert found.rule == "tdoa_sign" and "pairs" in found.evidence


@pytest.mark.parametrize("cycle", [(1, 4), (0, 3, 6)])
def test_exchanged_ids_are_found(flight, cycle):
    table = dict(zip(cycle, np.roll(cycle, 1).tolist()))
    of = flight.tdoa
    a, b = (np.array([table.get(i, i) for i in ids.tolist()]) for ids in (of.a, of.b))
    renamed = KnownPath(
        type(flight)(
            flight.name,
            flight.anchors,
            type(of)(of.t, a, b, of.d),
            truth=flight.truth,
        )
    )
    found, before, after = pair_rules.find_exchanges(renamed)
    assert found == {called: anchor for anchor, called in table.items()} and after < 0.4 * before
    (finding,) = pair_rules.exchanged_ids(renamed)
    assert finding.rule == "ids_exchanged" and str(found[cycle[0]]) in finding.remedy


IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"2-3": -1.0})


@pytest.mark.parametrize("put_in", [(), (IDS,), (SIGN,), (IDS, SIGN)])
def test_injected_faults_are_undone(flight, put_in):
    changed = flight
    for effect in reversed(put_in):
        changed = effect.inject(changed)
    undone = repairs(changed)
    assert [(effect.name, effect.values) for effect in undone] == [
        (effect.name, effect.values) for effect in put_in
    ]
    back = EffectSet(undone).correct_streams(changed).tdoa
    assert np.array_equal(back.a, flight.tdoa.a) and np.array_equal(back.d, flight.tdoa.d)


def test_wrong_signs_are_no_exchange_of_ids(flight):
    (effect,) = repairs(replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d)))
    assert effect.name == "pair_sign" and len(effect.values) > 4


def test_without_ground_truth_nothing_is_repaired(flight):
    assert repairs(replace(flight, truth=None)) == ()


# --- checking time rules ---


TIMES = np.arange(0.0, 60.0, 0.02)
SERIES = np.arange(len(TIMES)) % 3


def course(t):
    return np.sin(1.3 * t) + 0.5 * np.sin(0.7 * t + SERIES)


def delays_of(late, noise=0.1):
    """Return the Delays of three series with noise and separate constant errors.

    late : delay of each sample (n,), s
    """
    measured = (
        course(TIMES - late) + SERIES + noise * np.random.default_rng(0).standard_normal(len(TIMES))
    )
    return delays(SERIES, TIMES, lambda delay: measured - course(TIMES - delay))


def test_no_delay_is_found_without_one():
    of = delays_of(np.zeros(len(TIMES)))
    assert of.constant() == (1.0, pytest.approx(0.0))
    assert min(of.drift()[0], of.jump()[0]) > 0.99


@pytest.mark.parametrize("late", [-0.4, 0.25])
def test_a_common_delay_is_found(late):
    ratio, delay = delays_of(np.full(len(TIMES), late)).constant()
    assert ratio < 0.9 and delay == pytest.approx(late)


def test_a_late_series_is_found():
    of = delays_of(0.3 * (SERIES == 1))
    assert [of.of_series(k)[1] for k in range(3)] == pytest.approx([0.0, 0.3, 0.0])
    assert of.of_series(1)[0] < 0.6 and of.of_series(0)[0] == 1.0


def test_a_clock_that_drifts_and_one_that_jumps():
    drifting, jumping = delays_of(TIMES / 60.0), delays_of(0.6 * (TIMES > 30.0))
    (ratio, by), (other, _, _) = drifting.drift(), drifting.jump()
    assert ratio < 0.9 and ratio < other and by == pytest.approx(0.95, abs=0.1)
    (other, _), (ratio, step, block) = jumping.drift(), jumping.jump()
    assert ratio < 0.9 and ratio < other and step == pytest.approx(0.6) and block == 6


def test_gross_errors_do_not_count():
    rng, late = np.random.default_rng(1), np.full(len(TIMES), 0.25)
    measured = course(TIMES - late) + np.where(
        rng.random(len(TIMES)) < 0.1, rng.uniform(-50.0, 50.0, len(TIMES)), 0.0
    )
    assert delays(SERIES, TIMES, lambda delay: measured - course(TIMES - delay)).constant()[
        1
    ] == pytest.approx(0.25)


def test_series_with_few_samples_are_not_judged():
    """In a hall, most pairs have few samples. Then some delay explains nearly all samples."""
    few, together = np.arange(3, 60), np.array([0, 1, 2, 3, 4, 5])
    t = np.concatenate([TIMES, 7.0 * few, TIMES[:300:50][together]])
    series = np.concatenate([SERIES, np.full(len(few), 3), np.full(len(together), 4)])
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(t))
    of = delays(series, t, lambda delay: np.sin(1.3 * t) + noise - np.sin(1.3 * (t - delay)))
    assert [of.of_series(k) for k in (3, 4)] == [(1.0, 0.0)] * 2 and of.of_series(0)[0] == 1.0


def test_few_samples_have_no_delay():
    few = np.arange(0.0, 600.0, 7.0)  # never five in a block
    of = delays(
        np.zeros(len(few), int), few, lambda delay: np.sin(1.3 * few) - np.sin(1.3 * (few - delay))
    )
    assert of.constant() == (1.0, 0.0) and of.exact() == 0.0
    assert of.drift() == (1.0, 0.0) and of.jump()[:2] == (1.0, 0.0)


def rules_found(flight):
    return {finding.rule: finding.value for finding in wrong_stamps(KnownPath(flight))}


def with_stamps(flight, t):
    return replace(flight, tdoa=replace(flight.tdoa, t=t))


@pytest.mark.slow
def test_late_drifting_and_jumping_stamps_are_found(flight):
    t = flight.tdoa.t
    assert rules_found(with_stamps(flight, t + 0.3)) == {"tdoa_late": pytest.approx(0.3)}
    assert list(rules_found(with_stamps(flight, t + 0.6 * (t - t[0]) / np.ptp(t)))) == [
        "tdoa_drift"
    ]
    assert rules_found(with_stamps(flight, t + 0.4 * (t > t.mean())))["tdoa_jump"] == pytest.approx(
        0.4
    )


def test_tdoas_out_of_order_are_found(flight):
    t = flight.tdoa.t
    order = np.lexsort((np.random.default_rng(0).random(len(t)), np.floor(t)))
    columns = {name: column[order] for name, column in vars(flight.tdoa).items()}
    assert list(rules_found(replace(flight, tdoa=replace(flight.tdoa, **{**columns, "t": t})))) == [
        "tdoa_reordered"
    ]


def test_a_late_pair_is_named(flight):
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] = tdoa(samples.p, samples.position_a, samples.position_b)
    d[rows] += 1e-3 * np.random.default_rng(0).standard_normal(len(rows))
    quiet = replace(flight, tdoa=replace(flight.tdoa, d=d))
    assert list(rules_found(FAULTS["pair_late"].put_in(quiet, np.random.default_rng(1)))) == [
        "pair_late"
    ]


# --- checking motion rules ---


def with_imu(flight, **columns):
    return replace(flight, imu=replace(flight.imu, **columns))


def said(flight):
    motion = TrueMotion(flight.imu, flight.truth)
    rules = motion_rules.wrong_axes, motion_rules.low_passes, motion_rules.wrong_stamps
    return {finding.rule: finding for rule in rules for finding in rule(motion)}


def test_what_is_measured_is_what_the_truth_does(flight):
    motion = TrueMotion(flight.imu, flight.truth)
    for sensor, noise in (("gyro", 0.05), ("accel", 0.3)):
        left = motion.measured[sensor] - motion.at(motion.true[sensor])
        assert np.std(left, axis=0).max() < noise
    assert said(flight) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    "order, signs", [([1, 0, 2], (1, 1, 1)), ([0, 1, 2], (-1, 1, 1)), ([2, 0, 1], (1, -1, 1))]
)
def test_axes_of_either_sensor(flight, order, signs):
    for sensor in ("gyro", "accel"):
        values = getattr(flight.imu, sensor)[:, order] * signs
        assert f"{sensor}_axes" in said(with_imu(flight, **{sensor: values}))


@pytest.mark.parametrize("axis, angle", [("z", 40.0), ("z", -125.0), ("x", 45.0), ("z", 3.0)])
def test_an_imu_that_is_mounted_at_an_angle(flight, axis, angle):
    turn = Rotation.from_euler(axis, angle, degrees=True)
    imu = flight.imu
    found = said(with_imu(flight, gyro=turn.apply(imu.gyro), accel=turn.apply(imu.accel)))
    if abs(angle) < 10.0:
        assert "imu_mounting" not in found
        return
    cause = found["imu_mounting"].cause
    degrees, about = re.search(r"by (\d+) degrees about (-?[xyz])", cause).groups()
    assert int(degrees) == pytest.approx(abs(angle), abs=5.0)
    assert about == f"{'-' * (angle < 0.0)}{axis}" and "gyro_axes" not in found


@pytest.mark.slow
@pytest.mark.parametrize("scale", [180.0 / np.pi, np.pi / 180.0])
def test_unit_of_the_gyroscope(flight, scale):
    assert said(with_imu(flight, gyro=flight.imu.gyro * scale))[
        "imu_rate_unit"
    ].value == pytest.approx(1.0 / scale)


def test_a_sensor_that_has_nothing_to_measure_is_in_no_other_unit():
    hover = simulate(SimulationConfig(seed=6, duration=30.0, trajectory="hover", **CLEAN))
    assert "imu_rate_unit" not in said(hover)


@pytest.mark.slow
@pytest.mark.parametrize("name", motion_rules.ATTITUDES)
def test_another_attitude_of_the_truth_is_not_another_gyroscope(flight, name):
    order, signs = motion_rules.ATTITUDES[name]
    q = np.empty_like(flight.truth.q)
    q[:, order] = flight.truth.q * np.array(signs)[order]
    found = said(replace(flight, truth=replace(flight.truth, q=q)))
    assert "truth_attitude" in found and name in found["truth_attitude"].cause


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_low_pass_in_a_sensor(flight, sensor):
    values = getattr(flight.imu, sensor)
    share = 0.001 / (0.001 + 0.4)
    filtered = lfilter([share], [1.0, share - 1.0], values - values[0], axis=0) + values[0]
    found = said(with_imu(flight, **{sensor: filtered}))
    assert (
        found["imu_filtered"].value in motion_rules.SLOWNESS
        and motion_rules.SENSORS[sensor] in found["imu_filtered"].cause
    )


def test_stamps_that_jump_or_drift(flight):
    t = flight.imu.t
    assert "imu_jump" in said(with_imu(flight, t=t + 0.4 * (t > t.mean())))
    assert "imu_drift" in said(with_imu(flight, t=t + 0.8 * (t - t[0]) / np.ptp(t)))
