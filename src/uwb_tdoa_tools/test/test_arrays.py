# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flights of arrays, lists and data frames, and units of time that cannot be."""

import numpy as np
import pytest
import uwb_tdoa as uwb

ANCHORS = {0: (0.0, 0.0, 0.3), 1: (7.0, 0.0, 2.8), 2: (7.0, 8.0, 0.3), "3": [0.0, 8.0, 2.8]}
T = np.arange(400) / 100.0  # s
RING = np.arange(400) % 4
TDOA = {"time": T, "anchor_a": RING, "anchor_b": (RING + 1) % 4, "tdoa": np.sin(T)}
IMU = {
    "time": T,
    "gyro": np.tile([0.0, 0.0, 90.0], (400, 1)),
    "accel": np.tile([0.0, 0.0, 1.0], (400, 1)),
}
TRUTH = {"time": T, "pose": np.ones((400, 3)), "pose_q": np.tile([0.0, 0.0, 0.0, 1.0], (400, 1))}


def test_a_flight_of_arrays_is_in_si_units():
    flight = uwb.flight(
        ANCHORS,
        tdoa=TDOA | {"time": 1000.0 * T, "tdoa": 1000.0 * TDOA["tdoa"]},
        imu=IMU,
        truth=TRUTH,
        units={"gyro": "deg/s", "accel": "g", "tdoa": {"time": "ms", "tdoa": "mm"}},
    )
    np.testing.assert_allclose(flight.tdoa.t, T)
    np.testing.assert_allclose(flight.tdoa.d, TDOA["tdoa"])
    np.testing.assert_allclose(flight.imu.gyro[:, 2], np.pi / 2)
    np.testing.assert_allclose(flight.imu.accel[:, 2], 9.81)
    assert flight.truth.q.tolist() == TRUTH["pose_q"].tolist()
    assert flight.anchors.ids.tolist() == [0, 1, 2, 3]


def test_lists_names_and_data_frames_are_read():
    names = {f"A{key}": place for key, place in ANCHORS.items()}
    table = {key: values.tolist() for key, values in TDOA.items()}
    table |= {key: [f"A{k}" for k in table[key]] for key in ("anchor_a", "anchor_b")}
    expected = uwb.flight(names, tdoa=table)
    assert expected.tdoa.b.tolist() == TDOA["anchor_b"].tolist()
    frame = pytest.importorskip("pandas").DataFrame(table)
    assert uwb.flight(names, tdoa=frame).tdoa.a.tolist() == expected.tdoa.a.tolist()
    records = np.rec.fromarrays([*TDOA.values()], names=[*TDOA])
    assert uwb.flight(ANCHORS, tdoa=records).tdoa.d.tolist() == TDOA["tdoa"].tolist()


@pytest.mark.parametrize(
    "tables, said",
    [
        (
            {"tdoa": TDOA | {"tdoa": T[1:]}},
            "tdoa: the columns have different lengths (time 400, anchor_a 400, anchor_b 400, tdoa 399",
        ),
        (
            {"tdoa": TDOA | {"tdoa": ["x"] * 400}},
            "tdoa: row 1: tdoa is 'x'; it must be a finite number",
        ),
        (
            {"tdoa": TDOA | {"anchor_a": ["B0"] * 400}},
            "tdoa: row 1: anchor_a is 'B0'; it must be an anchor of the survey",
        ),
        ({"tdoa": TDOA | {"dist": T}}, "tdoa: 'dist=dist' is not OURS"),
        ({"tdoa": {"time": T, "tdoa": T}}, "tdoa: anchor_a is missing"),
        (
            {"tdoa": {key: TDOA[key] for key in [*TDOA][1:]}},
            "tdoa: names no column with the time; write time: COLUMN",
        ),
        ({"tdoa": T}, "tdoa: has no columns"),
        ({"tdoa": TDOA, "imu": IMU | {"gyro": T}}, "imu: gyro has the shape (400,)"),
        ({"tdoa": TDOA, "units": {"tdoa": "mile"}}, "'mile' is no unit of tdoa"),
        (
            {"imu": IMU},
            "has nothing that the profile arrays takes TDOAs or ranges from; it has imu",
        ),
    ],
)
def test_what_cannot_be_a_flight_is_one_sentence(tables, said):
    with pytest.raises(uwb.InputError) as error:
        uwb.flight(ANCHORS, **tables)
    assert said in str(error.value) and str(error.value).endswith(".")


@pytest.mark.parametrize("anchors", [[1, 2], {0: (1.0, 2.0)}, {0: "here"}])
def test_anchors_that_are_none_are_one_sentence(anchors):
    with pytest.raises(uwb.InputError, match="^anchors: "):
        uwb.flight(anchors, tdoa=TDOA)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_a_time_in_another_unit_than_that_of_the_other_streams_is_refused(factor):
    with pytest.raises(uwb.InputError, match="give the unit of the time"):
        uwb.flight(ANCHORS, tdoa=TDOA, imu=IMU | {"time": factor * T})


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_a_rate_that_no_tag_has_is_refused(factor):
    with pytest.raises(uwb.InputError, match="cannot be; give the unit of the time"):
        uwb.flight(ANCHORS, tdoa=TDOA | {"time": factor * T})


def test_streams_of_other_lengths_are_read():
    """The IMU was switched off after a tenth of the time."""
    few = {name: values[:150] for name, values in IMU.items()}
    assert len(uwb.flight(ANCHORS, tdoa=TDOA | {"time": 10.0 * T}, imu=few).imu) == 150
