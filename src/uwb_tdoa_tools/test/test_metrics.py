import json
from types import SimpleNamespace

import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_ekf.core.memory import INVALID, LATE, REJECTED, STARTUP, USED
from uwb_tdoa_tools.evaluating import line_of_run
from uwb_tdoa_tools.scoring.metrics import (
    Score,
    coverage,
    nees,
    nis,
    pooled,
    position_errors,
    scored_phase,
    summary,
)
from uwb_tdoa_tools.scoring.pooling import Pool, Result

UPRIGHT = [0.0, 0.0, 0.0, 1.0]


def straight(duration=10.0, rate=50.0, floor=1.0):
    """A truth that flies along x with 1 m/s at 1 m, on the floor for the first and last `floor`
    seconds.
    """
    t = np.arange(0.0, duration + 0.5 / rate, 1.0 / rate)
    z = np.where((t >= floor) & (t <= duration - floor), 1.0, 0.0)
    return Truth(t, np.stack([t, np.zeros(len(t)), z], axis=1), np.tile(UPRIGHT, (len(t), 1)))


def estimate(truth, error, low=0.0, high=10.0, std=0.1, rate=100.0):
    """Odometry that is off by error(t) (n, 3) m, and says that it is off by `std` per axis."""
    t = np.arange(low, high, 1.0 / rate)
    true = np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    covariance = np.tile(np.diag([std**2] * 3 + [1.0] * 6), (len(t), 1, 1))
    return SimpleNamespace(
        t=t, p=true + error(t), q=np.tile(UPRIGHT, (len(t), 1)), covariance=covariance
    )


def constant(x, y, z):
    return lambda t: np.tile([x, y, z], (len(t), 1))


def residuals(innovation, variance, verdict):
    return SimpleNamespace(
        innovation=np.array(innovation), variance=np.array(variance), verdict=np.array(verdict)
    )


def test_what_is_judged_is_from_the_first_to_the_last_instant_above_the_limit():
    truth = straight()
    assert scored_phase(truth) == ("in_the_air", 1.0, 9.0)
    truth.p[200:220, 2] = 0.1  # a touch of the floor in between counts
    assert scored_phase(truth)[1:] == (1.0, 9.0)
    truth.p[:, 2] = np.where(truth.p[:, 2] > 0.5, 0.3, 0.0)  # at the limit is not above it
    assert scored_phase(truth)[0] == "moving"  # which never leaves the floor


def test_errors_are_against_the_truth_interpolated_to_the_estimate():
    truth = straight(rate=2.0)  # much coarser than the estimate, which is off its grid
    odometry = estimate(truth, constant(0.1, -0.2, 0.3))
    t, error, covariance = position_errors(odometry, truth, *scored_phase(truth)[1:])
    assert t[0] >= 1.0 and t[-1] <= 9.0 and len(t) == 801
    np.testing.assert_allclose(error, np.tile([0.1, -0.2, 0.3], (801, 1)), atol=1e-9)
    assert covariance.shape == (801, 3, 3)


def test_what_lies_in_a_hole_of_the_truth_has_no_error():
    truth = straight()
    odometry = estimate(truth, constant(0.1, -0.2, 0.3))
    known = (truth.t < 4.0) | (truth.t > 6.0)
    truth = Truth(truth.t[known], truth.p[known] ** 2, truth.q[known])  # nothing to be interpolated
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
    errors[int(100 * lost) :, 0] = 1.0  # exactly a metre is not beyond it
    found = summary(errors, np.ones(100), np.ones(0))
    assert found["frac_gt_1m"] == pytest.approx(lost) and found["diverged"] is diverged


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_estimate_that_is_not_finite_has_diverged(bad):
    truth = straight()
    odometry = estimate(truth, constant(0.0, 0.0, 0.0))
    odometry.p[500] = bad
    assert Score("flight", odometry, truth).row()["diverged"]
    odometry = estimate(truth, constant(0.0, 0.0, 0.0))
    odometry.p[20] = bad  # before the take-off nobody looks
    assert not Score("flight", odometry, truth).row()["diverged"]


@pytest.mark.parametrize("begin, diverged", [(0.5, False), (1.9, False), (2.1, True)])
def test_a_late_start_is_told_and_too_late_is_a_diverged_run(begin, diverged):
    truth = straight()
    row = Score("flight", estimate(truth, constant(0.0, 0.0, 0.0), low=begin), truth).row()
    assert row["start_delay"] == pytest.approx(max(0.0, begin - 1.0), abs=0.011)
    assert row["diverged"] is row["late_start"] is diverged
    assert line_of_run(row).endswith("LATE START") is diverged and "DIVERGED" not in line_of_run(
        row
    )


def test_an_estimate_that_ends_in_mid_flight_has_diverged():
    truth = straight()
    assert Score("flight", estimate(truth, constant(0.0, 0.0, 0.0), high=3.0), truth).row()[
        "diverged"
    ]


def test_no_estimate_at_all_has_diverged():
    truth = straight()
    row = Score("flight", estimate(truth, constant(0.0, 0.0, 0.0), low=9.5), truth).row()
    assert (
        row["diverged"]
        and row["frac_gt_1m"] == 1.0
        and np.isnan(row["rmse_3d"])
        and row["start_delay"] == np.inf
    )
    assert not row["late_start"]


def test_nees_of_hand_made_errors():
    covariance = np.array(
        [np.diag([1.0, 4.0, 9.0]), [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]]
    )
    error = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 0.0]])
    np.testing.assert_allclose(nees(error, covariance), [3.0, 2.0 / 3.0])
    assert nees(np.empty((0, 3)), np.empty((0, 3, 3))).shape == (0,)


def test_an_odometry_that_claims_no_covariance_still_has_errors():
    """Many a publisher of nav_msgs/Odometry leaves the covariance zero."""
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
    np.testing.assert_allclose(coverage(error, covariance), [0.75, 0.25, 1.0])
    np.testing.assert_allclose(coverage(error, covariance, sigmas=1.0), [0.5, 0.25, 1.0])
    assert np.isnan(coverage(np.empty((0, 3)), np.empty((0, 3, 3)))).all()


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
    np.testing.assert_allclose(
        [together[f"coverage_3sigma_{axis}"] for axis in "xyz"], coverage(error, covariance)
    )


def test_what_a_run_leaves_survives_json_and_does_not_grow_with_it():
    short, long = straight(10.0), straight(200.0)
    noise = np.random.default_rng(0)
    sizes = []
    for truth, end in ((short, 10.0), (long, 200.0)):
        made = estimate(truth, lambda t: 0.1 * noise.standard_normal((len(t), 3)), high=end)
        sizes.append(len(json.dumps(Score("flight", made, truth).result().as_dict())))
    assert sizes[1] < 2.0 * sizes[0]  # 20 times as long
    never = Score("never", estimate(short, constant(0.0, 0.0, 0.0), low=9.5), short)
    nan = Score("nan", estimate(short, constant(np.nan, 0.0, 0.0)), short)
    for score in (Score("flight", made, truth), never, nan):
        one, other = Pool(), Pool()
        one.add(score.result())
        other.add(
            Result.from_dict(json.loads(json.dumps(score.result().as_dict(), allow_nan=False)))
        )
        assert repr(one.figures()) == repr(other.figures())
