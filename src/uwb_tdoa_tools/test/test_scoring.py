# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of a run: errors, consistency, phases, and figures of several runs."""

import math
import pickle
from types import SimpleNamespace

from hand_made import flown, truth_of
from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_ekf.core.memory import INVALID, LATE, REJECTED, STARTUP, USED
from uwb_tdoa_tools.evaluating import line_of_run, lines_of_attitude, lines_of_phases
from uwb_tdoa_tools.scoring.metrics import (
    ATTITUDE,
    LOSS,
    Pool,
    Score,
    clear_change,
    coverage,
    nees,
    nis,
    pooled,
    position_errors,
    scored_phase,
    summary,
)
from uwb_tdoa_tools.scoring.phases import TITLES, in_the_air, motion, phases

# --- metrics ---


UPRIGHT = [0.0, 0.0, 0.0, 1.0]


def straight(duration=10.0, rate=50.0, floor=1.0):
    """Return a Truth that moves along x at 1 m/s and 1 m height.

    It is on the floor for the first and last `floor` seconds.
    """
    t = np.arange(0.0, duration + 0.5 / rate, 1.0 / rate)
    z = np.where((t >= floor) & (t <= duration - floor), 1.0, 0.0)
    return Truth(t, np.stack([t, np.zeros(len(t)), z], axis=1), np.tile(UPRIGHT, (len(t), 1)))


def estimate(truth, error, low=0.0, high=10.0, std=0.1, rate=100.0):
    """Return odometry with errors error(t) (n, 3), m.

    std : stated standard deviation per axis, m
    """
    t = np.arange(low, high, 1.0 / rate)
    true = np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    covariance = np.tile(np.diag([std**2] * 3 + [1.0] * 6), (len(t), 1, 1))
    return SimpleNamespace(
        t=t, p=true + error(t), q=np.tile(UPRIGHT, (len(t), 1)), covariance=covariance
    )


def part_of(poses, rows):
    """Return some rows of hand-made poses."""
    return SimpleNamespace(**{name: values[rows] for name, values in vars(poses).items()})


def constant(x, y, z):
    return lambda t: np.tile([x, y, z], (len(t), 1))


def residuals(innovation, variance, verdict):
    return SimpleNamespace(
        innovation=np.array(innovation), variance=np.array(variance), verdict=np.array(verdict)
    )


def test_what_is_judged_is_from_the_first_to_the_last_instant_above_the_limit():
    truth = straight()
    assert scored_phase(truth) == ("in_the_air", 1.0, 9.0)
    truth.p[200:220, 2] = 0.1  # the floor is touched for a moment
    assert scored_phase(truth)[1:] == (1.0, 9.0)
    truth.p[:, 2] = np.where(truth.p[:, 2] > 0.5, 0.3, 0.0)  # 0.3 m is the limit, not above it
    assert scored_phase(truth)[0] == "moving"  # it never leaves the floor


def test_errors_are_against_the_truth_interpolated_to_the_estimate():
    truth = straight(rate=2.0)  # much coarser than the estimate, at other stamps
    odometry = estimate(truth, constant(0.1, -0.2, 0.3))
    t, error, covariance = position_errors(odometry, truth, *scored_phase(truth)[1:])
    assert t[0] >= 1.0 and t[-1] <= 9.0 and len(t) == 801
    np.testing.assert_allclose(error, np.tile([0.1, -0.2, 0.3], (801, 1)), atol=1e-9)
    assert covariance.shape == (801, 3, 3)


def test_what_lies_in_a_hole_of_the_truth_has_no_error():
    truth = straight()
    odometry = estimate(truth, constant(0.1, -0.2, 0.3))
    known = (truth.t < 4.0) | (truth.t > 6.0)
    # interpolation over the hole would be wrong
    truth = Truth(truth.t[known], truth.p[known] ** 2, truth.q[known])
    t, _, _ = position_errors(odometry, truth, *scored_phase(truth)[1:])
    assert np.sum(t <= 4.0) > 100 and np.sum(t >= 6.0) > 100 and not np.any((t > 4.02) & (t < 5.98))


