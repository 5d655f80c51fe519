import struct
import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recordings import ANCHORS, EVENTS, ROWS, log_bytes
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.readers import read_usd_log


@pytest.fixture
def read(tmp_path):
    def read(content):
        file = tmp_path / "flight"
        file.write_bytes(content)
        return read_usd_log(file, ANCHORS)

    return read


def test_streams_units_and_stamps(read):
    flight = read(log_bytes())
    assert flight.name == "flight"
    np.testing.assert_array_equal(flight.tdoa.t, [1.0005, 1.0025])
    np.testing.assert_array_equal(flight.tdoa.a, [0, 1])
    np.testing.assert_array_equal(flight.tdoa.b, [1, 5])
    np.testing.assert_array_equal(flight.tdoa.d, [1.25, -0.5])
    np.testing.assert_array_equal(flight.imu.t, [1.0, 1.001, 1.002])  # the accelerometer's 20 us later belong to these
    np.testing.assert_allclose(flight.imu.gyro, np.pi * np.array([[1, 0, -0.5], [0, 0.5, 0], [0, 0, 0.25]]))
    np.testing.assert_allclose(flight.imu.accel, 9.81 * np.array([[0, 0.5, 1], [0, 0, 2], [1, 0, 1]]))
    np.testing.assert_array_equal(flight.truth.p, [[1, 2, 0.5]])
    np.testing.assert_array_equal(flight.truth.q, [[0, 0, 0, 1]])
    assert "imu_accel_interpolated" not in flight.meta


def test_other_events_are_kept_sorted_and_empty_ones_are_not(read):
    flight = read(log_bytes())
    assert set(flight.extra) == {"estTemperature"}  # estFlow is defined but never occurs
    np.testing.assert_array_equal(flight.extra["estTemperature"]["t"], [1.0014, 1.0015])
    np.testing.assert_array_equal(flight.extra["estTemperature"]["baro.temp"], [20.5, 21.5])
    assert flight.meta["reordered"] == {"estTemperature": 1, "baro": 1}


def test_range_finder_and_barometer_in_si_units_one_row_for_each_reading(read):
    flight = read(log_bytes())
    np.testing.assert_array_equal(flight.height.t, [1.0012, 1.0013])
    np.testing.assert_array_equal(flight.height.range, [1.25, np.inf])  # 32767 mm: nothing in sight
    np.testing.assert_array_equal(flight.pressure.t, [1.0014, 1.0015])  # that of 1.00152 repeats the one before
    np.testing.assert_allclose(flight.pressure.pressure, [101325.0, 101325.0 - 12.013 * 101.5], atol=6.0)  # 12 Pa/m


def test_version_1_counts_milliseconds(read):
    rows = [(name, ticks // 1000, values) for name, ticks, values in ROWS]
    flight = read(log_bytes(rows, version=1))
    np.testing.assert_array_equal(flight.tdoa.t, [1.0, 1.002])
    np.testing.assert_array_equal(flight.imu.t, [1.0, 1.001, 1.002])
    assert flight.meta["format"] == "uSD log version 1"


def test_lost_accelerometer_event_is_interpolated(read):
    rows = [row for row in ROWS if row[:2] != ("estAcceleration", 1_001_020)]
    flight = read(log_bytes(rows))
    assert flight.meta["imu_accel_interpolated"]
    np.testing.assert_array_equal(flight.imu.t, [1.001, 1.002])  # before the first accelerometer sample there is none
    np.testing.assert_allclose(flight.imu.accel[0], 9.81 * np.array([0.49, 0.5 - 0.245, 1.0]), rtol=1e-6)


def test_without_imu_and_truth(read):
    flight = read(log_bytes([row for row in ROWS if row[0] == "estTDOA"]))
    assert flight.imu is None and flight.truth is None and len(flight.tdoa) == 2


@pytest.mark.parametrize("cut", [1, 2, 4, 5, 8, 30, 100, 150, 250, -1, -3, -4, -5, -20, -37])
def test_cut_anywhere_is_refused(read, cut):
    with pytest.raises(InputError, match="cut|damaged"):
        read(log_bytes()[:cut])


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, len(log_bytes()) - 1), flip=st.integers(1, 255))
def test_any_changed_byte_is_refused(read, position, flip):
    content = bytearray(log_bytes())
    content[position] ^= flip
    with pytest.raises(InputError):
        read(bytes(content))


def with_checksum(content):
    return content + struct.pack("<I", zlib.crc32(content))


@pytest.mark.parametrize(
    "content, sentence",
    [
        (b"", "empty"),
        (b"t_tdoa,idA\n", "byte 0 is 0x74"),
        (with_checksum(log_bytes()[:-4] + b"\xff\xff12345678"), "faulty logger"),
        (with_checksum(struct.pack("<BHH", 0xBC, 3, 0)), "version 3"),
        (with_checksum(struct.pack("<BHH", 0xBC, 2, 0)), "no TDOA"),
        (log_bytes(events=EVENTS | {"estOdd": (77, [("a", "Z")])}), "'a\\(Z\\)' is not a new variable of estOdd"),
        (log_bytes(events=EVENTS | {"estOdd": (3, [("a", "f")])}), "defined twice"),
        (log_bytes([], events={"estTDOA": (3, [("idA", "B")])}), "no variable idB"),
        (log_bytes([row for row in ROWS if row[0] != "estTDOA"]), "no TDOA"),
    ],
)
def test_refused_with_the_reason(read, content, sentence):
    with pytest.raises(InputError, match=sentence):
        read(content)
