# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ULog files of PX4: equal to another reader, and files that attack."""

import json
import random
import struct
import subprocess
import sys

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.commands.check import main as check
from uwb_tdoa_tools.readers.tables import ULogFile, Wanted

SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
TYPES = {"uint64_t": "Q", "float": "f", "int16_t": "h", "uint8_t": "B", "double": "d", "bool": "?"}
FORMATS = {
    "part": "int16_t a;uint8_t[2] _padding0;float[2] b;",
    "tag": "uint64_t timestamp;float x;uint8_t[4] _padding0;part[2] parts;bool good;uint8_t[3] _padding1;",
    "imu": "uint64_t timestamp;double gyro;",
}


def message(kind, content):
    return struct.pack("<HB", len(content), ord(kind)) + content


def ulog(*messages, offsets=(0, 0, 0)):
    flags = struct.pack("<8x8s3Q", bytes([any(offsets)]) + bytes(7), *offsets)
    return MAGIC + message("B", flags) + b"".join(messages)


MAGIC = b"ULog\x01\x12\x35\x01" + bytes(8)


def definitions():
    out = [message("F", f"{name}:{fields}".encode()) for name, fields in FORMATS.items()]
    subscribed = (("tag", 0), ("tag", 1), ("imu", 0))
    for number, (name, instance) in enumerate(subscribed):
        out.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
    return b"".join(out)


def data(seed, count):
    """Return data of all messages: random numbers."""
    draw, out = random.Random(seed), []
    for k in range(count):
        out.append(
            message("D", struct.pack("<HQf4x", k % 2, k, draw.random()) + b"".join(
                struct.pack("<hxxff", draw.randrange(-99, 99), draw.random(), draw.random())
                for _ in range(2)
            ) + bytes([k % 2]))
        )  # fmt: skip
        out.append(message("D", struct.pack("<HQd", 2, k, draw.random())))
        if k % 10 == 0:
            out.append(message("S", SYNC))
            out.append(message("O", struct.pack("<H", k)))
    return b"".join(out)


def read(path, **options):
    log = ULogFile([path], **options)
    wanted = [Wanted(table, "", tuple(log.fields(table))) for table in log.types]
    return {
        table: {name: np.array(block.columns[name]) for name in log.fields(table)}
        for table, block in zip(log.types, log.blocks(wanted))
    }


def test_another_reader_reads_the_same(tmp_path):
    core = pytest.importorskip("pyulog.core")
    path = tmp_path / "flight.ulg"
    begin = len(ulog(definitions(), data(1, 60)))
    # a crash has cut a message, and what was found later was appended
    first = ulog(definitions(), data(1, 60), offsets=(begin + 5, 0, 0))
    path.write_bytes(first + message("D", bytes(40))[:5] + data(2, 30))
    log, ours = core.ULog(str(path)), read(path)
    theirs = {f"{e.name}.{e.multi_id}" if e.multi_id else e.name: e.data for e in log.data_list}
    assert theirs.keys() == ours.keys() == {"tag", "tag.1", "imu"}
    for table, data_of in theirs.items():
        columns = {name: values for name, values in data_of.items() if "_padding" not in name}
        assert columns.keys() == ours[table].keys()
        for name, values in columns.items():
            np.testing.assert_array_equal(ours[table][name], values)
    (remark,) = ULogFile([path]).remarks
    assert remark == "the autopilot dropped messages 6 times, 150 ms in all."


def test_a_damage_costs_what_comes_before_the_next_mark(tmp_path):
    path = tmp_path / "flight.ulg"
    whole = ulog(definitions(), data(1, 60))
    at = whole.index(SYNC, len(whole) // 2) + len(SYNC) + 5  # the first number of a dropout
    path.write_bytes(whole[:at] + bytes(60) + whole[at + 60 :])
    with pytest.raises(InputError, match="this ULog is cut or damaged .no message begins at byte"):
        read(path)
    log = ULogFile([path], salvage=True)
    assert log.remarks[0] == "the log is damaged: read what fits."
    assert 48 <= log.counts["imu"] < 60


def nested(depth, size, leaf="float"):
    """Return a ULog of nested arrays."""
    formats = [
        message("F", f"f{k}:{f'f{k - 1}' if k else leaf}[{size}] a;".encode()) for k in range(depth)
    ]
    top = message("F", f"top:uint64_t timestamp;f{depth - 1} a;".encode())
    subscribed = message("A", struct.pack("<BH", 0, 0) + b"top")
    return ulog(*formats, top, subscribed, message("D", struct.pack("<HQ", 0, 1) + bytes(8)))


ATTACKS = {
    "nested arrays": nested(8, 60),
    "nested arrays of nothing": nested(8, 60, "none") + message("F", b"none:"),
    "one long array": nested(1, 99999, "uint8_t"),
    "a format in itself": ulog(
        message("F", b"top:uint64_t timestamp;top a;"), message("A", b"\0\0\0top")
    ),
    "long names": ulog(
        message("F", b"top:uint64_t timestamp;uint8_t[9999] " + b"a" * 60_000 + b";"),
        message("A", b"\0\0\0top"),
    ),
    "no timestamp": ulog(
        message("F", b"top:float a;"), message("A", b"\0\0\0top"), message("D", bytes(6))
    ),
    "data without a name": ulog(message("D", bytes(6))),
    "a number of digits": ulog(
        message("F", b"top:uint8_t[" + b"9" * 6000 + b"] a;"), message("A", b"\0\0\0top")
    ),
    "names twice": ulog(
        message("F", b"top:uint64_t timestamp;float a;float a;"), message("A", b"\0\0\0top")
    ),
    "appended data that begin anywhere": MAGIC
    + b"".join(
        message("B", struct.pack("<8x8s3Q", bytes([1]) + bytes(7), 16, 30, at))
        for at in range(0, 500, 7)
    ),
}
START = """
import resource, sys
from pathlib import Path
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.readers.tables import ULogFile
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
for path in sys.argv[2:]:
    try:
        ULogFile([Path(path)], salvage=sys.argv[1] == "salvage")
        print("read")
    except InputError:
        print("refused")
    except Exception as error:
        print(path, repr(error))
"""


@pytest.mark.parametrize("how", ["", "salvage"])
def test_an_attack_is_refused_or_read_in_little_memory(tmp_path, how):
    """The process of the reader has 1 GB of addresses, its libraries included."""
    paths = [tmp_path / name for name in ATTACKS]
    for path, content in zip(paths, ATTACKS.values()):
        path.write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-c", START, how, *map(str, paths)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    became = dict(zip(ATTACKS, done.stdout.splitlines(), strict=True))
    for attack, one in became.items():
        assert one == "refused" or (one == "read" and (how or "appended" in attack)), (attack, one)


def test_no_line_of_the_reader_breaks_json(tmp_path, capfd):
    """Libraries that print spoil the output of commands."""
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog(message("D", bytes(6)), message("\x01", b"")) + definitions())
    code = check([str(path), "--profile", "px4", "--json", "--salvage"])
    out = capfd.readouterr().out
    assert code and (not out or json.loads(out) is not None)