def test_figures_of_a_constant_error():
    truth = straight()
    row = Score("flight", estimate(truth, constant(0.299, -0.4, 1.2)), truth).row()
    expected = {"rmse_x": 0.299, "rmse_y": 0.4, "rmse_z": 1.2}
    expected.update(
        dict.fromkeys(("rmse_3d", "median_3d", "max_3d"), np.sqrt(0.299**2 + 0.4**2 + 1.2**2))
    )
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, abs=1e-9), name
    assert row["flight"] == "flight" and row["frac_gt_1m"] == 1.0 and row["diverged"] is True
    assert row["nees_mean"] == pytest.approx((0.299**2 + 0.4**2 + 1.2**2) / 0.01)
    assert [row[f"coverage_3sigma_{axis}"] for axis in "xyz"] == [1.0, 0.0, 0.0]


def test_root_mean_square_is_the_root_of_the_summed_squares():
    errors = np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    found = summary(errors, np.array([9.0, 16.0, 0.0]), np.array([1.0, 3.0]))
    assert found["rmse_x"] == pytest.approx(np.sqrt(9.0 / 3)) and found["rmse_z"] == 0.0
    assert found["rmse_3d"] == pytest.approx(np.sqrt(25.0 / 3))
    assert found["rmse_3d"] ** 2 == pytest.approx(sum(found[f"rmse_{axis}"] ** 2 for axis in "xyz"))
    assert (found["median_3d"], found["max_3d"]) == (3.0, 4.0)
    assert (found["nees_mean"], found["nees_median"]) == (pytest.approx(25.0 / 3), 9.0)
    assert (found["nis_mean"], found["nis_median"]) == (2.0, 2.0)


@pytest.mark.parametrize("lost, diverged", [(0.24, False), (0.25, False), (0.26, True)])
def test_diverged_is_more_than_a_quarter_beyond_a_metre(lost, diverged):
    errors = np.zeros((100, 3))
    errors[: int(100 * lost), 0] = 1.001
    errors[int(100 * lost) :, 0] = 1.0  # exactly one metre does not count as beyond
    found = summary(errors, np.ones(100), np.ones(0))
    assert found["frac_gt_1m"] == pytest.approx(lost) and found["diverged"] is diverged


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_estimate_that_is_not_finite_has_diverged(bad):
    truth = straight()
    odometry = estimate(truth, constant(0.0, 0.0, 0.0))
    odometry.p[500] = bad
    assert Score("flight", odometry, truth).row()["diverged"]
    odometry = estimate(truth, constant(0.0, 0.0, 0.0))
    odometry.p[20] = bad  # times before take-off do not count
    assert not Score("flight", odometry, truth).row()["diverged"]


@pytest.mark.parametrize(
    "low, high, diverged, late_start",
    [
        (0.5, 10.0, False, False),
        (1.9, 10.0, False, False),
        (2.1, 10.0, True, True),
        (0.0, 3.0, True, False),  # ends in flight
        (9.5, 10.0, True, False),  # no estimate in the air
    ],
)
def test_an_estimate_of_a_part_of_the_flight_has_diverged(low, high, diverged, late_start):
    truth = straight()
    made = estimate(truth, constant(0.0, 0.0, 0.0), low=low, high=high)
    row = Score("flight", made, truth).row()
    assert (row["diverged"], row["late_start"]) == (diverged, late_start)
    line = line_of_run(row)
    assert line.endswith("LATE START") is late_start
    assert line.endswith("DIVERGED") is (diverged and not late_start)
    delay = max(0.0, low - 1.0) if low < 9.0 else np.inf
    assert row["start_delay"] == pytest.approx(delay, abs=0.011)
    assert np.isnan(row["rmse_3d"]) == (low > 9.0) == (row["frac_gt_1m"] == 1.0)


def test_nees_of_hand_made_errors():
    covariance = np.array(
        [np.diag([1.0, 4.0, 9.0]), [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]]
    )
    error = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 0.0]])
    np.testing.assert_allclose(nees(error, covariance), [3.0, 2.0 / 3.0])
    assert nees(np.empty((0, 3)), np.empty((0, 3, 3))).shape == (0,)


