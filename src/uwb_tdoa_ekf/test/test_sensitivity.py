# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from flights import fly, kept, with_ranges, with_sensors
import numpy as np
import pytest
from scipy.sparse import csr_array

from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, samples_at
from uwb_tdoa_bias.effects.samples import RADIO
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_ekf.smoother import FORGOTTEN, record_innovations

# Without decisions and adaptation the filter is nearly linear.
PLAIN = FilterConfig(
    robust="gate",
    gate=1e3,
    adapt_noise=False,
    recover=False,
    workspace_margin=1e3,
    initial_yaw_std=0.1,
)
# s. The start follows biases, too, and `Innovations` do not model it. It must be forgotten.
SETTLED = 4.0


@pytest.mark.parametrize("imu, aided", [(False, False), (True, True)])
def test_derivatives_are_those_of_two_runs(imu, aided):
    flight, step = fly(seed=3, duration=8.0, tdoa_std=0.02), 1e-4
    flight = with_sensors(flight) if aided else flight
    config = replace(PLAIN, use_imu=imu)
    keys = [str(i) for i in flight.anchors.ids[:3]]
    found = record_innovations(flight, config)
    a, b = (flight.anchors.index(ids[found.rows]) for ids in (flight.tdoa.a, flight.tdoa.b))
    samples = samples_at(flight.tdoa.t[found.rows], a, b, flight.truth, flight.anchors)
    derivative = found.by_bias(AnchorDelay().regressors(samples, keys))
    late = flight.tdoa.t[found.rows] > SETTLED
    for column, key in enumerate(keys):
        ends = [
            record_innovations(AnchorDelay({key: s}).inject(flight), config) for s in (-step, step)
        ]
        assert all(np.array_equal(end.rows, found.rows) for end in ends)
        numeric = (ends[1].value - ends[0].value) / (2.0 * step)
        start = found.by_bias(np.zeros((len(found.rows), 1)))[:, 0]
        assert (start == 0.0).all()
        error = numeric[late] - derivative[late, column]
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(numeric[late] ** 2))


def test_what_the_position_can_follow_leaves_little_trace():
    flight = fly(seed=4, duration=10.0)
    found = record_innovations(flight, PLAIN)
    a, b = (flight.anchors.index(ids[found.rows]) for ids in (flight.tdoa.a, flight.tdoa.b))
    samples = samples_at(flight.tdoa.t[found.rows], a, b, flight.truth, flight.anchors)
    # The same shift of all anchors.
    shift = EFFECTS["truth_frame"]().regressors(samples, ["x", "y", "z"])
    delay = AnchorDelay().regressors(samples, [str(flight.anchors.ids[0])])
    late = samples.t > SETTLED

    def kept(regressors):
        return np.sqrt(
            np.mean(found.by_bias(regressors)[late] ** 2) / np.mean(regressors[late] ** 2)
        )

    assert kept(shift) < 0.1 and kept(delay) > 0.5


@pytest.mark.parametrize("aided", [False, True])
def test_every_used_tdoa_is_found_in_the_history(aided):
    flight = fly(seed=5, duration=6.0, outliers=0.1)
    flight = with_sensors(flight) if aided else flight
    found = record_innovations(flight)
    places = np.concatenate(found.of)
    assert sorted(places[places >= 0].tolist()) == list(range(len(found.rows)))
    assert np.all(np.diff(flight.tdoa.t[found.rows]) >= 0.0)


def test_an_unknown_offset_of_ranges_bends_no_innovations_of_tdoas():
    flight = with_ranges(fly(seed=5, duration=6.0), std=0.1)
    calibrated = FilterConfig(range_offset_std=0.0)
    longer = without_offset(flight, -0.3)
    known, unknown, found = (
        record_innovations(*both)
        for both in ((flight, calibrated), (longer, calibrated), (longer,))
    )

    def beside(one):
        return np.sqrt(np.mean((one.value - known.value)[one.t > SETTLED] ** 2))

    assert beside(found) < 0.02 < 0.1 < beside(unknown)
    of_ranges = (
        record_innovations(longer, calibrated, streams=("tdoa", "range")),
        record_innovations(longer, streams=("tdoa", "range")),
    )
    # There the filter estimates the offset.
    np.testing.assert_array_equal(*(one.value for one in of_ranges))


