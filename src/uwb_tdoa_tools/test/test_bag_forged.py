# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Forged bags that would hang the reader, exhaust memory or mislead; invalid messages."""

from dataclasses import replace
import json
import signal
import sqlite3
import struct

import lz4.frame
import numpy as np
from programs import start
import pytest
from recordings import ANCHORS, small_flight
from rosbags.rosbag2 import Writer
from test_bag_repair import data_file, record, write

from uwb_tdoa_bias.common import errors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_tools.bags import MCAP, files
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag
from uwb_tdoa_tools.bags.files import PLUGINS, open_bag
from uwb_tdoa_tools.bags.messages import messages_of, typestore
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.estimate import with_antenna
from uwb_tdoa_tools.readers.inputs import Reading

BOTH = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"


@pytest.fixture
def tables(tmp_path):
    """Return an SQLite bag and a function that runs statements on its data file."""
    bag, file = write(tmp_path, "sqlite3", None, small_flight(0.1))

    def run(*statements):
        connection = sqlite3.connect(file)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return bag, run


@pytest.mark.parametrize(
    "statements",
    [
        (
            "DROP TABLE messages",
            (
                f"CREATE VIEW messages AS {ENDLESS} i AS id, 1 AS topic_id, i AS timestamp, x'00' "
                "AS data FROM n"
            ),
        ),
        ("ALTER TABLE topics RENAME TO other", f"CREATE VIEW topics AS {ENDLESS} * FROM other, n"),
        ("CREATE VIRTUAL TABLE more USING fts5(x)",),
        ("CREATE INDEX slow ON messages(hex(data))",),
        ("CREATE TRIGGER t AFTER INSERT ON topics BEGIN DELETE FROM messages; END",),
        (
            "DROP TABLE messages",
            (
                "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS "
                "(zeroblob(900000000)))"
            ),
        ),
        (
            "DROP TABLE messages",
            f"CREATE TABLE messages(id, topic_id, timestamp, data CHECK (data LIKE '{'%a' * 40}'))",
        ),
    ],
)
@pytest.mark.usefixtures("must_end")
def test_nothing_in_a_database_is_computed(tables, statements):
    bag, run = tables
    run(*statements)
    with pytest.raises(InputError, match="is no table and no index of columns"):
        read_bag(bag)


def test_a_row_that_fills_the_memory(tables, monkeypatch):
    bag, run = tables
    monkeypatch.setattr(files, "_MESSAGES", files._MESSAGES.replace("67108864", "1000000"))
    run("UPDATE messages SET data = zeroblob(1000001) WHERE id = 20")
    assert read_bag(bag).meta["remarks"] == [
        "bag.db3: 1 messages cannot be read: left out.",
        "metadata.yaml states 177 messages. The files hold 176, which are read.",
    ]


def test_messages_may_not_be_larger_than_all_of_them_may(tables, monkeypatch):
    bag, run = tables
    monkeypatch.setattr(errors, "UNPACKED_FREE", 0)
    monkeypatch.setattr(errors, "UNPACKED_RATIO", 0.1)
    run("PRAGMA user_version = 1")
    assert (
        "its messages are larger than they may be"
        in read_bag(bag, anchors=ANCHORS).meta["remarks"][0]
    )


def test_packed_files_may_not_unfold_to_more_than_all_of_them_may(tmp_path):
    """Three files of 33 kB unpacked to 3 GiB. Here each unpacks to 32 MiB, and the limit is 16 MiB."""
    (tmp_path / "bag").mkdir()
    for number in range(3):
        packed = files.zstd.compress(bytes(32 << 20))
        (tmp_path / "bag" / f"bag_{number}.mcap.zstd").write_bytes(packed)
    with pytest.raises(
        InputError, match="more than [12][0-9]{7} bytes when its files are unpacked"
    ):
        read_bag(tmp_path / "bag")


