# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Forged bags that would hang the reader, exhaust memory or mislead; invalid messages."""

from contextlib import nullcontext
from dataclasses import replace
import json
import signal
import sqlite3
import struct
import subprocess
import sys

import numpy as np
import pytest
from recordings import small_flight
from rosbags.rosbag2 import StoragePlugin, Writer
from test_bag_damage import chunked, data_file, forget_sum
import yaml

from uwb_tdoa_bias.common import limits
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_tools.bags import integrity, mcap
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag
from uwb_tdoa_tools.bags.files import messages, open_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.estimate import with_antenna
from uwb_tdoa_tools.readers.inputs import Reading

BOTH = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"


@pytest.fixture
def tables(tmp_path):
    """Return an SQLite bag and a function that runs statements on its data file."""
    write_bag(small_flight(0.1), tmp_path / "bag", "sqlite3")
    forget_sum(tmp_path / "bag")

    def run(*statements):
        connection = sqlite3.connect(data_file(tmp_path / "bag"))
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return tmp_path / "bag", run


@pytest.mark.parametrize("salvage", [False, True])
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
def test_nothing_in_a_database_is_computed(tables, statements, salvage):
    bag, run = tables
    run(*statements)
    with pytest.raises(
        InputError, match="is no table and no index of columns|no message that can be read"
    ):
        read_bag(bag, salvage=salvage)


def test_a_row_that_fills_the_memory(tables, monkeypatch):
    bag, run = tables
    monkeypatch.setattr(integrity, "MESSAGE_BYTES", 1_000_000)
    run("UPDATE messages SET data = zeroblob(1000001) WHERE id = 20")
    with pytest.raises(InputError, match="1 rows of messages .* or are too long"):
        read_bag(bag)
    assert "1 messages cannot be read: left out" in read_bag(bag, salvage=True).meta["remarks"][0]


@pytest.fixture
def packed(tmp_path):
    """Return a function that writes a bag with given files, compressed as a whole.

    It takes {name: uncompressed size or content}.
    """
    write_bag(small_flight(0.1), tmp_path / "plain")
    forget_sum(tmp_path / "plain")

    def make(files):
        bag = tmp_path / "packed"
        bag.mkdir()
        for name, content in files.items():
            (bag / name).write_bytes(
                content if isinstance(content, bytes) else mcap.zstd.compress(bytes(content))
            )
        text = (
            (tmp_path / "plain" / "metadata.yaml")
            .read_text()
            .replace("plain.mcap", ", ".join(files))
        )
        listed = f"  relative_file_paths: [{', '.join(files)}]\n  other:"
        text = text.replace("  relative_file_paths:", listed).replace(
            "compression_mode: ''", "compression_mode: file"
        )
        (bag / "metadata.yaml").write_text(
            text.replace("compression_format: ''", "compression_format: zstd")
        )
        return bag

    return make


def test_several_files_may_not_unfold_to_more_than_all_of_them_may(packed, monkeypatch):
    """Three files of 33 kB unpacked to 3 GiB.

    Here each file unpacks to 32 MiB, and the limit is 16 MiB.
    """
    bag = packed({f"{k}.mcap.zstd": 32 << 20 for k in range(3)})
    assert sum(file.stat().st_size for file in bag.iterdir()) < 30_000
    with pytest.raises(
        InputError, match="more than [12][0-9]{7} bytes when its files are unpacked"
    ):
        read_bag(bag)


def test_a_file_is_unpacked_once(tmp_path):
    write_bag(small_flight(0.1), tmp_path / "bag")
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    (tmp_path / "bag" / "metadata.yaml").write_text(
        text.replace("  - bag.mcap", "  - bag.mcap\n  - ./bag.mcap")
    )
    with pytest.raises(InputError, match="is no file, or is there twice"):
        read_bag(tmp_path / "bag")


@pytest.mark.parametrize("files", ["x", "5", "null", "{}"])
def test_files_that_are_no_list(tmp_path, files):
    """rosbags clears the list when it closes the bag."""
    write_bag(small_flight(0.1), tmp_path / "bag")
    file = tmp_path / "bag" / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    content["rosbag2_bagfile_information"]["files"] = yaml.safe_load(files)
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match="metadata.yaml: files is"):
        read_bag(tmp_path / "bag")


