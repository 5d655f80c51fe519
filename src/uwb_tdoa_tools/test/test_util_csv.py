# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import gzip
import time
import tracemalloc

import numpy as np
import pytest
from recordings import ANCHORS, FULL_HEADER, FULL_ROWS, csv_text

from uwb_tdoa_bias.common import errors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.readers import read_util_csv, tables

SUBSET = "t_tdoa,idA,idB,tdoa_meas,t_pose,pose_x,pose_y,pose_z"


@pytest.fixture
def read(tmp_path):
    def read(content, name="const9-trial1-tdoa2.csv", **options):
        file = tmp_path / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_util_csv(file, ANCHORS, **options)

    return read


@pytest.mark.parametrize("packed", [False, True])
def test_full_schema(read, packed):
    text = csv_text().encode()
    flight = read(gzip.compress(text), "const9-trial1-tdoa2.csv.gz") if packed else read(text)
    assert flight.name == "const9-trial1-tdoa2"
    np.testing.assert_array_equal(flight.tdoa.t, [0.010, 0.012, 0.014])
    np.testing.assert_array_equal(flight.tdoa.a, [0, 1, 5])
    np.testing.assert_array_equal(flight.tdoa.b, [1, 5, 0])
    np.testing.assert_array_equal(flight.tdoa.d, [0.25, -0.5, 0.75])
    np.testing.assert_array_equal(flight.imu.t, [0.001, 0.002, 0.003, 0.004])
    np.testing.assert_allclose(flight.imu.gyro[:3], np.pi * np.diag([1, 0.5, 0.25]))
    np.testing.assert_allclose(flight.imu.accel[2:], 9.81 * np.array([[0, 0, 2], [1, 0, 1]]))
    np.testing.assert_array_equal(flight.truth.t, [0.005, 0.009])
    np.testing.assert_array_equal(flight.truth.q[1], [0, 0, 0.6, 0.8])
    assert (len(flight.height), len(flight.pressure)) == (1, 1)
    assert flight.velocity is None  # one range is too few for a velocity from pixel counts


def test_subset_without_imu_and_attitude(read):
    flight = read(csv_text(SUBSET, ["0.1,0,1,0.5,0.2,1,2,3", "0.2,1,5,0.25,,,,"]))
    assert flight.imu is None
    assert len(flight.tdoa) == 2 and len(flight.truth) == 1
    assert np.isnan(flight.truth.q).all()


def test_windows_lines_byte_order_mark_and_foreign_columns(read):
    text = csv_text("t_tdoa,idA,idB,tdoa_meas,note", ["0.1,0,1,0.5,good"]).replace("\n", "\r\n")
    flight = read(b"\xef\xbb\xbf" + text.encode())
    assert len(flight.tdoa) == 1
    assert [
        "columns note, which the profile does not name" in line for line in flight.meta["unread"]
    ]


def test_stamps_that_fall_are_sorted_and_counted(read):
    flight = read(csv_text("t_tdoa,idA,idB,tdoa_meas", ["0.2,0,1,2", "0.1,0,1,1", "0.3,0,1,3"]))
    np.testing.assert_array_equal(flight.tdoa.d, [1, 2, 3])
    assert flight.meta["reordered"] == {"tdoa": 1}