def test_a_packed_message_is_unpacked_to_a_limited_size(tmp_path, monkeypatch):
    monkeypatch.setattr("uwb_tdoa_tools.bags.files.MESSAGE_BYTES", 1000)
    bomb = files.zstd.compress(bytes(1 << 24))
    bag = with_bad_messages(tmp_path / "bag", "mcap", ["/imu/data"], bad=lambda data: bomb)
    flight = read_bag(bag)
    assert len(flight.imu) == 199 and "1 messages left out" in flight.meta["remarks"][0]


def chunk(compression, packed, size, crc=0):
    """Return the record of a chunk."""
    head = struct.pack("<QQQII", 0, 1, size, crc, len(compression)) + compression
    return record(0x06, head + struct.pack("<Q", len(packed)) + packed)


BOMB = chunk(b"zstd", files.zstd.compress(bytes(8 << 20)), 8 << 20)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (chunk(b"", b"", 80 << 30), "claims 85899345920 bytes"),
        (chunk(b"", b"abc", 4), "cut"),
        (chunk(b"zstd", files.zstd.compress(bytes(1 << 28)), 1000), "the size or the checksum"),
        (chunk(b"lz4", lz4.frame.compress(bytes(1 << 26)), 1000), "the size or the checksum"),
        (chunk(b"zstd", b"nothing packed", 10), "cannot be unpacked"),
        (chunk(b"lz4", b"nothing packed", 10), "cannot be unpacked"),
        (chunk(b"br", b"x", 1), "compression b'br' is not known"),
        (chunk(b"", b"abc", 3, 7), "the size or the checksum of a chunk is wrong"),
        (record(0x06, b"abc"), "cannot be unpacked"),
        (struct.pack("<BQ", 5, 80 << 30), "a record is cut"),
        (record(0x05, b"abc"), "a record cannot be read"),
        (record(0x04, b"abc"), "a record cannot be read"),
        (bytes(9), "a record is cut"),
        (3 * BOMB, "a chunk claims 8388608 bytes, more than"),
    ],
)
def test_sizes_are_checked_before_they_are_believed(tmp_path, monkeypatch, content, said):
    monkeypatch.setattr(errors, "UNPACKED_FREE", 1 << 20)
    file = tmp_path / "forged.mcap"
    file.write_bytes(MCAP + content)
    with pytest.raises(InputError, match=f"no message that can be read.*{said}"):
        read_bag(file)


@pytest.mark.usefixtures("must_end")
def test_a_definition_that_takes_a_minute_to_read(tables):
    bag, run = tables
    fields = "".join(f"float64 x{k}\n" for k in range(20_000))
    run(f"UPDATE message_definitions SET encoded_message_definition = '{fields}'")
    assert len(read_bag(bag).tdoa) == 50  # it states no version that can be compared


def with_bad_messages(path, storage, of, many=1, bad=lambda data: data[:5]):
    """Write a bag of 100 TDOAs and messages of other topics. `many` messages of each topic in `of` are bad."""
    plain, seen = path.with_name("whole"), dict.fromkeys(of, 0)
    write_bag(small_flight(0.2), plain)
    with (
        open_bag(plain) as reader,
        Writer(path, version=9, storage_plugin=PLUGINS[storage]) as writer,
    ):
        to = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=typestore())
            for c in reader.connections
        }
        for connection, stamp, data in reader.messages():
            if seen.get(connection.topic, many) < many:
                seen[connection.topic] += 1
                data = bad(data)
            writer.write(to[connection.topic], stamp, data)
    return path


@BOTH
def test_a_message_that_cannot_be_read_is_counted_and_said(tmp_path, storage):
    bag = with_bad_messages(tmp_path / "bag", storage, ["/uwb/tdoa", "/imu/data"], many=2)
    flight = read_bag(bag)
    assert (len(flight.tdoa), len(flight.imu), len(flight.truth)) == (98, 198, 50)
    said = [
        "/uwb/tdoa: 2 messages left out, they cannot be read.",
        "/imu/data: 2 messages left out, they cannot be read.",
    ]
    assert flight.meta["remarks"] == said
    checked = read_recording(Reading(), bag)
    assert len(checked.tdoa) == 98 and list(checked.remarks) == said