def test_an_odometry_that_claims_no_covariance_still_has_errors():
    """Many publishers of nav_msgs/Odometry leave the covariance zero."""
    truth = straight()
    row = Score("flight", estimate(truth, constant(0.1, 0.0, 0.0), std=0.0), truth).row()
    assert row["rmse_3d"] == pytest.approx(0.1) and not np.isfinite(row["nees_mean"])


def test_nis_counts_what_reached_the_filter():
    verdicts = [USED, REJECTED, LATE, INVALID, STARTUP]
    found = nis(
        residuals([1.0, 4.0, np.nan, np.nan, np.nan], [2.0, 4.0, np.nan, np.nan, np.nan], verdicts)
    )
    np.testing.assert_allclose(found, [0.5, 4.0])


def test_coverage_per_axis():
    error = np.array([[0.1, 0.35, 0.0], [0.29, -0.31, 0.0], [-0.31, 0.1, 0.0], [0.0, 0.4, 0.0]])
    covariance = np.tile(np.diag([0.01] * 3), (4, 1, 1))
    assert list(coverage(error, covariance).values()) == [0.75, 0.25, 1.0]
    assert all(map(np.isnan, coverage(np.empty((0, 3)), np.empty((0, 3, 3))).values()))


def test_pooled_with_a_run_that_never_started():
    truth = straight()
    scores = [
        Score("a", estimate(truth, constant(0.1, 0.0, 0.0)), truth),
        Score("b", estimate(truth, constant(0.0, 0.0, 0.0), low=9.5), truth),
    ]
    together = pooled(scores)
    assert (
        together["rmse_3d"] == pytest.approx(0.1)
        and together["diverged"] == 1
        and together["start_delay"] == np.inf
    )


def test_figures_pooled_of_what_runs_leave_are_those_of_all_samples():
    rng, scores = np.random.default_rng(3), []
    for seconds in (10.0, 6.0, 8.0):
        truth, spread = straight(seconds), rng.uniform(0.05, 2.0)
        innovation = rng.standard_normal(200)
        told = residuals(innovation, np.full(200, 0.5), np.full(200, USED))
        made = estimate(truth, lambda t: spread * rng.standard_normal((len(t), 3)), high=seconds)
        scores.append(Score(f"flight of {seconds:g} s", made, truth, told))
    error, covariance, of_nees, of_nis = (
        np.concatenate([getattr(score, name) for score in scores])
        for name in ("error", "covariance", "nees", "nis")
    )
    expected, together = summary(error, of_nees, of_nis), pooled(scores)
    of_runs = [score.row()["rmse_3d"] for score in scores]
    assert together["rmse_3d_mean_of_runs"] == pytest.approx(np.mean(of_runs))
    assert together["rmse_3d_max_of_runs"] == pytest.approx(max(of_runs))
    for name in (
        "rmse_x",
        "rmse_y",
        "rmse_z",
        "rmse_3d",
        "max_3d",
        "frac_gt_1m",
        "nees_mean",
        "nis_mean",
    ):
        assert together[name] == pytest.approx(expected[name], rel=1e-12), name
    for name in ("median_3d", "nees_median", "nis_median"):
        assert together[name] == pytest.approx(expected[name], rel=0.01), name
    for name, share in coverage(error, covariance).items():
        assert together[name] == pytest.approx(share), name


def test_what_a_run_leaves_does_not_grow_with_it():
    short, long = straight(10.0), straight(200.0)
    noise = np.random.default_rng(0)
    sizes = []
    for truth, end in ((short, 10.0), (long, 200.0)):
        made = estimate(truth, lambda t: 0.1 * noise.standard_normal((len(t), 3)), high=end)
        sizes.append(len(pickle.dumps(Score("flight", made, truth).result())))
    assert sizes[1] < 2.0 * sizes[0]  # for a flight 20 times as long


# --- phases ---


def test_phases_of_a_flight_are_those_of_the_data_and_leave_nothing_out():
    truth = flown()  # z > 0.1 m at 5.07 s, > 0.3 m at 5.27 s; 16.73 s and 16.93 s coming down
    found = phases(truth)
    expected = {
        "at_rest_earlier": (0.0, 3.07),
        "at_rest_before": (3.07, 5.07),
        "first_3_s": (5.07, 8.07),
        "to_0.3_m": (5.07, 5.27),
        "in_the_air": (5.27, 16.73),
        "last_3_s": (13.93, 16.93),
        "at_rest_after": (16.93, 21.0),
        "whole": (0.0, 21.0),
    }
    assert list(found) == list(expected)
    for name, span in expected.items():
        assert found[name] == pytest.approx(span, abs=0.025), name
    assert in_the_air(truth) == found["in_the_air"]


