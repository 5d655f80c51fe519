# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags that are cut, damaged, not closed, or whose metadata.yaml is missing or wrong.

Each is read up to the damage, with a remark, and is left as it is.
"""

from dataclasses import replace
from pathlib import Path
import re
import shutil
import sqlite3
import struct

from hypothesis import HealthCheck, given, settings, strategies as st
import numpy as np
import pytest
from recordings import ANCHORS, differences, small_flight
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import Pressure, Velocity
from uwb_tdoa_tools.bags import MCAP, is_bag
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import PLUGINS, open_bag, zstd
from uwb_tdoa_tools.bags.messages import typestore
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.readers.inputs import Reading, find_flights

FLIGHT = small_flight(3.0, name="bag")  # two chunks of MCAP; a tree of three levels in SQLite
BOTH = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
FORMS = [  # storage, compression of rosbag2
    ("mcap", None),
    ("mcap", CompressionMode.FILE),
    ("mcap", CompressionMode.MESSAGE),
    ("mcap", CompressionMode.STORAGE),
    ("sqlite3", None),
    ("sqlite3", CompressionMode.FILE),
    ("sqlite3", CompressionMode.MESSAGE),
]
REMEDY = {"mcap": "mcap recover .*mcap -o recovered.mcap", "sqlite3": 'sqlite3 .*db3 ".recover"'}


def write(folder, storage="mcap", compression=None, flight=FLIGHT):
    """Return the path of a bag, folder/bag, and of its data file."""
    write_bag(flight, folder / "bag", storage)
    if compression is not None:
        (folder / "bag").rename(folder / "plain")
        writer = Writer(folder / "bag", version=9, storage_plugin=PLUGINS[storage])
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with open_bag(folder / "plain") as reader, writer:
            made = {
                one.topic: writer.add_connection(one.topic, one.msgtype, typestore=typestore())
                for one in reader.connections
            }
            for connection, stamp, data in reader.messages():
                writer.write(made[connection.topic], stamp, data)
    return folder / "bag", data_file(folder / "bag")


def data_file(bag):
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


def is_start(flight, start):
    """Return whether the streams of `start` are the first samples of those of `flight`."""
    return all(
        np.array_equal(getattr(start, name).t, getattr(flight, name).t[: len(getattr(start, name))])
        for name in ("tdoa", "imu")
    )


@pytest.mark.parametrize(("storage", "compression"), FORMS)
def test_a_bag_is_read_up_to_the_cut(tmp_path, storage, compression):
    bag, file = write(tmp_path, storage, compression)
    assert differences(FLIGHT, replace(read_bag(bag), name="bag")) == []
    content, counts = file.read_bytes(), []
    for share in (0.0, 0.25, 0.5, 0.9):
        file.write_bytes(content[: int(share * len(content))])
        try:
            flight = read_bag(bag, anchors=ANCHORS)
        except InputError as error:  # its first chunk, or what names its topics, is cut
            assert share < 0.5 and "holds no message that can be read" in str(error)
            counts.append(0)
            continue
        counts.append(len(flight.tdoa))
        said = " ".join(flight.meta["remarks"])
        assert is_start(FLIGHT, flight) and re.search(REMEDY[storage], said)
        assert ("zstd -d" in said) == (compression == CompressionMode.FILE)
    assert counts == sorted(counts) and 0.2 < counts[2] / len(FLIGHT.tdoa) < 0.7
    assert counts[3] > 0.7 * len(FLIGHT.tdoa)


@BOTH
@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(share=st.floats(0.0, 1.0, exclude_max=True), bits=st.integers(1, 255))
def test_a_changed_byte_raises_nothing_but_input_errors(tmp_path, storage, share, bits):
    bag = tmp_path / "bag"
    file = data_file(bag) if bag.exists() else write(tmp_path, storage, None, small_flight(0.1))[1]
    content = file.read_bytes()
    changed = bytearray(content)
    changed[int(share * len(content))] ^= bits
    file.write_bytes(changed)
    try:
        read_bag(bag)
    except InputError as error:
        assert str(error).endswith(".")
    finally:
        file.write_bytes(content)


def test_a_damaged_chunk_ends_what_is_read(tmp_path):
    bag, file = write(tmp_path)
    found = records(file.read_bytes())
    second = [place for place, (kind, _) in enumerate(found) if kind == 0x06][1]
    content = bytearray(found[second][1])
    content[24:28] = b"none"  # its checksum
    found[second] = 0x06, bytes(content)
    file.write_bytes(MCAP + b"".join(record(*one) for one in found) + MCAP)
    flight = read_bag(bag)
    assert is_start(FLIGHT, flight) and 0 < len(flight.tdoa) < len(FLIGHT.tdoa)
    assert "the checksum of a chunk is wrong" in flight.meta["remarks"][0]
    assert "metadata.yaml states" in flight.meta["remarks"][1]
    assert tuple(flight.meta["remarks"]) == read_recording(Reading(), bag).remarks


# --- what an MCAP file may lack ---


def record(kind, content):
    return struct.pack("<BQ", kind, len(content)) + content


def records(content):
    """Return [(opcode, content)] of an MCAP file."""
    found, at = [], len(MCAP)
    while at < len(content) - len(MCAP):
        kind, size = struct.unpack_from("<BQ", content, at)
        found.append((kind, content[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def flat(found):
    """Return the records with those of chunks instead of the chunks."""
    for kind, content in found:
        if kind == 0x06:
            yield from records(MCAP + content[40:] + MCAP)
        elif kind != 0x07:  # an index of messages in a chunk
            yield kind, content


def without_definition(kind, content):
    """Return the content of a record; of a schema without encoding and definition, as ROS writes some."""
    if kind != 0x03:
        return content
    (length,) = struct.unpack_from("<I", content, 2)
    return content[: 6 + length] + bytes(8)


@pytest.mark.parametrize("lacking", ["chunks", "definitions", "statistics", "summary", "all"])
def test_a_whole_mcap_file_needs_no_more_than_messages(tmp_path, lacking):
    bag, file = write(tmp_path)
    found = records(file.read_bytes())
    if lacking in ("chunks", "definitions"):
        found = list(flat(found))
    if lacking == "definitions":
        found = [(kind, without_definition(kind, content)) for kind, content in found]
    elif lacking == "statistics":
        found = [one for one in found if one[0] != 0x0B]
    elif lacking != "chunks":  # up to the end of the data, or all after it
        end = [kind for kind, _ in found].index(0x0F)
        found = found[: end + 1] + ([(0x02, bytes(20))] if lacking == "summary" else [])
    file.write_bytes(MCAP + b"".join(record(*one) for one in found) + MCAP)
    flight = read_bag(bag)
    assert differences(FLIGHT, flight) == [] and "remarks" not in flight.meta


@pytest.mark.parametrize(
    "content", [b"", MCAP, MCAP + MCAP, 100 * b"garbage", b"SQLite format 3\0"]
)
@pytest.mark.parametrize("name", ["x.mcap", "x.db3"])
def test_a_file_without_messages_is_refused(tmp_path, content, name):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / name).write_bytes(content)
    for path in (tmp_path / "bag", tmp_path / "bag" / name):
        with pytest.raises(InputError, match="no message that can be read|is not a bag"):
            read_bag(path)


# --- metadata.yaml ---


def edit(bag, old, new):
    text = (bag / "metadata.yaml").read_text()
    assert re.search(old, text)
    (bag / "metadata.yaml").write_text(re.sub(old, new, text))


def pack(file):
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()


WRONG = {  # what is changed in a bag and its data file
    "missing": lambda bag, file: (bag / "metadata.yaml").unlink(),
    "empty": lambda bag, file: (bag / "metadata.yaml").write_text(""),
    "no YAML": lambda bag, file: (bag / "metadata.yaml").write_text("{"),
    "other": lambda bag, file: (bag / "metadata.yaml").write_text("a: b"),
    "alias": lambda bag, file: edit(bag, "version: 9", "version: &v 9\n  other: *v"),
    "no counts": lambda bag, file: edit(bag, r"message_count: \d+", "message_count: 0"),
    "text as count": lambda bag, file: edit(bag, r"message_count: \d+", "message_count: many"),
    "no list": lambda bag, file: edit(bag, "relative_file_paths:", "relative_file_paths: x\n  y:"),
    "renamed": lambda bag, file: file.rename(bag / "before lunch"),
    "packed": lambda bag, file: pack(file),
    "packed, missing": lambda bag, file: (pack(file), (bag / "metadata.yaml").unlink()),
}
UNUSED = {  # nothing of these is needed
    "storage": lambda bag, file: edit(bag, "storage_identifier: .*", "storage_identifier: mine"),
    "topic": lambda bag, file: edit(bag, "name: /uwb/tdoa", "name: [/uwb/toda]"),
    "QoS": lambda bag, file: edit(bag, "reliability: reliable", "reliability: best_effort"),
    "version": lambda bag, file: edit(bag, "version: 9", "version: 99"),
    "twice": lambda bag, file: edit(bag, r"( *- )(bag\.\w+\n)", r"\1\2\1./\2"),
    "custom": lambda bag, file: edit(bag, "  custom_data:", "  custom_data: 5\n  other:"),
}


@BOTH
@pytest.mark.parametrize("what", [*WRONG, *UNUSED])
def test_a_sound_file_is_read_whatever_metadata_says(tmp_path, storage, what):
    flight = small_flight(0.2, name="bag")
    bag, file = write(tmp_path, storage, None, flight)
    (WRONG | UNUSED)[what](bag, file)
    before = {one.name: one.read_bytes() for one in bag.iterdir()}
    back = read_bag(bag)
    assert is_bag(bag) and differences(flight, back) == []
    assert {one.name: one.read_bytes() for one in bag.iterdir()} == before
    said = " ".join(back.meta.get("remarks", ()))
    assert ("metadata.yaml" in said) == (what in WRONG and what != "packed")


@BOTH
def test_a_single_file_of_any_name_is_read(tmp_path, storage):
    _, file = write(tmp_path, storage, None, small_flight(0.2))
    other = file.rename(tmp_path / "recording.2026")
    assert differences(small_flight(0.2), read_bag(other)) == []


@BOTH
def test_parts_are_one_recording(tmp_path, storage):
    """`ros2 bag record` splits a recording: NAME_0, NAME_1, ..., NAME_10. The last is NAME_10."""
    _, file = write(tmp_path, storage, None, small_flight(0.2))
    parts = tmp_path / "split"
    parts.mkdir()
    for number in (0, 10, 2):
        shutil.copy(file, parts / f"split_{number}{file.suffix}")
    assert [path for path, _ in find_flights([parts])] == [parts]
    assert len(read_bag(parts).tdoa) == 300
    (parts / f"split_2{file.suffix}").write_bytes(b"garbage")
    flight = read_bag(parts)  # the other parts are read
    assert len(flight.tdoa) == 200 and "split_2" in flight.meta["remarks"][1]


def test_a_part_that_is_not_there_is_named(tmp_path):
    bag, file = write(tmp_path)
    edit(bag, "  - bag.mcap\n", "  - bag.mcap\n  - bag_1.mcap\n")
    remark = "metadata.yaml names bag_1.mcap, which is not there. Read: bag.mcap."
    assert read_bag(bag).meta["remarks"] == [remark]
    file.unlink()
    with pytest.raises(InputError, match="holds no message that can be read"):
        read_bag(bag)


# --- SQLite ---


@pytest.fixture
def killed(tmp_path):
    """Return the data file of a recorder that was killed: two thirds of its messages are in the log."""
    _, written = write(tmp_path, "sqlite3")
    database = sqlite3.connect(written, isolation_level=None)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    rows = database.execute(
        "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
    ).fetchall()
    first = len(rows) // 3
    database.execute("DELETE FROM messages WHERE id > ?", (rows[first - 1][0],))
    database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for begin in range(first, len(rows), 500):
        database.execute("BEGIN")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[begin : begin + 500])
        database.execute("COMMIT")
    (tmp_path / "killed").mkdir()
    for file in written.parent.glob("*.db3*"):
        shutil.copy(file, tmp_path / "killed")
    database.close()
    return tmp_path / "killed" / written.name


def test_the_log_of_a_killed_recorder_is_read(killed):
    for file in killed.parent.iterdir():
        file.chmod(0o444)
    before = {path.name: path.read_bytes() for path in killed.parent.iterdir()}
    assert [path for path, _ in find_flights([killed.parent])] == [killed]
    for path in (killed, killed.parent):
        flight = read_bag(path)
        assert differences(FLIGHT, replace(flight, name="bag")) == []
        assert "The recorder did not close bag.db3." in flight.meta["remarks"][-1]
    assert {path.name: path.read_bytes() for path in killed.parent.iterdir()} == before


@pytest.mark.parametrize("damage", ["cut", "flipped", "header", "gone", "garbage"])
def test_a_damaged_log_is_read_up_to_the_damage(killed, damage):
    log = killed.with_name(f"{killed.name}-wal")
    content = bytearray(log.read_bytes())
    content[17 if damage == "header" else len(content) // 2] ^= 0xFF
    if damage == "cut":
        del content[len(content) // 2 :]
    log.write_bytes(100 * b"garbage" if damage == "garbage" else content)
    if damage == "gone":
        log.unlink()
    flight = read_bag(killed)
    assert is_start(FLIGHT, flight)
    in_log = damage in ("cut", "flipped")
    assert (0.5 if in_log else 0.3) < len(flight.tdoa) / len(FLIGHT.tdoa) < (0.8 if in_log else 0.4)
    if damage != "gone":
        assert re.search(r"\d+ of \d+ pages in bag.db3-wal are read", flight.meta["remarks"][0])


def test_a_cut_file_with_its_log_is_read_up_to_the_cut(killed):
    content = killed.read_bytes()
    killed.write_bytes(content[: len(content) // 6])
    flight = read_bag(killed)
    assert is_start(FLIGHT, flight) and 0 < len(flight.tdoa) < len(FLIGHT.tdoa)
    assert re.search(REMEDY["sqlite3"], " ".join(flight.meta["remarks"]))


@pytest.mark.parametrize(
    ("statement", "lost"),
    [
        ("UPDATE messages SET timestamp = 'soon' WHERE id = 20", 1),
        ("UPDATE messages SET timestamp = -5 WHERE id = 20", 1),
        ("UPDATE messages SET data = 'text' WHERE id = 20", 1),
        ("UPDATE messages SET topic_id = 77 WHERE id = 20", 1),
        ("UPDATE topics SET name = x'00ff' WHERE name = '/imu/data'", 3000),
        ("DROP TABLE message_definitions", 0),
        ("ALTER TABLE topics DROP COLUMN offered_qos_profiles", 0),
        ("DROP TABLE topics", None),
        ("ALTER TABLE messages RENAME COLUMN data TO datum", None),
    ],
)
def test_rows_that_are_no_messages_are_left_out(tmp_path, statement, lost):
    _, file = write(tmp_path, "sqlite3")
    with sqlite3.connect(file) as database:
        database.execute(statement)
    database.close()
    if lost is None:
        with pytest.raises(InputError, match="no such|no message that can be read"):
            read_bag(file)
        return
    remarks = read_bag(file).meta.get("remarks", [])
    assert remarks == ([f"bag.db3: {lost} messages cannot be read: left out."] if lost else [])


# --- numbers ---


@BOTH
def test_numbers_that_are_not_finite(tmp_path, storage):
    t, flight = np.array([10.0, 10.1]), small_flight(0.1)
    flight.tdoa.d[3] = np.nan
    flight.truth.p[5, 1] = 1e308  # a computation with it overflows
    flight.imu.accel[7, 2] = -np.inf
    pressure = Pressure(t, np.array([101325.0, np.nan]))
    velocity = Velocity(t, np.array([[0.5, 0.0, 0.0], [0.0, np.inf, 0.0]]), np.full((2, 3), 0.1))
    wrong = replace(flight, pressure=pressure, velocity=velocity)
    bag, _ = write(tmp_path, storage, None, wrong)
    said = r"/uwb/tdoa, message 4 of 50 at 10\.006 s: its number 3 is nan.*--salvage"
    with pytest.raises(InputError, match=said):
        read_bag(bag)
    back = read_bag(bag, salvage=True)
    lengths = [
        len(getattr(back, name)) for name in ("tdoa", "truth", "imu", "pressure", "velocity")
    ]
    assert lengths == [49, 24, 99, 1, 1] and len(back.meta["remarks"]) == 5


def test_nothing_is_left_behind(killed, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    read_bag(killed)
    assert list(Path(tmp_path / "temporary").iterdir()) == []