TDOA = "t_tdoa,idA,idB,tdoa_meas"


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "empty"),
        ("\n\n", "has no column t_tdoa"),
        (
            "a,b\n1,2\n",
            "has no column t_tdoa; a UTIL CSV file has at least t_tdoa, idA, idB, tdoa_meas",
        ),
        (csv_text("t_tdoa,idA,idB", ["1,0,1"]), "has no column tdoa_meas"),
        (csv_text(TDOA + ",t_acc,acc_x,acc_y", ["1,0,1,1,1,0,0"]), "header: accel_z is missing"),
        (csv_text(TDOA + ",idA", ["1,0,1,1,0"]), "'idA' is there twice"),
        (csv_text(TDOA, []), "no row below its header"),
        (csv_text(TDOA, ["1,0,1,1", "2,0,1"]), "line 3: tdoa_meas is ''"),
        (csv_text(TDOA, ["1,0,1,1"])[:-1], "the last line has no line end"),
        (csv_text(TDOA, ["1,0,1,one"]), "line 2: tdoa_meas is 'one'"),
        (csv_text(TDOA, ["1,0,1,1", "2,0,1,nan"]), "line 3: tdoa_meas is 'nan'"),
        (csv_text(TDOA, ["inf,0,1,1"]), "line 2: t_tdoa is 'inf'"),
        (csv_text(TDOA, ["1,0.5,1,1"]), "line 2: idA is '0.5'"),
        (csv_text(TDOA, ["1,0,-1,1"]), "line 2: idB is '-1'"),
        (csv_text(TDOA, ["1,0,1,1", "2,0,,1"]), "line 3: idB is ''"),
    ],
)
def test_refused_with_the_line(read, text, sentence):
    with pytest.raises(InputError, match=sentence):
        read(text)


@pytest.mark.parametrize("cut", [1, 5, 11, 30, 60, -1, -5, -9, -20])
def test_cut_gzip_is_refused(read, cut):
    with pytest.raises(InputError):
        read(gzip.compress(csv_text().encode())[:cut])