def test_a_topic_of_nothing_but_bad_messages(tmp_path):
    bag = with_bad_messages(tmp_path / "bag", "mcap", ["/uwb/tdoa"], many=1000)
    with pytest.raises(
        InputError, match="has no message on /uwb/tdoa; 100 that are there cannot be read"
    ):
        read_bag(bag)


def test_a_message_that_is_too_long_to_be_one_of_ours(tmp_path, monkeypatch):
    bag = with_bad_messages(tmp_path / "bag", "mcap", ["/uwb/anchors"], bad=bytes)
    monkeypatch.setattr("uwb_tdoa_tools.bags.files.READ_BYTES", 200)
    with pytest.raises(InputError, match="has no message on /uwb/anchors"):
        read_bag(bag)


def test_recorded_odometry_says_what_is_missing(tmp_path):
    store, kind = typestore(), "nav_msgs/msg/Odometry"
    ((_, message),) = messages_of("odometry", kind, np.zeros(1), {}, "", store)
    data = store.serialize_cdr(message, kind)
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/odometry", kind, typestore=store)
        for stamp, content in enumerate((data, data[:30], data), start=1):
            writer.write(connection, stamp, content)
    odometry = read_odometry(tmp_path / "bag")
    assert len(odometry) == 2 and odometry.remarks == (
        "/odometry: 1 messages left out, they cannot be read.",
    )


def claiming(path, meta, name="flight"):
    """Write a bag with forged metadata."""
    write_bag(small_flight(0.1), path)
    about, file = json.dumps({"name": name, "meta": meta}), path / "metadata.yaml"
    lines = file.read_text().splitlines()
    first = next(k for k, one in enumerate(lines) if "uwb_tdoa_tools.flight:" in one)
    last = next(k for k in range(first + 1, len(lines)) if not lines[k].startswith("      "))
    lines[first:last] = [f"    uwb_tdoa_tools.flight: {json.dumps(about)}"]
    file.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    "meta",
    [
        {"antenna": [0.5, 0, 0]},
        {"remarks": 5},
        {"remarks": ["all is well"]},
        {"reordered": {"tdoa": "x"}},
        {"bag": "/etc/passwd"},
        {"protocol": 7, "parameters": {}},
        {"config": "x"},
    ],
)
def test_what_a_bag_says_of_itself_is_not_believed(tmp_path, meta):
    bag = claiming(tmp_path / "bag", meta)
    flight = Reading().one(bag)
    assert flight.meta == {"bag": str(bag)} and with_antenna(None, flight) is None


def test_what_a_bag_says_of_itself_is_printable(tmp_path):
    flight = read_bag(
        claiming(tmp_path / "bag", {"protocol": "tdoa2", "source": "\x1b[2Jx\n" + 10**5 * "y"})
    )
    assert flight.meta["protocol"] == "tdoa2" and flight.meta["source"].startswith(r"\x1b[2Jx\nyyy")
    assert len(flight.meta["source"]) == 1000


@BOTH
def test_the_place_of_the_antenna_is_written_where_nodes_look_for_it(tmp_path, storage):
    flight = small_flight(0.1)
    write_bag(
        replace(flight, meta={**flight.meta, "antenna": [0.5, 0.0, -0.1]}),
        tmp_path / "bag",
        storage,
    )
    back = read_bag(tmp_path / "bag")
    assert back.meta["antenna"] == [0.5, 0.0, -0.1]
    assert back.meta["remarks"] == [
        (
            "uwb/tdoa is taken from frame 'uwb_antenna', which /tf_static places at (0.500, "
            "0.000, -0.100) m in 'base_link'."
        )
    ]
    write_bag(back, tmp_path / "again", storage)
    assert read_bag(tmp_path / "again").meta["antenna"] == [0.5, 0.0, -0.1]