@pytest.mark.parametrize("floor", [-1.5, 0.0, 0.085])
def test_a_floor_that_is_not_at_zero_gives_the_same_departure(floor):
    """A vehicle at 0.085 m has not taken off at 1.5 cm above its floor."""
    truth = flown(floor)
    if floor < -1.0:
        truth.p[:, 2] += np.where(truth.p[:, 2] > -0.6, 1.0, 0.0)  # or it would never exceed 0.3 m
    assert motion(truth) == pytest.approx((5.07, 16.93), abs=0.025)


ROVER = ((0, 0, 0, 0.1), (4, 0, 0, 0.1), (14, 5, 0, 0.1), (20, 5, 0, 0.1))
OFF_A_TABLE = (
    (0, 0, 0, 0.75),
    (6, 0, 0, 0.75),
    (7, 0, 0, 1.75),
    (17, 4, 0, 1.75),
    (18, 4, 0, 0.0),
    (20, 4, 0, 0.0),
)
SLOW_TAKE_OFF = (
    (0, 0, 0, 0),
    (5, 0, 0, 0),
    (6, 0, 0, 0.2),
    (16, 0, 0, 0.2),
    (17, 0, 0, 1),
    (27, 0, 0, 1),
    (28, 0, 0, 0),
    (30, 0, 0, 0),
)


@pytest.mark.parametrize(
    "truth, expected, missing",
    [
        (flown(rest=0.6), {"at_rest_before": (0.0, 0.67)}, ["at_rest_earlier"]),
        (
            truth_of(*ROVER),
            {
                "at_rest_before": (2.2, 4.2),
                "first_3_s": (4.2, 7.2),
                "moving": (4.2, 13.8),
                "last_3_s": (10.8, 13.8),
                "at_rest_after": (13.8, 20.0),
            },
            ["in_the_air"],
        ),
        (
            truth_of((100, 0, 0, 1), (110, 8, 0, 1.5)),
            {"in_the_air": (100, 110), "first_3_s": (100, 103), "last_3_s": (107, 110)},
            ["at_rest_earlier", "at_rest_before", "at_rest_after", "moving"],
        ),
        (
            truth_of(*OFF_A_TABLE),  # at the end it rests 0.07 m above the floor
            {"at_rest_before": (4.1, 6.1), "at_rest_after": (17.96, 20.0)},
            [],
        ),
        (truth_of((0, 1, 2, 0.0), (30, 1, 2, 0.0)), {"at_rest_before": (0, 30)}, ["first_3_s"]),
        (truth_of((0, 1, 2, 1.0), (30, 1, 2, 1.0)), {"at_rest_before": (0, 30)}, ["first_3_s"]),
        (
            truth_of(*SLOW_TAKE_OFF),
            {"first_3_s": (5.35, 8.35), "in_the_air": (16.13, 27.7), "moving": (5.35, 27.93)},
            [],
        ),
    ],
)
def test_phases_are_those_of_the_motion(truth, expected, missing):
    found = phases(truth)
    for name, span in expected.items():
        assert found[name] == pytest.approx(span, abs=0.025), name
    assert not set(missing) & set(found)
    assert found["whole"] == (truth.t[0], truth.t[-1])


def covers(found):
    """Return whether the phases, except "whole", cover the whole time."""
    begin, end = found["whole"]
    for first, last in sorted(span for name, span in found.items() if name != "whole"):
        if first > begin + 1e-9:
            return False
        begin = max(begin, last)
    return begin >= end - 1e-9