def test_blocks_of_sparse_regressors_give_the_same():
    flight = fly(seed=5, duration=8.0)
    found = record_innovations(flight)
    t = flight.tdoa.t[found.rows]
    rng = np.random.default_rng(0)
    regressors = rng.standard_normal((len(t), 5)) * (rng.random((len(t), 5)) < 0.4)
    # One bias acts only from 4 s on, the other only until 2 s.
    regressors[t < 4.0, 3] = 0.0
    regressors[t > 2.0, 4] = 0.0
    stamps = np.array([1.0, 5.0, 7.5])

    def of_blocks(block):
        out, positions = np.zeros_like(regressors), np.zeros((3, 3, 5))
        for rows, columns, values in found.in_blocks(
            csr_array(regressors), block, stamps, positions
        ):
            out[rows, columns] = values
        return out, positions

    whole, moved = of_blocks(np.zeros(len(t), int))
    np.testing.assert_array_equal(whole, found.by_bias(regressors))
    out, positions = of_blocks(((t - t[0]) / 3.0).astype(int))
    np.testing.assert_array_equal(out, whole)
    np.testing.assert_array_equal(positions, moved)


def test_what_is_not_heard_any_more_is_forgotten():
    flight = fly(seed=5, duration=18.0)
    found = record_innovations(flight)
    t = flight.tdoa.t[found.rows]
    regressors = np.where(t < 2.0, 1.0, 0.0)[:, None] * np.ones((1, 2))
    regressors[:, 1] = 1.0
    blocks = list(found.in_blocks(csr_array(regressors), ((t - t[0]) / 1.0).astype(int)))
    assert blocks[0][1].tolist() == [0, 1] and blocks[-1][1].tolist() == [1]
    whole = found.by_bias(regressors)[:, 0]
    share = np.sqrt(np.mean(whole[t > 2.0 + FORGOTTEN] ** 2) / np.mean(whole[t < 2.0] ** 2))
    assert (
        share < 0.05
        # 0.04 for a common error of all TDOAs at the start: the accelerometer bias absorbs it. A
        # fit uses squares.
    )


@pytest.mark.parametrize("streams", [("range",), ("tdoa", "range")])
def test_derivatives_of_distances_beside_tdoas_are_those_of_two_runs(streams):
    """A late anchor delays its TDOAs and its distances."""
    flight, step, keys = with_ranges(fly(seed=3, duration=8.0, tdoa_std=0.02)), 1e-4, ["11", "14"]
    if "tdoa" not in streams:
        flight = replace(flight, tdoa=kept(flight.tdoa, slice(0)))
    found = record_innovations(flight, PLAIN, streams=streams)
    assert np.all(np.diff(found.t) >= 0.0) and [
        len(found.places(name)) > 500 for name in streams
    ] == [True] * len(streams)
    regressors = np.zeros((len(found.t), len(keys)))
    for name in streams:
        places = found.places(name)
        stream, a, b = RADIO[name].measured(flight)
        rows = found.rows[places]
        np.testing.assert_array_equal(stream.t[rows], found.t[places])
        samples = RADIO[name](
            **vars(samples_at(stream.t[rows], a[rows], b[rows], flight.truth, flight.anchors))
        )
        regressors[places] = AnchorDelay().regressors(samples, keys)
    derivative, late = found.by_bias(regressors), found.t > SETTLED
    for column, key in enumerate(keys):
        ends = [
            record_innovations(AnchorDelay({key: s}).inject(flight), PLAIN, streams=streams)
            for s in (-step, step)
        ]
        assert all(np.array_equal(end.rows, found.rows) for end in ends)
        numeric = (ends[1].value - ends[0].value) / (2.0 * step)
        error = numeric[late] - derivative[late, column]
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(numeric[late] ** 2))


def test_what_is_recorded_of_tdoas_does_not_depend_on_what_else_is():
    flight = with_ranges(fly(seed=6, duration=6.0))
    # Otherwise, the filter estimates the offset from them.
    calibrated = FilterConfig(range_offset_std=0.0)
    alone, both = (
        record_innovations(flight, calibrated, streams=streams)
        for streams in (("tdoa",), ("tdoa", "range"))
    )
    places = both.places("tdoa")
    np.testing.assert_array_equal(alone.rows, both.rows[places])
    np.testing.assert_array_equal(alone.value, both.value[places])
    np.testing.assert_array_equal(alone.variance, both.variance[places])


def test_ranges_that_the_filter_does_not_use_leave_no_innovations():
    flight = with_ranges(fly(seed=6, duration=4.0))
    found = record_innovations(flight, FilterConfig(use_range=False), streams=("tdoa", "range"))
    assert found.streams == ("tdoa",) and len(found.places("tdoa")) == len(found.t) > 0
    alone = record_innovations(flight.without("range"), streams=("tdoa", "range"))
    assert alone.streams == ("tdoa",)
