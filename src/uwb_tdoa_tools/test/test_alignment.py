# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ground truth can be wrong as well: late, of another epoch, rotated, shifted, z down."""

from dataclasses import replace
import re

from known_effects import sparse_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EffectSet, true_samples
from uwb_tdoa_bias.effects.anchor import AnchorDelay
from uwb_tdoa_bias.effects.sensor import shifted
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import evaluate as evaluate_command
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import (
    _other_axes,
    align_truth,
    estimate_alignment,
    on_one_clock,
    require_truth,
    rigid_transform,
    transform_truth,
)

EPOCH = 1.7e9 - 12.3
TURN = Rotation.from_euler("z", 8.0, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def flight():
    return sparse_flight(100, 40.0)


@pytest.fixture(scope="module")
def odometry(flight):
    return run_offline(flight).odometry


@pytest.fixture(scope="module")
def bare(flight):
    return flight.without("imu")


@pytest.fixture(scope="module")
def path_of_bare(bare):
    return run_offline(bare).odometry


def in_frame(flight, axes=np.eye(3), shift=(0.0, 0.0, 0.0)):
    """Return the Flight with its ground truth in another frame."""
    return replace(
        flight, truth=transform_truth(flight.truth, np.asarray(axes, dtype=float), np.array(shift))
    )


def mislabelled(flight, one, two):
    """Return the Flight with the ids of two anchors exchanged in its TDOAs."""

    def other(ids):
        return np.where(ids == one, two, np.where(ids == two, one, ids))

    return replace(
        flight, tdoa=replace(flight.tdoa, a=other(flight.tdoa.a), b=other(flight.tdoa.b))
    )


def test_a_rigid_motion_is_found_beside_outliers():
    rng = np.random.default_rng(0)
    path = rng.standard_normal((300, 3))
    there = path @ TURN.T + [1.0, -2.0, 0.5]
    there[::10] += rng.standard_normal((30, 3))
    turn, shift = rigid_transform(path, there)
    np.testing.assert_allclose(turn, TURN, atol=0.01)
    np.testing.assert_allclose(shift, [1.0, -2.0, 0.5], atol=0.02)


def test_a_healthy_ground_truth_is_left_alone(flight, bare, odometry, path_of_bare):
    for one, path in ((flight, odometry), (bare, path_of_bare)):
        found = estimate_alignment(one, path)
        assert (
            found.late == 0.0
            and not found.frame_differs
            and found.clock_sentence() is None
            and found.frame_sentence() is None
        )
        same, said = align_truth(one)
        assert (
            said == ()
            and np.array_equal(same.truth.p, one.truth.p)
            and np.array_equal(same.truth.t, one.truth.t)
        )


def test_the_inertial_sensor_tells_that_the_ground_truth_is_late(flight):
    put_right, said = align_truth(shifted(flight, "truth", 0.4))
    np.testing.assert_allclose(put_right.truth.t, flight.truth.t, atol=0.02)
    assert (
        len(said) == 1
        and "the stamps of the ground truth are 0.4" in said[0]
        and "as gyroscope and accelerometer show" in said[0]
    )


def test_the_inertial_sensor_tells_that_the_tdoas_are_late_and_not_the_ground_truth(flight):
    same, said = align_truth(shifted(flight, "tdoa", 0.4))
    assert (
        said == ()
        and np.array_equal(same.truth.t, flight.truth.t)
        and np.array_equal(same.truth.p, flight.truth.p)
    )


def test_without_inertial_sensor_nothing_tells_which_is_late(bare):
    for stream, sign in (("truth", -1.0), ("tdoa", 1.0)):
        put_right, said = align_truth(shifted(bare, stream, 0.4))
        late = shifted(bare, stream, 0.4).truth.t
        np.testing.assert_allclose(put_right.truth.t, late + sign * 0.4, atol=0.03)
        assert (
            len(said) == 1
            and "ground truth or TDOAs are 0.4" in said[0]
            and "nothing of that goes to the nodes" in said[0]
        )


@pytest.mark.parametrize("name", ["flight", "bare"])
def test_another_epoch_is_refused_or_found(name, request):
    one = request.getfixturevalue(name)
    later = shifted(one, "truth", EPOCH)
    with pytest.raises(
        InputError,
        match=(
            "on another clock than the TDOAs: its stamps go from .* write both on one clock, or "
            "give --align"
        ),
    ):
        align_truth(later)
    for put_right in (align_truth(later, align="time")[0], on_one_clock(later, "time")):
        np.testing.assert_allclose(put_right.truth.t, one.truth.t, atol=0.03)
    assert on_one_clock(one) is one


@pytest.mark.parametrize(
    "axes", [np.diag([1, 1, -1]), [[1, 0, 0], [0, 0, -1], [0, 1, 0]]]
)  # z down; y up, as Motive writes it
def test_another_epoch_and_other_axes_at_once_are_found(flight, axes):
    later = shifted(in_frame(flight, np.transpose(axes)), "truth", EPOCH)
    put_right, said = align_truth(later, align="time")
    np.testing.assert_allclose(put_right.truth.t, flight.truth.t, atol=0.03)
    flown = flight.truth.p[:, 2] > 0.3
    away = np.linalg.norm(put_right.truth.p - flight.truth.p, axis=1)[flown]
    assert np.sqrt(np.mean(away**2)) < 0.06 and len(said) == 2


def test_a_path_that_repeats_itself_does_not_tell_the_epoch(bare):
    t = np.arange(0.0, 120.0, 0.01)
    circle = np.stack([np.cos(t), np.sin(t), np.full_like(t, 1.5)], axis=1)
    truth = replace(bare.truth, t=t + EPOCH, p=circle, q=np.full((len(t), 4), np.nan))
    path = replace(
        run_offline(bare).odometry,
        t=t,
        p=circle + 0.1 * np.random.default_rng(0).standard_normal(circle.shape),
    )
    tdoa = replace(
        bare.tdoa,
        **{name: np.resize(getattr(bare.tdoa, name), len(t)) for name in "abd"},
        t=t,
        variance=None,
    )
    with pytest.raises(InputError, match="its path does not determine the offset"):
        estimate_alignment(replace(bare, truth=truth, tdoa=tdoa), path)


def test_a_part_of_the_ground_truth_is_no_other_clock(flight):
    require_truth(
        replace(
            flight,
            tdoa=replace(
                flight.tdoa,
                **{name: getattr(flight.tdoa, name)[:5] for name in "tabd"},
                variance=None,
            ),
        )
    )


@pytest.mark.parametrize("name", ["flight", "bare"])
@pytest.mark.parametrize(
    ("axes", "shift", "words"),
    [
        (TURN, (0.0, 0.0, 0.0), r"turned by (7|8)\.\d degrees|or the frame of the truth is turned"),
        (np.eye(3), (0.5, -0.3, 0.0), r"shifted by \(0\.(4|5)\d, -0\.(2|3)\d"),
        (np.diag([1, 1, -1]), (0.0, 0.0, 0.0), "its axes x, y, z are x, y, -z of the survey"),
        (
            [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
            (0.0, 0.0, 0.0),
            "its axes x, y, z are y, x, -z of the survey",
        ),
        (
            [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
            (0.0, 0.0, 0.0),
            "its axes x, y, z are y, -x, z of the survey",
        ),
    ],
)
def test_another_frame_is_put_right(name, axes, shift, words, request):
    one = request.getfixturevalue(name)
    other = in_frame(one, axes, shift)
    put_right, said = align_truth(other)
    assert len(said) == 1 and re.search(words, said[0]), said
    flown = one.truth.p[:, 2] > 0.3
    away = np.linalg.norm(put_right.truth.p - one.truth.p, axis=1)[flown]
    assert np.sqrt(np.mean(away**2)) < 0.06


@pytest.mark.parametrize("name", ["flight", "bare"])
def test_wrong_ids_and_signs_are_no_other_frame(name, request):
    one = request.getfixturevalue(name)
    first, second, *_, last = one.anchors.ids.tolist()
    opposite = replace(one, tdoa=replace(one.tdoa, d=-one.tdoa.d))
    for wrong in (opposite, mislabelled(one, first, second), mislabelled(one, second, last)):
        same, said = align_truth(wrong)
        assert said == () and np.array_equal(same.truth.p, one.truth.p)


@pytest.mark.slow
def test_delays_of_anchors_that_shift_the_estimate_are_no_other_frame(flight, tmp_path, capsys):
    """The delays of all anchors imitate a tag that is shifted by 0.4 m along x.

    The TDOAs agree with a shifted frame in the middle of the room only. A correct ground truth
    stays where it is; the delays are corrected later. Without delays, a shifted ground truth is
    moved back.
    """
    shift, middle = np.array([0.4, 0.0, 0.0]), flight.truth.p.mean(axis=0)
    away = flight.anchors.positions - middle
    late = -(away / np.linalg.norm(away, axis=1)[:, None]) @ shift
    anchors = zip(flight.anchors.ids.tolist(), late.tolist())
    wrong = EffectSet([AnchorDelay({str(number): value for number, value in anchors})])
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] += wrong.bias(samples)
    delayed = replace(flight, tdoa=replace(flight.tdoa, d=d))
    found = estimate_alignment(delayed, run_offline(delayed).odometry)
    assert found.frame_differs, found.offset
    same, said = align_truth(delayed)
    assert said == () and np.array_equal(same.truth.p, flight.truth.p)
    write_bag(delayed, tmp_path / "delayed")
    assert evaluate_command.main([str(tmp_path / "delayed")]) == 0
    told = capsys.readouterr().err
    assert "run `diagnose` before you judge with --align frame" in told
    moved, said = align_truth(in_frame(flight, shift=shift))
    assert "another frame" in said[0]
    assert np.abs(moved.truth.p - flight.truth.p).max() < 0.1


@pytest.mark.slow
def test_no_healthy_recording_is_moved_and_every_late_one_is(shared_data):
    """Test every sixth of 37 recordings.

    The IMU determines the delay of the ground truth to 20 ms. Without an IMU, the TDOAs determine
    it to 30 ms.
    """
    reading = inputs.Reading(str(shared_data / "surveys"))
    found = inputs.find_flights(
        [shared_data / "flights", shared_data / "util"], shared_data / "surveys"
    )
    flights = reading.flights([str(path) for path, _ in found][::6])
    assert len(flights) == 7
    for one in flights:
        path = run_offline(one).odometry
        found = estimate_alignment(one, path)
        assert found.late == 0.0 and not found.frame_differs, one.name
        late = estimate_alignment(shifted(one, "truth", 0.4), path)
        assert abs(late.late - 0.4) < (0.03 if one.imu is None else 0.02), one.name
        assert late.source == ("tdoa" if one.imu is None else "inertial"), one.name
        down = estimate_alignment(in_frame(one, np.diag([1, 1, -1])), path)
        assert down.axes_differ and np.array_equal(down.axes, np.diag([1, 1, -1])), one.name
        epoch = estimate_alignment(shifted(one, "truth", EPOCH), path)
        assert abs(epoch.late - EPOCH) < 0.03, one.name


def test_a_frame_of_its_own_is_turned_and_not_mirrored(flight, odometry):
    """A mirror image may fit better by chance if the ground truth is metres away."""
    rng = np.random.default_rng(0)
    for turn in Rotation.random(100, random_state=1).as_matrix():
        other = in_frame(flight, turn, rng.uniform(-5.0, 5.0, 3))
        assert np.linalg.det(_other_axes(other.truth, odometry)) > 0.0