def test_random_paths_have_phases_that_leave_nothing_out():
    """Random paths, down to single poses.

    There is no traceback, and each moment belongs to a phase.
    """
    rng = np.random.default_rng(0)
    for _ in range(300):
        count = int(rng.integers(1, 12))
        stamps = np.cumsum(rng.exponential(rng.choice([0.1, 2.0]), count))
        heights = np.where(
            rng.random(count) < 0.5, rng.uniform(-0.2, 0.4), rng.uniform(-0.5, 2.0, count)
        )
        sizes = rng.choice([0.0, 0.05, 3.0])
        truth = truth_of(
            *np.column_stack([stamps, *rng.normal(0.0, sizes, (2, count)), heights]),
            rate=rng.choice([2.0, 100.0]),
        )
        found = phases(truth)
        assert set(found) <= set(TITLES)
        if len(truth.t) > 1:
            assert covers(found), found
        else:
            assert not found


STD = 0.5


def odometry_of(truth, error, low=-np.inf, high=np.inf, rate=100.0, std=STD):
    """Return odometry of a Truth with errors error(t) (n, 3), m, from `low` to `high`, s."""
    t = np.arange(truth.t[0] + 0.5 / rate, truth.t[-1], 1.0 / rate)
    t = t[(t >= low) & (t <= high)]
    true = np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    return SimpleNamespace(
        t=t,
        p=true + error(t),
        q=np.tile(UPRIGHT, (len(t), 1)),
        covariance=np.tile(np.diag([std**2] * 3), (len(t), 1, 1)),
    )


def high_on_the_floor(truth, off=4.0):
    """Return errors that are `off` m along z until z > 0.3 m, and 0 in the air.

    Estimates of measured flights behave like this.
    """
    begin = phases(truth)["in_the_air"][0]
    return lambda t: np.where(t < begin, 1.0, 0.0)[:, None] * [0.0, 0.0, off]


def test_an_error_on_the_floor_is_told_beside_the_figure_of_the_air():
    truth = flown()
    score = Score("flight", odometry_of(truth, high_on_the_floor(truth)), truth)
    found = score.phases()
    assert score.row()["rmse_3d"] == pytest.approx(0.0, abs=1e-9) and not score.row()["diverged"]
    for name in ("at_rest_earlier", "at_rest_before", "to_0.3_m"):
        assert (
            found[name]["rmse_3d"]
            == found[name]["rmse_z"]
            == found[name]["max_3d"]
            == pytest.approx(4.0)
        )
        assert found[name]["nees_mean"] == pytest.approx(64.0) and found[name][
            "rmse_x"
        ] == pytest.approx(0.0, abs=1e-9)
        assert found[name]["std_3d"] == pytest.approx(STD * np.sqrt(3.0))
    assert found["first_3_s"]["max_3d"] == pytest.approx(4.0)
    for name in ("in_the_air", "last_3_s", "at_rest_after"):
        assert found[name]["rmse_3d"] == pytest.approx(0.0, abs=1e-9), name
    share = (phases(truth)["in_the_air"][0] - truth.t[0]) / 21.0
    assert found["whole"]["rmse_3d"] == pytest.approx(4.0 * np.sqrt(share), rel=0.01)


def test_the_step_is_the_largest_jump_between_estimates_and_where_it_is():
    truth = flown()
    found = Score(
        "flight", odometry_of(truth, high_on_the_floor(truth, 1.5), rate=20.0), truth
    ).phases()
    assert found["first_3_s"]["step"] == found["whole"]["step"] == pytest.approx(1.5)
    assert found["at_rest_before"]["step"] == pytest.approx(
        0.0, abs=1e-9
    )  # the motion itself is not a step
    assert found["last_3_s"]["step"] == pytest.approx(0.0, abs=1e-9)


def test_time_without_an_estimate_is_told_where_it_is():
    truth = flown()  # take-off at 5.07 s
    made = odometry_of(truth, lambda t: np.zeros((len(t), 3)), low=4.0)
    keep = (made.t < 10.0) | (made.t > 12.0)
    made = part_of(made, keep)
    found = Score("flight", made, truth).phases()
    assert found["at_rest_earlier"]["without_estimate"] == pytest.approx(
        found["at_rest_earlier"]["duration"]
    )
    assert found["at_rest_earlier"]["count"] == 0 and np.isnan(found["at_rest_earlier"]["rmse_3d"])
    assert found["at_rest_before"]["without_estimate"] == pytest.approx(4.0 - 3.07, abs=0.03)
    assert found["in_the_air"]["without_estimate"] == pytest.approx(
        1.9, abs=0.03
    )  # the last estimate holds for 0.1 s
    assert found["at_rest_after"]["without_estimate"] == pytest.approx(0.0, abs=0.03)
    assert found["whole"]["without_estimate"] == pytest.approx(4.0 + 1.9, abs=0.05)


