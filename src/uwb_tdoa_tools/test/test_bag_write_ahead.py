# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""SQLite bags of a recorder that was killed.

The reader uses the -wal file, or refuses the bag.
"""

import shutil
import sqlite3

import pytest
from recordings import differences, small_flight

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import messages, open_bag
from uwb_tdoa_tools.readers import inputs

FLIGHT = small_flight(0.3)
BATCHES = 12  # transactions in the -wal file


@pytest.fixture(params=["file", "directory"])
def unclosed(request, tmp_path):
    """Return a bag of a killed recorder.

    The last two thirds of its messages are in the -wal file.
    """
    write_bag(FLIGHT, tmp_path / "written", "sqlite3")
    (written,) = (tmp_path / "written").glob("*.db3")
    connection = sqlite3.connect(written, isolation_level=None)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA wal_autocheckpoint=0")
    rows = connection.execute(
        "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
    ).fetchall()
    first = len(rows) // 3
    connection.execute("DELETE FROM messages WHERE id > ?", (rows[first - 1][0],))
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    size = (len(rows) - first) // BATCHES + 1
    for begin in range(first, len(rows), size):
        connection.execute("BEGIN")
        connection.executemany(
            "INSERT INTO messages(id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)",
            rows[begin : begin + size],
        )
        connection.execute("COMMIT")
    killed = tmp_path / "killed"
    killed.mkdir()
    for file in (tmp_path / "written").iterdir():
        if request.param == "directory" or file.suffix != ".yaml":
            shutil.copy(file, killed)
            (killed / file.name).chmod(0o444)
    if request.param == "directory":  # without our checksum of the file
        text = (killed / "metadata.yaml").read_text()
        (killed / "metadata.yaml").chmod(0o644)
        (killed / "metadata.yaml").write_text(
            "\n".join(line for line in text.splitlines() if "crc32" not in line)
        )
    connection.close()
    return killed if request.param == "directory" else killed / written.name


def log_of(bag):
    (log,) = (bag if bag.is_dir() else bag.parent).glob("*-wal")
    log.chmod(0o644)
    return log


def test_all_messages_are_read_and_nothing_is_changed(unclosed):
    folder = unclosed if unclosed.is_dir() else unclosed.parent
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    flight = read_bag(unclosed)
    assert differences(FLIGHT, flight) == []
    assert "did not close" in flight.meta["remarks"][0]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_without_the_log_of_its_file_less_is_there(unclosed):
    if unclosed.is_dir():
        return
    log_of(unclosed).unlink()
    assert len(read_bag(unclosed).tdoa) < 0.6 * len(FLIGHT.tdoa)


@pytest.mark.parametrize("byte", [17, -1])  # of the header, or in the middle
def test_a_damaged_log_is_refused_and_salvaged_up_to_there(unclosed, byte):
    log = log_of(unclosed)
    content = bytearray(log.read_bytes())
    content[byte if byte > 0 else len(content) // 2] ^= 0xFF
    log.write_bytes(content)
    with pytest.raises(InputError, match=r"\d+ of \d+ frames are damaged.*--salvage"):
        read_bag(unclosed)
    flight = read_bag(unclosed, salvage=True)
    assert 0.2 * len(FLIGHT.tdoa) < len(flight.tdoa) < 0.9 * len(FLIGHT.tdoa)
    assert "frames are damaged; what they held is missing" in " ".join(flight.meta["remarks"])


def test_a_transaction_that_was_not_finished_costs_that_transaction(unclosed):
    if unclosed.is_dir():
        return  # metadata.yaml holds the number of messages
    log = log_of(unclosed)
    log.write_bytes(log.read_bytes()[:-100])
    assert 0.8 * len(FLIGHT.tdoa) < len(read_bag(unclosed).tdoa) < len(FLIGHT.tdoa)


def test_an_unfinished_transaction_is_undone(tmp_path):
    write_bag(FLIGHT, tmp_path / "bag", "sqlite3")
    (file,) = (tmp_path / "bag").glob("*.db3")
    connection = sqlite3.connect(file, isolation_level=None)
    connection.execute("PRAGMA journal_mode=DELETE")
    # pages; a small cache writes changes to the file at once
    connection.execute("PRAGMA cache_size=2")
    connection.execute("BEGIN")
    connection.execute("UPDATE messages SET timestamp = 0, data = zeroblob(length(data))")
    (tmp_path / "killed").mkdir()
    for name in (file.name, f"{file.name}-journal"):
        shutil.copyfile(file.with_name(name), tmp_path / "killed" / name)
    connection.execute("ROLLBACK")
    connection.close()
    killed = tmp_path / "killed" / file.name
    assert killed.read_bytes() != file.read_bytes()
    assert differences(FLIGHT, read_bag(killed)) == []


def test_what_sqlite_leaves_beside_a_file_is_no_recording(unclosed):
    folder = unclosed if unclosed.is_dir() else unclosed.parent
    assert [path for path, _ in inputs.find_flights([folder])] == [unclosed]


def test_messages_are_as_many_as_sqlite_counts(unclosed, tmp_path):
    (file,) = [unclosed] if unclosed.is_file() else unclosed.glob("*.db3")
    for path in file.parent.glob("*.db3*"):
        shutil.copyfile(path, tmp_path / path.name)
    connection = sqlite3.connect(tmp_path / file.name)
    (count,) = connection.execute("SELECT count(*) FROM messages").fetchone()
    connection.close()
    with open_bag(unclosed) as reader:
        assert sum(1 for _ in messages(unclosed, reader, reader.connections)) == count