def test_the_antenna_of_ranges_alone_is_written_and_read(tmp_path):
    flight = small_flight(0.1)
    t, ids = flight.tdoa.t, flight.tdoa.a
    ranges = Ranges(t, ids, np.full(len(t), 2.0), np.zeros(len(t)))
    none = Tdoas(*np.empty((4, 0)))
    alone = replace(flight, tdoa=none, range=ranges, meta={"antenna": [0.1, -0.2, 0.3]})
    write_bag(alone, tmp_path / "bag")
    assert read_bag(tmp_path / "bag").meta["antenna"] == [0.1, -0.2, 0.3]


def shared_children(file, table, levels=10):
    """Forge a tree of an SQLite table whose pages share their children.

    Each of `levels` pages refers to the next page hundreds of times. Returns the size of the file,
    bytes.
    """
    connection = sqlite3.connect(file)
    roots = dict(connection.execute("SELECT name, rootpage FROM sqlite_master")) | {
        "sqlite_master": 1
    }
    (size,) = connection.execute("PRAGMA page_size").fetchone()
    connection.close()
    data, root = bytearray(file.read_bytes()), roots[table]
    pages, leaf = len(data) // size, bytearray(data[(root - 1) * size : root * size])
    # bytes of the file header, which precedes the header of the first page
    of_file = 100 if root == 1 else 0
    leaf[: 300 - of_file] = leaf[of_file:300]
    for level in range(levels):
        numbers = [root, *range(pages + 1, pages + levels + 1)]
        at, count = 0 if level else of_file, (size - of_file - 12) // 7
        page = bytearray(size)
        cells = b"".join(struct.pack(">I", numbers[level + 1]) + b"\x01" for _ in range(count))
        start = size - len(cells)
        page[at : at + 12] = struct.pack(">BHHHBI", 5, 0, count, start, 0, numbers[level + 1])
        page[at + 12 : at + 12 + 2 * count] = b"".join(
            struct.pack(">H", start + 5 * k) for k in range(count)
        )
        page[start:] = cells
        if level:
            data += page
        else:
            data[(root - 1) * size + at : root * size] = page[at:]
    data += leaf
    data[28:32] = struct.pack(">I", len(data) // size)
    file.write_bytes(data)
    return len(data)


@pytest.mark.parametrize("table", ["sqlite_master", "topics", "messages"])
@pytest.mark.usefixtures("must_end")
def test_pages_that_share_their_children_are_not_walked_for_ever(tables, table, monkeypatch):
    """A file of 53 kB hung the reader forever. Five levels hold 10^13 rows."""
    bag, _ = tables
    assert shared_children(data_file(bag), table) < 200_000
    monkeypatch.setattr(errors, "SECONDS", 0.5)
    if table == "messages":  # the rows before the circle are read
        assert "out of order" in read_bag(bag, anchors=ANCHORS).meta["remarks"][0]
    else:
        with pytest.raises(InputError, match="s of processor time|no message"):
            read_bag(bag)


@pytest.mark.slow
def test_an_interrupt_ends_a_walk_through_a_database(tables):
    bag, _ = tables
    shared_children(data_file(bag), "topics")
    code = (
        "import sys; from uwb_tdoa_bias.common import errors; errors.SECONDS = 1e9\n"
        "from uwb_tdoa_tools.bags import files; files.Budget.is_late = lambda self: "
        "print('walks', flush=True)\n"
        "from uwb_tdoa_bias.common.executable import executable\n"
        "sys.exit(executable('uwb_tdoa_tools.commands.check')())"
    )
    check = start("-c", code, bag)
    for line in check.stdout:
        if line == "walks\n":
            break
    check.send_signal(signal.SIGINT)
    _, err = check.communicate(timeout=100)
    assert check.returncode == 130 and "Traceback" not in err, err