def test_a_slow_odometry_has_no_gaps_and_an_end_is_one():
    truth = flown()
    made = odometry_of(truth, lambda t: np.zeros((len(t), 3)), high=18.0, rate=2.0)
    found = Score("flight", made, truth).phases()
    assert found["in_the_air"]["without_estimate"] == 0.0
    assert found["at_rest_after"]["without_estimate"] == pytest.approx(
        21.0 - 17.75 - 2.0, abs=0.01
    )  # the last estimate holds for 4 intervals


def test_time_without_truth_is_told():
    truth = flown()
    known = (truth.t < 8.0) | (truth.t > 10.0)
    truth = part_of(truth, known)
    found = Score("flight", odometry_of(truth, lambda t: np.zeros((len(t), 3))), truth).phases()
    assert (
        found["in_the_air"]["without_truth"]
        == pytest.approx(2.0, abs=0.03)
        == found["whole"]["without_truth"]
    )
    assert found["at_rest_before"]["without_truth"] == 0.0


def test_only_what_is_in_the_spans_counts():
    truth = flown()
    reach = (-np.inf, 4.07), (17.0, np.inf)
    found = Score(
        "flight", odometry_of(truth, high_on_the_floor(truth)), truth, reach=reach
    ).phases()
    assert found["at_rest_before"]["duration"] == pytest.approx(1.0, abs=0.03) and found[
        "at_rest_before"
    ]["max_3d"] == pytest.approx(4.0)
    assert (
        found["in_the_air"]["duration"] == 0.0
        and found["in_the_air"]["count"] == 0
        and np.isnan(found["in_the_air"]["rmse_3d"])
    )
    assert found["at_rest_after"]["duration"] == pytest.approx(4.0, abs=0.03)


def test_ready_is_counted_from_the_hundredth_tdoa():
    truth, nothing = flown(), lambda t: np.zeros((len(t), 3))
    heard = np.arange(0.0, 20.0, 0.01)
    for low, expected in ((1.6, 0.615), (0.5, -0.485)):
        score = Score("flight", odometry_of(truth, nothing, low=low), truth, heard=heard)
        assert score.row()["ready_delay"] == pytest.approx(expected, abs=0.011)
    assert np.isnan(
        Score("flight", odometry_of(truth, nothing), truth, heard=heard[:99]).row()["ready_delay"]
    )
    assert np.isnan(Score("flight", odometry_of(truth, nothing), truth).row()["ready_delay"])
    assert (
        Score("flight", odometry_of(truth, nothing, low=99.0), truth, heard=heard).row()[
            "ready_delay"
        ]
        == np.inf
    )


def test_a_rover_is_judged_over_its_motion():
    truth = truth_of(*ROVER)
    made = odometry_of(truth, lambda t: np.where(t < 4.0, 1.0, 0.2)[:, None] * [1.0, 0.0, 0.0])
    score = Score("rover", made, truth)
    row, found = score.row(), score.phases()
    assert row["part"] == "moving" and row["rmse_3d"] == pytest.approx(0.2) and not row["diverged"]
    assert found["moving"]["rmse_3d"] == pytest.approx(0.2) and found["at_rest_before"][
        "max_3d"
    ] == pytest.approx(1.0)


def test_a_tag_that_never_moves_is_judged_over_all():
    truth = truth_of((0, 0, 0, 0.1), (20, 0, 0, 0.1))
    row = Score(
        "still", odometry_of(truth, lambda t: np.tile([0.3, 0.0, 0.0], (len(t), 1))), truth
    ).row()
    assert row["part"] == "whole" and row["rmse_3d"] == pytest.approx(0.3) and not row["diverged"]


