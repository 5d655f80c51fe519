# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import os
import re
import struct
import tracemalloc
import zlib

from hypothesis import HealthCheck, given, settings, strategies as st
import numpy as np
from programs import python
import pytest
from recordings import ANCHORS, EVENTS, ROWS, log_bytes

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.readers import read_usd_log


@pytest.fixture
def read(tmp_path):
    def read(content, **options):
        file = tmp_path / "flight"
        file.write_bytes(content)
        return read_usd_log(file, ANCHORS, **options)

    return read


def test_streams_units_and_stamps(read):
    flight = read(log_bytes())
    assert flight.name == "flight"
    np.testing.assert_array_equal(flight.tdoa.t, [1.0005, 1.0025])
    np.testing.assert_array_equal(flight.tdoa.a, [0, 1])
    np.testing.assert_array_equal(flight.tdoa.b, [1, 5])
    np.testing.assert_array_equal(flight.tdoa.d, [1.25, -0.5])
    # accelerometer samples 20 us later get these stamps
    np.testing.assert_array_equal(flight.imu.t, [1.0, 1.001, 1.002])
    np.testing.assert_allclose(
        flight.imu.gyro, np.pi * np.array([[1, 0, -0.5], [0, 0.5, 0], [0, 0, 0.25]])
    )
    np.testing.assert_allclose(
        flight.imu.accel, 9.81 * np.array([[0, 0.5, 1], [0, 0, 2], [1, 0, 1]])
    )
    np.testing.assert_array_equal(flight.truth.p, [[1, 2, 0.5]])
    np.testing.assert_array_equal(flight.truth.q, [[0, 0, 0, 1]])
    assert "imu_accel_interpolated" not in flight.meta


CANDIDATES = [
    ("group", "I"),
    ("idA", "B"),
    ("idB", "B"),
    ("distanceDiff", "f"),
    ("isSelected", "B"),
]


def with_candidates(*but):
    """Return a log with the same TDOAs as candidates, with the other sign.

    Each packet has one more candidate, written 20 us later.
    """
    rows = [row for row in ROWS if row[0] not in but]
    packets = [row for row in ROWS if row[0] == "estTDOA"]
    for number, (_, ticks, (a, b, d)) in enumerate(packets):
        rows += [
            ("estTdoaCand", ticks, (7 + number, a, b, -d, 1)),
            ("estTdoaCand", ticks + 20, (7 + number, a, 5 - b, 9.0, 0)),
        ]
    events = {name: known for name, known in EVENTS.items() if name not in but}
    return log_bytes(rows, events=events | {"estTdoaCand": (20, CANDIDATES)})


@pytest.mark.parametrize("but", [(), ("estTDOA",)])
def test_all_candidates_of_a_packet_arrive_at_its_stamp_with_our_sign(read, but):
    flight = read(with_candidates(*but))
    np.testing.assert_array_equal(flight.tdoa.t, [1.0005, 1.0005, 1.0025, 1.0025])
    np.testing.assert_array_equal(flight.tdoa.a, [1, 4, 5, 0])
    np.testing.assert_array_equal(flight.tdoa.b, [0, 0, 1, 1])
    np.testing.assert_array_equal(flight.tdoa.d, [-1.25, 9.0, 0.5, 9.0])
    assert "estTdoaCand" not in flight.extra and ("estTDOA" in flight.extra) == (not but)
    assert flight.meta["remarks"] == [
        "estTdoaCand: all 4 candidates are TDOAs; the firmware used 2 of them."
    ]


def test_candidates_of_a_firmware_that_numbers_no_packets(read):
    rows = [("estTdoaCand", 1_000_500 + k, (1, 5, 0.5)) for k in range(3)]
    flight = read(log_bytes(rows, events={"estTdoaCand": (20, CANDIDATES[1:4])}))
    np.testing.assert_array_equal(flight.tdoa.t, [1.0005, 1.000501, 1.000502])