@pytest.mark.usefixtures("must_end")
def test_a_definition_that_takes_a_minute_to_read(tables):
    bag, run = tables
    fields = "".join(f"float64 x{k}\n" for k in range(20_000))
    run(
        f"UPDATE message_definitions SET encoded_message_definition = '{fields}'",
        "UPDATE topics SET type_description_hash = ''",
    )
    with pytest.raises(
        InputError,
        match="the definition of uwb_tdoa_msgs/msg/Tdoa in the bag has more than 65536 bytes",
    ):
        read_bag(data_file(bag))


@pytest.mark.parametrize("salvage", [False, True])
def test_chunks_may_not_unfold_to_more_than_all_of_them_may(tmp_path, monkeypatch, salvage):
    chunk = chunked(b"zstd", mcap.zstd.compress(bytes(8 << 20)), 8 << 20)
    head, body, end = chunk[:29], chunk[29:-50], chunk[-50:]
    (tmp_path / "forged.mcap").write_bytes(head + 3 * body + end)
    unfolded = []
    original = mcap.chunk_data
    monkeypatch.setattr(
        mcap, "chunk_data", lambda *given: unfolded.append(original(*given)) or unfolded[-1]
    )
    with pytest.raises(
        InputError, match="a chunk claims 8388608 bytes, more than|no message that can be read"
    ):
        read_bag(tmp_path / "forged.mcap", salvage=salvage)
    assert sum(map(len, unfolded)) <= limits.most_unpacked(len(3 * body) + 200)


def test_an_index_may_not_show_a_message_again_and_again(tmp_path, monkeypatch):
    """The messages read must not be larger than the file."""
    write_bag(small_flight(0.1), tmp_path / "bag")
    with open_bag(tmp_path / "bag") as reader:
        found = [message for message in reader.messages() for _ in range(1 << 14)]
        monkeypatch.setattr(reader, "messages", lambda connections: iter(found))
        with pytest.raises(InputError, match="more than [0-9]+ bytes of messages"):
            list(messages("bag", reader, reader.connections))


def with_bad_messages(path, storage, of, count=100, many=1, cut=5):
    """Write a bag of `count` TDOAs and as many messages of other topics.

    `many` messages of each topic in `of` are truncated to `cut` bytes.
    """
    plain = path.with_name("whole")
    write_bag(small_flight(count / 500.0), plain)
    seen, writer = (
        dict.fromkeys(of, 0),
        Writer(
            path,
            version=9,
            storage_plugin={"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage],
        ),
    )
    with open_bag(plain) as reader, writer:
        to = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=typestore())
            for c in reader.connections
        }
        for connection, stamp, data in messages(plain, reader, reader.connections):
            if seen.get(connection.topic, many) < many:
                seen[connection.topic] += 1
                data = data[:cut]
            writer.write(to[connection.topic], stamp, data)
    return path


@BOTH
@pytest.mark.parametrize("salvage", [False, True])
def test_a_message_that_cannot_be_read_is_counted_and_said(tmp_path, storage, salvage):
    bag = with_bad_messages(tmp_path / "bag", storage, ["/uwb/tdoa", "/imu/data"], many=2)
    flight = read_bag(bag, salvage=salvage)
    assert (len(flight.tdoa), len(flight.imu), len(flight.truth)) == (98, 198, 50)
    said = [
        "/uwb/tdoa: 2 messages left out, they cannot be read.",
        "/imu/data: 2 messages left out, they cannot be read.",
    ]
    assert flight.meta["remarks"] == said
    checked = read_recording(Reading(salvage=salvage), bag)
    assert len(checked.tdoa) == 98 and list(checked.remarks) == said


def test_a_topic_of_nothing_but_bad_messages(tmp_path):
    bag = with_bad_messages(tmp_path / "bag", "mcap", ["/uwb/tdoa"], many=1000)
    with pytest.raises(
        InputError, match="has no message on /uwb/tdoa; 100 that are there cannot be read"
    ):
        read_bag(bag)