def test_a_pool_counts_the_runs_that_have_a_phase():
    pool, zero = Pool(), lambda t: np.zeros((len(t), 3))
    for truth in (flown(), flown(rest=1.0), truth_of((0, 0, 0, 1), (9, 8, 0, 1))):
        pool.add(Score("flight", odometry_of(truth, zero), truth).result())
    never = Score("never", odometry_of(flown(), zero, low=99.0), flown())
    pool.add(never.result())
    found = pool.figures()["phases"]
    assert {name: figures["runs"] for name, figures in found.items()} == {
        "at_rest_earlier": 2,
        "at_rest_before": 3,
        "first_3_s": 4,
        "to_0.3_m": 3,
        "in_the_air": 4,
        "last_3_s": 4,
        "at_rest_after": 3,
        "whole": 4,
    }
    assert found["at_rest_before"]["without_estimate"] == pytest.approx(
        2.0, abs=0.03
    )  # from the run that never started


def test_tables_tell_each_phase():
    truth = flown()
    made = odometry_of(truth, high_on_the_floor(truth))
    score, pool = (
        Score("flight", made, truth, heard=made.t[0] - 0.2 - np.arange(99.0, -1.0, -1.0)),
        Pool(),
    )
    pool.add(score.result())
    lines = lines_of_phases(score.phases())
    assert [line[:20].strip() for line in lines[1:4]] == [
        "at rest, earlier",
        "at rest before, 2 s",
        "first 3 s",
    ]
    assert (
        lines[2].split()[5:11] == ["2.000", "0.000", "0.000", "4.000", "4.000", "4.000"]
        and "64.00" in lines[2]
    )
    assert len({len(line) for line in lines}) == 1
    assert "runs: median" in lines_of_phases(pool.phases())[0] and "runs: median" not in lines[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_estimates_that_are_not_finite_spoil_their_phase_and_no_other(bad):
    truth = flown()
    made = odometry_of(truth, lambda t: np.zeros((len(t), 3)))
    made.p[50] = bad
    found = Score("flight", made, truth).phases()
    assert not np.isfinite(found["at_rest_earlier"]["rmse_3d"]) and not np.isfinite(
        found["whole"]["max_3d"]
    )
    assert found["at_rest_before"]["rmse_3d"] == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-0.5, 0.5), st.floats(0.005, 0.2))
def test_a_gain_counts_if_a_loss_is_unlikely(expected, std):
    """The reference is the normal distribution with this confidence interval."""
    interval = expected - 1.96 * std, expected + 1.96 * std
    loss = 0.5 * math.erfc((expected + LOSS) / std / math.sqrt(2.0))
    sure = expected / std > 1.96
    if abs(loss - 0.025) > 1e-3 and abs(expected / std - 1.96) > 1e-3:
        counts = sure or expected > LOSS and loss < 0.025
        assert (clear_change(1.0, 1.0 - expected, interval) > 0) == counts
        assert (clear_change(1.0, 1.0 - expected, interval) < 0) == (expected / std < -1.96)


def test_errors_of_attitude_and_their_covariance():
    """The estimate is turned by 10 degrees about the vertical, with 5 degrees stated."""
    truth, std = flown(), np.deg2rad(5.0)
    made = odometry_of(truth, constant(0.0, 0.0, 0.0))
    made.covariance = np.tile(np.diag([1.0] * 6 + [std**2] * 3), (len(made.t), 1, 1))
    yaw = Rotation.from_euler("z", 10.0, degrees=True)
    made.q = (yaw * Rotation.from_quat(np.tile(UPRIGHT, (len(made.t), 1)))).as_quat()
    known = Truth(truth.t, truth.p, np.tile(UPRIGHT, (len(truth.t), 1)))
    row = Score("flight", made, known).row()
    assert [row[name] for name in ATTITUDE] == pytest.approx([0.0, 0.0, 10.0, 5.0, 4.0], abs=1e-6)
    unknown = Truth(truth.t, truth.p, np.full((len(truth.t), 4), np.nan))
    assert np.isnan([Score("flight", made, unknown).row()[name] for name in ATTITUDE]).all()
    pool = Pool()
    pool.add(Score("flight", made, known).result())
    pool.add(Score("other", made, unknown).result())
    assert [*pool.attitudes] == ["flight"]
    (line,) = lines_of_attitude(pool.attitudes)
    assert "yaw 10.0 (5.0 stated); NEES 4.00" in line and not [*lines_of_attitude({})]
