# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags that are truncated, damaged or forged.

Each is refused with a reason, or read up to the damage.
"""

from dataclasses import replace
import json
from pathlib import Path
import shutil
import sqlite3
import struct
import zlib

from hypothesis import HealthCheck, example, given, settings, strategies as st
import numpy as np
import pytest
from recordings import differences, small_flight
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import Pressure, Velocity
from uwb_tdoa_tools.bags import mcap
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import messages, open_bag
from uwb_tdoa_tools.bags.integrity import CHECKSUM_KEY, NO_CHECKSUM, metadata

FLIGHT = small_flight(0.3)
BOTH = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """{storage: path of a bag of FLIGHT}."""
    folder = tmp_path_factory.mktemp("bags")
    for storage in ("mcap", "sqlite3"):
        write_bag(FLIGHT, folder / storage, storage)
    return {storage: folder / storage for storage in ("mcap", "sqlite3")}


def data_file(bag):
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


@pytest.fixture
def copy(bags, tmp_path):
    def copy(storage):
        shutil.copytree(bags[storage], tmp_path / storage)
        return tmp_path / storage

    return copy


def forget_sum(bag):
    """Remove the checksum from metadata.yaml, as in bags of other tools."""
    file = bag / "metadata.yaml"
    file.write_text(
        file.read_text().replace(metadata(bag)["custom_data"][CHECKSUM_KEY], NO_CHECKSUM)
    )


def flip(file, at, mask=1):
    content = bytearray(file.read_bytes())
    content[at] ^= mask
    file.write_bytes(content)


@BOTH
@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(share=st.floats(0.0, 1.0, exclude_max=True), mask=st.integers(1, 255))
def test_any_changed_byte_is_refused(bags, storage, share, mask):
    file = data_file(bags[storage])
    at = int(share * file.stat().st_size)
    flip(file, at, mask)
    try:
        with pytest.raises(InputError, match="cut or damaged"):
            read_bag(bags[storage])
    finally:
        flip(file, at, mask)


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(share=st.floats(0.0, 1.0, exclude_max=True), mask=st.integers(1, 255))
@example(share=0.0, mask=1)
def test_mcap_has_checksums_of_its_own(bags, share, mask):
    """Read the data file alone, without metadata.yaml.

    A changed byte is always detected. Two bytes at the place of the footer's checksums may be
    zeroed.
    """
    file = data_file(bags["mcap"])
    at = int(share * file.stat().st_size)
    flip(file, at, mask)
    try:
        with pytest.raises(InputError, match="cut or damaged|not a bag"):
            read_bag(file)
    finally:
        flip(file, at, mask)


def test_sums_are_where_others_look_for_them(bags):
    """MCAP specification: a CRC-32 of each unpacked chunk, of the data, and of the summary.

    The last CRC-32 includes the footer up to the checksum.
    """
    content = data_file(bags["mcap"]).read_bytes()
    with open(data_file(bags["mcap"]), "rb") as file:
        found = list(mcap.records(file, 8, len(content) - 8))
    sums = 0
    for record in found:
        body = content[record.content : record.end]
        if record.kind == mcap.CHUNK:
            size, crc = struct.unpack_from("<QI", body, 16)
            assert crc == zlib.crc32(body[40 : 40 + size])
        elif record.kind == mcap.DATA_END:
            assert struct.unpack("<I", body)[0] == zlib.crc32(content[: record.start])
        elif record.kind == mcap.FOOTER:
            (start,) = struct.unpack_from("<Q", body)
            assert struct.unpack_from("<I", body, 16)[0] == zlib.crc32(
                content[start : record.content + 16]
            )
        else:
            continue
        sums += 1
    assert sums >= 3


@BOTH
def test_a_bag_without_our_sum_is_read(copy, storage):
    bag = copy(storage)
    forget_sum(bag)
    assert differences(FLIGHT, read_bag(bag)) == []


@BOTH
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_a_cut_bag_is_read_up_to_the_cut(copy, storage, kept):
    bag = copy(storage)
    file = data_file(bag)
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    with pytest.raises(InputError, match="cut or damaged .*--salvage"):
        read_bag(bag)
    try:
        flight = read_bag(bag, salvage=True)
    except InputError as error:  # rosbags writes one chunk of a MB, and it is incomplete
        assert storage == "mcap" and "no message that can be read" in str(error)
        return
    n = len(flight.tdoa)
    assert 0 < n <= len(FLIGHT.tdoa) and "read up to there" in flight.meta["remarks"][0]
    np.testing.assert_array_equal(flight.tdoa.t, FLIGHT.tdoa.t[:n])


def test_a_cut_bag_of_several_chunks_is_read_up_to_the_cut(tmp_path):
    flight = small_flight(10.0)
    write_bag(flight, tmp_path / "bag")
    file = data_file(tmp_path / "bag")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with pytest.raises(InputError, match="the recording was cut.*--salvage"):
        read_bag(tmp_path / "bag")
    back = read_bag(tmp_path / "bag", salvage=True)
    n = len(back.imu)
    assert 0.3 < n / len(flight.imu) < 0.7 and len(back.meta["remarks"]) == 2
    np.testing.assert_array_equal(back.imu.gyro, flight.imu.gyro[:n])
    assert differences(
        flight, read_bag(file, anchors=back.anchors, salvage=True)
    )  # the file alone as well


@BOTH
def test_a_whole_bag_loses_nothing_by_salvage(bags, storage):
    flight = read_bag(bags[storage], salvage=True)
    assert (
        differences(FLIGHT, flight) == []
        and "remarks" not in flight.meta
        and flight.name == FLIGHT.name
    )


@BOTH
def test_numbers_that_are_not_finite(tmp_path, storage):
    flight = small_flight(0.1)
    flight.tdoa.d[3] = np.nan
    flight.truth.p[5, 1] = 1e308  # a computation with it overflows
    flight.imu.accel[7, 2] = -np.inf
    write_bag(flight, tmp_path / "bag", storage)
    with pytest.raises(
        InputError, match=r"/uwb/tdoa, message 4 of 50 at 10\.006 s: its number 3 is nan"
    ):
        read_bag(tmp_path / "bag")
    back = read_bag(tmp_path / "bag", salvage=True)
    assert (len(back.tdoa), len(back.truth), len(back.imu)) == (49, 24, 99) and len(
        back.meta["remarks"]
    ) == 3


@BOTH
def test_pressures_and_velocities_that_are_not_finite(tmp_path, storage):
    t = np.array([10.0, 10.1])
    pressure = Pressure(t, np.array([101325.0, np.nan]))
    velocity = Velocity(t, np.array([[0.5, 0.0, 0.0], [0.0, np.inf, 0.0]]), np.full((2, 3), 0.1))
    for sensor, said in (
        ({"pressure": pressure}, "/pressure, message 2 of 2 at 10.100 s: its number 1 is nan"),
        (
            {"velocity": velocity},
            "/velocity and /velocity/odometry, message 2 of 2 at 10.100 s: its number 2 is inf",
        ),
    ):
        write_bag(replace(small_flight(0.1), **sensor), tmp_path / "bag", storage, force=True)
        with pytest.raises(InputError, match=said):
            read_bag(tmp_path / "bag")
        back = read_bag(tmp_path / "bag", salvage=True)
        (name,) = sensor
        assert len(getattr(back, name)) == 1 and len(back.meta["remarks"]) == 1


@BOTH
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("message_count: 150", "message_count: 149"),
        ("message_count: 150", "message_count: 1000000"),
        ("message_count: 150", "message_count: many"),
        ("message_count: 150", "message_count: -1"),
        ("message_count: 150", "message_count: 1.5"),
        ("nanoseconds_since_epoch: ", "nanoseconds_since_epoch: x"),
        ("name: /uwb/tdoa", "name: /uwb/toda"),
        ("name: /uwb/tdoa", "name: [/uwb/tdoa]"),
        ("type: uwb_tdoa_msgs/msg/Tdoa\n", "type: uwb_tdoa_msgs\n"),
        ("type: uwb_tdoa_msgs/msg/Tdoa\n", "type: 3\n"),
        ("relative_file_paths:", "relative_file_paths: none\n  other:"),
        ("rosbag2_bagfile_information:", "rosbag2_bagfile_information: []\nother:"),
        ("version: 9", "version: 99"),
        ("version: 9", "version: 9\n  version: 9"),
        ("version: 9", "version: &v 9\n  other: *v"),
    ],
)
def test_metadata_that_is_wrong(copy, storage, old, new):
    bag = copy(storage)
    text = (bag / "metadata.yaml").read_text()
    assert old in text
    (bag / "metadata.yaml").write_text(text.replace(old, new))
    with pytest.raises(InputError):
        read_bag(bag)


@pytest.mark.parametrize(
    ("about", "name"),
    [
        ("{", "mcap"),
        ("[]", "mcap"),
        ('{"name": 3, "meta": []}', "mcap"),
        ('{"name": "../../etc/passwd"}', ".._.._etc_passwd"),
        ('{"name": "' + 300 * "x" + '"}', 100 * "x"),
        ('{"name": "$\\\\frac$<b>|\\u001b[2J"}', "__frac__b____2J"),
        ("[" * 100_000, "mcap"),
        ('{"name": "here", "meta": {"protocol": "tdoa2"}}', "here"),
    ],
)
def test_a_name_that_is_none_is_passed_over(copy, about, name):
    bag = copy("mcap")
    text = (bag / "metadata.yaml").read_text()
    lines = text.splitlines()
    first = next(k for k, one in enumerate(lines) if "uwb_tdoa_tools.flight:" in one)
    last = next(k for k in range(first + 1, len(lines)) if not lines[k].startswith("      "))
    lines[first:last] = [f"    uwb_tdoa_tools.flight: {json.dumps(about)}"]
    (bag / "metadata.yaml").write_text("\n".join(lines) + "\n")
    assert read_bag(bag).name == name


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE messages SET timestamp = 'soon' WHERE id = 20",
        "UPDATE messages SET data = 'text' WHERE id = 20",
        "UPDATE messages SET timestamp = 1.5 WHERE id = 20",
        "UPDATE topics SET name = x'00ff' WHERE id = 1",
        "DELETE FROM messages WHERE id = 20",
        "DROP TABLE topics",
        "ALTER TABLE messages RENAME COLUMN data TO datum",
    ],
)
def test_sqlite_with_other_things_in_it(copy, statement):
    bag = copy("sqlite3")
    forget_sum(bag)
    connection = sqlite3.connect(data_file(bag))
    connection.execute(statement)
    connection.commit()
    connection.close()
    with pytest.raises(InputError, match="cut or damaged"):
        read_bag(bag)


def chunked(compression, packed, size, crc=0):
    """Return an MCAP file with one chunk."""

    def record(kind, content):
        return struct.pack("<BQ", kind, len(content)) + content

    def text(content):
        return struct.pack("<I", len(content)) + content

    body = (
        struct.pack("<QQQI", 0, 1, size, crc)
        + text(compression)
        + struct.pack("<Q", len(packed))
        + packed
    )
    parts = [record(mcap.HEADER, text(b"ros2") + text(b"")), record(mcap.CHUNK, body)]
    parts += [record(mcap.DATA_END, bytes(4)), record(mcap.FOOTER, bytes(20))]
    return mcap.MAGIC + b"".join(parts) + mcap.MAGIC


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (chunked(b"", b"", 80 << 30), "claims 85899345920 bytes"),
        (chunked(b"", b"abc", 4), "does not hold the 4 bytes it claims"),
        (
            chunked(b"zstd", mcap.zstd.compress(bytes(1 << 28)), 1000),
            "does not hold the 1000 bytes",
        ),
        (
            chunked(b"lz4", mcap.lz4.frame.compress(bytes(1 << 26)), 1000),
            "does not hold the 1000 bytes",
        ),
        (chunked(b"zstd", b"nothing packed", 10), "cannot be unpacked"),
        (chunked(b"lz4", b"nothing packed", 10), "cannot be unpacked"),
        (chunked(b"br", b"x", 1), "compression b'br' is not known"),
        (chunked(b"", b"abc", 3, 7), "the checksum of a chunk is wrong"),
        (mcap.MAGIC + struct.pack("<BQ", 5, 80 << 30) + mcap.MAGIC, "claims 85899345920 bytes"),
        (mcap.MAGIC + mcap.MAGIC, "no footer"),
        (mcap.MAGIC, "does not end as MCAP does"),
    ],
)
def test_sizes_are_checked_before_they_are_believed(tmp_path, content, said):
    file = tmp_path / "forged.mcap"
    file.write_bytes(content)
    with pytest.raises(InputError, match=f"cut or damaged .*{said}"):
        read_bag(file)


@pytest.mark.parametrize(
    "mode", [CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE]
)
@BOTH
def test_compressed_bags(bags, tmp_path, mode, storage):
    if (mode, storage) == (CompressionMode.STORAGE, "sqlite3"):
        pytest.skip("is no such thing")
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(tmp_path / "packed", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with open_bag(bags["mcap"]) as reader, writer:
        made = {}
        for connection, stamp, data in messages(bags["mcap"], reader, reader.connections):
            if connection.topic not in made:
                made[connection.topic] = writer.add_connection(
                    connection.topic,
                    connection.msgtype,
                    msgdef=connection.msgdef.data,
                    rihs01=connection.digest,
                )
            writer.write(made[connection.topic], stamp, data)
    back = read_bag(tmp_path / "packed")
    assert differences(FLIGHT, back) == []
    if mode == CompressionMode.FILE:
        file = data_file(tmp_path / "packed")
        file.write_bytes(file.read_bytes()[:-100])
        with pytest.raises(InputError, match="cannot be unpacked"):
            read_bag(tmp_path / "packed")


def test_nothing_is_left_behind(bags, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    read_bag(bags["mcap"], salvage=True)
    assert list(Path(tmp_path).iterdir()) == []