def test_a_message_that_is_too_long_to_be_one_of_ours(tmp_path, monkeypatch):
    bag = with_bad_messages(tmp_path / "bag", "mcap", ["/uwb/anchors"], cut=None)
    monkeypatch.setattr("uwb_tdoa_tools.bags.files.READ_BYTES", 200)
    with pytest.raises(InputError, match="has no message on /uwb/anchors"):
        read_bag(bag)


def test_recorded_odometry_says_what_is_missing(tmp_path):
    store, zeros = typestore(), np.zeros(36)
    types = store.types
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](0, 0, 0), types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    )
    twist = types["geometry_msgs/msg/Twist"](
        *(types["geometry_msgs/msg/Vector3"](0, 0, 0) for _ in range(2))
    )
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "map")
    with_covariance = (
        types["geometry_msgs/msg/PoseWithCovariance"](pose, zeros),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
    )
    data = store.serialize_cdr(
        types["nav_msgs/msg/Odometry"](header, "base_link", *with_covariance),
        "nav_msgs/msg/Odometry",
    )
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/odometry", "nav_msgs/msg/Odometry", typestore=store)
        for stamp, content in enumerate((data, data[:30], data), start=1):
            writer.write(connection, stamp, content)
    odometry = read_odometry(tmp_path / "bag")
    assert len(odometry) == 2 and odometry.remarks == (
        "/odometry: 1 messages left out, they cannot be read.",
    )


def test_a_damaged_chunk_is_left_out_and_what_follows_is_read(tmp_path):
    flight = small_flight(10.0)
    write_bag(flight, tmp_path / "bag")
    file = data_file(tmp_path / "bag")
    with open(file, "rb") as opened:
        chunks = [
            record
            for record in mcap.records(opened, 8, file.stat().st_size - 8)
            if record.kind == mcap.CHUNK
        ]
    content = bytearray(file.read_bytes())
    content[chunks[1].content + 1000] ^= 1
    file.write_bytes(content)
    assert len(chunks) > 2
    back = read_bag(tmp_path / "bag", salvage=True)
    assert back.meta["remarks"][0] == "bag.mcap: 1 chunks cannot be read: left out."
    assert back.imu.t[-1] == flight.imu.t[-1] and 0.3 < len(back.imu) / len(flight.imu) < 0.9


@pytest.mark.parametrize(
    "statement", ["timestamp = 'soon'", "data = 'text'", "topic_id = 77", "timestamp = -5"]
)
def test_rows_that_are_none_are_left_out(tables, statement):
    bag, run = tables
    run(f"UPDATE messages SET {statement} WHERE id = 20")
    flight = read_bag(bag, salvage=True)
    assert "1 messages cannot be read: left out" in flight.meta["remarks"][0]
    assert len(flight.tdoa) + len(flight.imu) + len(flight.truth) == 174


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


@pytest.mark.parametrize("salvage", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("table", ["sqlite_master", "topics", "messages"])
@pytest.mark.usefixtures("must_end")
def test_pages_that_share_their_children_are_not_walked_for_ever(
    tables, table, salvage, monkeypatch
):
    """A file of 53 kB hung the reader forever. Five levels hold 10^13 rows."""
    bag, _ = tables
    assert shared_children(data_file(bag), table) < 200_000
    monkeypatch.setattr(limits, "SECONDS", 0.5)
    with (
        nullcontext() if salvage and table == "messages" else pytest.raises(InputError)
    ):  # with --salvage, the first rows are read
        read_bag(bag, salvage=salvage)


@pytest.mark.slow
def test_an_interrupt_ends_a_walk_through_a_database(tables):
    bag, _ = tables
    shared_children(data_file(bag), "topics")
    code = (
        "import sys; from uwb_tdoa_bias.common import limits; limits.SECONDS = 1e9\n"
        "from uwb_tdoa_tools.bags import integrity; integrity.Budget.is_late = lambda self: "
        "print('walks', flush=True)\n"
        "from uwb_tdoa_bias.common.executable import executable\n"
        "sys.exit(executable('uwb_tdoa_tools.commands.check')())"
    )
    check = subprocess.Popen(
        [sys.executable, "-c", code, str(bag), "--salvage"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    for line in check.stdout:
        if line == "walks\n":
            break
    check.send_signal(signal.SIGINT)
    _, err = check.communicate(timeout=100)
    assert check.returncode == 130 and "Traceback" not in err, err