def test_changed_byte_in_gzip_is_refused(read):
    packed = bytearray(gzip.compress(csv_text().encode()))
    packed[len(packed) // 2] ^= 1
    with pytest.raises(InputError, match="cut or damaged"):
        read(bytes(packed))


@pytest.mark.slow
def test_plain_file_cut_within_a_line_is_refused(read):
    whole = csv_text()
    for cut in range(1, len(whole)):
        text = whole[:cut]
        # indistinguishable from a shorter recording
        if text.endswith("\n") and text.count("\n") > 1:
            assert len(read(text).tdoa) == min(text.count("\n") - 1, 3)
        else:
            with pytest.raises(InputError):
                read(text)


def test_not_text(read):
    with pytest.raises(InputError, match="byte 0 is not text"):
        read(b"\xff\xfe" + FULL_ROWS[0].encode())
    with pytest.raises(InputError, match="is 0, not text"):
        read((FULL_HEADER + "\n\0\n").encode())


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_every_kind_of_line_end(read, end):
    assert len(read(csv_text().replace("\n", end)).tdoa) == 3


@pytest.mark.parametrize(
    ("text", "count", "said"),
    [
        (csv_text(TDOA, ["1,0,1,1", "2,0,1,2"])[:-3], 1, "1 of 2 records left out, line 3"),
        (csv_text(TDOA, ["1,0,1,1", "2,0", "3,0,1,1"]), 2, "line 3: idB is ''"),
        (csv_text(TDOA, ["1,0,1,1", "2,0,1,nan", "3,0,1,1"]), 2, "1 of 3 records left out"),
        (csv_text(TDOA, ["1,0,1,1", "2,0,1,one", "3,0,1,1"]), 2, "1 of 3 records left out"),
        (
            csv_text(TDOA + ",t_baro,baro", ["1,0,1,1e31,1,99.5", "2,0,1,2,2,99"]),
            1,
            "tdoa: 1 of 2 records left out",
        ),
        (
            csv_text(TDOA + ",t_tof,tof", ["1,0,1,1,1,31", "2,0,1,2,2,-1e12"]),
            2,
            "tof: 1 of 2 records left out",
        ),
    ],
)
def test_what_is_sound_can_be_read(read, text, count, said):
    with pytest.raises(InputError):
        read(text)
    flight = read(text, salvage=True)
    assert len(flight.tdoa) == count and said in " ".join(flight.meta["remarks"])


def test_a_cut_gzip_can_be_read_up_to_the_cut(read):
    rows = [f"{k / 100:.2f},0,1,{k % 7}.{k}" for k in range(5000)]
    packed = gzip.compress(csv_text(TDOA, rows).encode())
    for cut in (len(packed) // 2, len(packed) - 5):
        flight = read(packed[:cut], salvage=True)
        assert 1000 < len(flight.tdoa) <= 5000 and "cut or damaged" in flight.meta["remarks"][0]
    assert len(flight.tdoa) == 5000


def test_two_members_and_padding_are_one_file(read):
    head, tail = csv_text(TDOA, ["1,0,1,1"]), "2,0,1,2\n"
    assert (
        len(read(gzip.compress(head.encode()) + gzip.compress(tail.encode()) + b"\0" * 9).tdoa) == 2
    )


@pytest.mark.slow
def test_a_gzip_that_unfolds_without_end_is_refused(read, monkeypatch):
    monkeypatch.setattr(tables, "TABLE_BYTES", 4_000_000)
    packed = gzip.compress(csv_text(TDOA, ["1,0,1,1"]).encode() + b"\n" * 500_000_000, 1)
    tracemalloc.start()
    with pytest.raises(InputError, match="more than 4000000 bytes of text"):
        read(packed)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()


@pytest.mark.slow
def test_short_cells_take_less_memory_than_their_text_would(read, monkeypatch):
    monkeypatch.setattr(errors, "SECONDS", 100.0)  # to trace memory takes several times as long
    content = csv_text(TDOA, ["1,1,0,1"] * 200_000).encode()
    tracemalloc.start()
    flight = read(content)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(flight.tdoa) == 200_000 and most < 40e6  # 60e6 as rows of text


def test_a_row_without_end_is_refused(read):
    with pytest.raises(InputError, match="line 1: .*a row of more than 100000 characters"):
        read(TDOA + "\n" + "1," * 100_000 + "\n")
    with pytest.raises(InputError, match="a row of more than 100000 characters"):
        read(TDOA + "\n" + '"\n",' * 100_000 + "\n")


def test_more_cells_than_a_flight_has_are_refused(read, monkeypatch):
    monkeypatch.setattr(tables, "TABLE_CELLS", 40_000)
    content = csv_text(TDOA, ["1,1,0,1"] * 20_000)
    with pytest.raises(InputError, match="has more than 40000 cells"):
        read(content)


def test_sensors_of_different_length(read):
    rows = [f"{k},0,1,{k},{k if k < 3 else ''},{k if k < 3 else ''}" for k in range(7)]
    flight = read(csv_text(TDOA + ",t_baro,baro", rows))
    np.testing.assert_array_equal(flight.tdoa.d, range(7))
    np.testing.assert_array_equal(flight.pressure.t, range(3))
    holed = read(csv_text(TDOA + ",t_baro,baro", [*rows[:6], "6,0,1,6,7,99"]))
    np.testing.assert_array_equal(holed.pressure.t, [0, 1, 2, 7])
    with pytest.raises(InputError, match="line 4: tdoa_meas is 'x'; it must be a finite number"):
        read(csv_text(TDOA + ",t_baro,baro", [*rows[:2], "6,0,1,x,,"]))


def test_a_million_empty_members_of_gzip_take_no_time(read):
    """20 MB of empty members were not finished in 60 s.

    The time must grow linearly with the file, or reading must end at the time limit.
    """
    empty, packed = gzip.compress(b""), gzip.compress(csv_text(TDOA, ["1,0,1,1"]).encode())
    took = []
    for count in (20_000, 80_000):
        began = time.process_time()
        assert len(read(packed + count * empty).tdoa) == 1
        took.append(time.process_time() - began)
    assert took[1] < 8.0 * took[0]  # 16 times as long if each member copies the rest


def test_the_limit_of_seconds_holds_within_gzip(read, monkeypatch):
    monkeypatch.setattr(errors, "SECONDS", 0.0)
    monkeypatch.setattr(errors, "SECONDS_PER_BYTE", 0.0)
    with pytest.raises(errors.TooMuch, match="takes more than 0.0 s of processor time to read"):
        read(gzip.compress(csv_text(TDOA, ["1,0,1,1"]).encode()))