def test_other_events_are_kept_sorted_and_empty_ones_are_not(read):
    flight = read(log_bytes())
    assert set(flight.extra) == {"estTemperature"}  # estFlow is defined but never occurs
    np.testing.assert_array_equal(flight.extra["estTemperature"]["t"], [1.0014, 1.0015])
    np.testing.assert_array_equal(flight.extra["estTemperature"]["baro.temp"], [20.5, 21.5])
    assert flight.meta["reordered"] == {"estTemperature": 1, "baro": 1}


def test_range_finder_and_barometer_in_si_units_one_row_for_each_reading(read):
    flight = read(log_bytes())
    np.testing.assert_array_equal(flight.height.t, [1.0012, 1.0013])
    # 32767 mm: no target in sight
    np.testing.assert_array_equal(flight.height.range, [1.25, np.inf])
    # the reading at 1.00152 repeats the previous one
    np.testing.assert_array_equal(flight.pressure.t, [1.0014, 1.0015])
    np.testing.assert_allclose(
        flight.pressure.pressure, [101325.0, 101325.0 - 12.013 * 101.5], atol=6.0
    )  # 12 Pa/m


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
    # the samples before the first accelerometer sample are left out
    np.testing.assert_array_equal(flight.imu.t, [1.001, 1.002])
    np.testing.assert_allclose(
        flight.imu.accel[0], 9.81 * np.array([0.49, 0.5 - 0.245, 1.0]), rtol=1e-6
    )


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
        (
            log_bytes(events=EVENTS | {"estOdd": (77, [("a", "Z")])}),
            "'a\\(Z\\)' is not a new variable of estOdd",
        ),
        (log_bytes(events=EVENTS | {"estOdd": (3, [("a", "f")])}), "defined twice"),
        (log_bytes([], events={"estTDOA": (3, [("idA", "B")])}), "no variable idB"),
        (log_bytes([row for row in ROWS if row[0] != "estTDOA"]), "no TDOA"),
    ],
)
def test_refused_with_the_reason(read, content, sentence):
    with pytest.raises(InputError, match=sentence):
        read(content)


def with_number(name, column, value):
    """Return ROWS with one number replaced."""
    rows, changed = [], False
    for event, ticks, values in ROWS:
        if event == name and not changed:
            values, changed = (*values[:column], value, *values[column + 1 :]), True
        rows.append((event, ticks, values))
    return rows


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize(
    ("name", "column", "said"),
    [
        ("estTDOA", 2, "tdoa, record 1 of 2 at 1.000 s: d is"),
        ("estGyroscope", 1, "gyro, record 1 of 3 at 1.000 s: y is"),
        ("estAcceleration", 0, "acc, record 1 of 3 at 1.000 s: x is"),
        ("estPose", 2, "pose, record 1 of 2 at 1.001 s: z is"),
        ("estPose", 5, "pose, record 1 of 2 at 1.001 s: qz is"),
        ("estBarometer", 0, "baro, record 1 of 3 at 1.002 s: baro is"),
    ],
)
def test_a_number_that_is_not_finite_is_refused_or_left_out(read, name, column, said, value):
    rows = [
        *with_number(name, column, value),
        ("estPose", 1_003_000, (1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0)),
    ]
    with pytest.raises(InputError, match=said):
        read(log_bytes(rows))
    flight = read(log_bytes(rows), salvage=True)
    (remark,) = flight.meta["remarks"]
    assert "1 of " in remark and "left out" in remark
    whole = read(log_bytes([*ROWS, rows[-1]]))
    assert (
        sum(map(len, (flight.tdoa, flight.truth))) >= sum(map(len, (whole.tdoa, whole.truth))) - 1
    )
    numbers = (
        flight.tdoa.d,
        flight.imu.gyro,
        flight.imu.accel,
        flight.truth.p,
        flight.truth.q,
        flight.pressure.pressure,
    )
    for array in numbers:
        assert np.isfinite(array).all()


def test_an_altitude_above_the_air_is_refused_or_left_out(read):
    content = log_bytes(with_number("estBarometer", 0, 45_000.0))
    with pytest.raises(
        InputError, match="baro is 45000.0; it must be finite, within \\+-40000: leave"
    ):
        read(content)
    assert np.isfinite(read(content, salvage=True).pressure.pressure).all()


def test_a_cut_log_is_read_up_to_the_cut(read):
    whole, counts = log_bytes(), []
    start = whole.index(b"motion.deltaY(h)") + 17
    for cut in range(start, len(whole)):
        try:
            flight = read(whole[:cut], salvage=True)
        except InputError as error:
            assert re.search("no TDOA|never overlap|inside the header", str(error))
            continue
        assert "remarks" in flight.meta and np.isin(flight.tdoa.t, [1.0005, 1.0025]).all()
        counts.append(len(flight.tdoa))
    assert sorted(counts) == counts and set(counts) == {1, 2}


def test_a_damaged_log_is_read_up_to_the_damage(read):
    content = bytearray(log_bytes())
    where = content.index(struct.pack("<HQ", 3, 1_002_500))
    content[where] = 0xEE  # no event has this id
    flight = read(bytes(content), salvage=True)
    assert len(flight.tdoa) == 1 and f"from byte {where} on left out" in flight.meta["remarks"][0]
    content = bytearray(log_bytes())
    content[where + 9] = 0x7F  # a stamp of 292,000 years
    flight = read(bytes(content), salvage=True)
    assert len(flight.tdoa) == 1 and len(flight.meta["remarks"]) == 2


def test_names_of_our_streams_are_no_events(read):
    rows = [*ROWS, ("tdoa", 1_000_000, (1.0,)), ("pose", 1_000_000, (1.0,))]
    flight = read(
        log_bytes(rows, events=EVENTS | {"tdoa": (50, [("x", "f")]), "pose": (51, [("t", "f")])})
    )
    assert len(flight.tdoa) == 2 and set(flight.extra) == {"estTemperature", "tdoa", "pose"}


@pytest.mark.usefixtures("must_end")
def test_the_time_for_a_header_does_not_grow_with_the_square_of_its_types(read):
    events = {f"e{k}": (1000 + k, []) for k in range(900)} | EVENTS
    events["wide"] = (999, [(f"v{k}", "b") for k in range(9_000)])
    assert len(read(log_bytes(events=events)).tdoa) == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("types", "variables", "said"),
    [(40, 60_000, "more than 10000 variables"), (20_000, 0, "more than 1000 event types")],
)
def test_a_header_of_millions_of_variables_takes_no_memory(read, types, variables, said):
    """2.6 million variables, in 21 MB, took 1.3 GB."""
    content = log_bytes(
        [],
        events={
            f"e{k}": (1000 + k, [(f"v{i}", "b") for i in range(variables)]) for k in range(types)
        },
    )
    tracemalloc.start()
    with pytest.raises(InputError, match=said):
        read(content)
    assert tracemalloc.get_traced_memory()[1] < 2 * len(content) + 20e6
    tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [
        "cache_dir: planted\ncache_locator_classes: evil.Locator\ndisable_jit: 1\nopt: none",
        "[",
    ],
)
def test_a_folder_of_flights_does_not_say_where_compiled_code_is(tmp_path, setting):
    """numba looks for a configuration in its working directory.

    It would run code from such a cache or module.
    """
    (tmp_path / ".numba_config.yaml").write_text(f"{setting}\n")
    (tmp_path / "evil.py").write_text("open('planted', 'w').close()")
    (tmp_path / "flight.log").write_bytes(log_bytes())
    environment = {
        name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"
    } | {"XDG_CACHE_HOME": str(tmp_path)}
    reads = (
        "from recordings import ANCHORS; from uwb_tdoa_tools.readers import read_usd_log; "
        "read_usd_log('flight.log', ANCHORS); from uwb_tdoa_bias.common import compiled; "
        "assert not compiled.config.DISABLE_JIT"
    )
    environment["PYTHONPATH"] = os.pathsep.join(
        [os.path.dirname(__file__), environment.get("PYTHONPATH", "")]
    )
    ended = python("-c", reads, cwd=tmp_path, env=environment)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "uwb_tdoa").exists() and not (tmp_path / "planted").exists()
