# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Targets of the fuzzer: every function that reads a file from outside, called with bytes.

A target may return or raise InputError. If a checksum protects a format, there is a second target
behind the checksum (`*_sealed`). Otherwise changed bytes would never get past it.
"""

from functools import cache
import gzip
import io
import json
import os
from pathlib import Path
import re
import shutil
import struct
import tempfile
from unittest.mock import patch
import zipfile
import zlib

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Tdoas
from uwb_tdoa_bias.common.flyable import FlyableVolume
from uwb_tdoa_bias.common.safe_yaml import parse_yaml
from uwb_tdoa_bias.correction import trial
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf import launching
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import BiasMap
from uwb_tdoa_tools.bags import mcap
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.bags.messages import tdoa_messages
from uwb_tdoa_tools.evaluating import read_others
from uwb_tdoa_tools.planning.installation import antenna_from_yaml
from uwb_tdoa_tools.planning.layout import AnchorPlaces
from uwb_tdoa_tools.readers import (
    load_profile,
    read_by_profile,
    read_survey,
    read_usd_log,
    read_util_csv,
)
from uwb_tdoa_tools.readers.names import NamedAnchors
from uwb_tdoa_tools.readers.profile import Profile, parse_columns
from uwb_tdoa_tools.readers.suggest import suggest
from uwb_tdoa_tools.readers.tables import CsvTable, number
from uwb_tdoa_tools.simulation.rooms import Walls
from uwb_tdoa_tools.surveying.known import read_distances, read_marks

CORPUS = Path(__file__).parent / "corpus"
ANCHORS = Anchors(
    [0, 1, 5], [[0.1, 0.2, 0.3], [4.0, 0.0, 3.0], [4.0, 5.0, 0.2]], np.full((3, 4), np.nan)
)
TDOA = "uwb_tdoa_msgs/msg/Tdoa"
MESSAGES = {
    "/imu/data": "sensor_msgs/msg/Imu",
    "/ground_truth/pose": "geometry_msgs/msg/PoseStamped",
    "/uwb/anchors": "uwb_tdoa_msgs/msg/AnchorArray",
    "/odometry": "nav_msgs/msg/Odometry",
    "/height": "sensor_msgs/msg/Range",
    "/pressure": "sensor_msgs/msg/FluidPressure",
    "/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
FOLDER = Path(
    tempfile.mkdtemp(prefix="fuzz_", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
)


def clean_up():
    """Remove the scratch files of this process."""
    shutil.rmtree(FOLDER, ignore_errors=True)


def _file(data, name="input"):
    path = FOLDER / name
    path.write_bytes(data)
    return path


def yaml(data):
    parse_yaml(data, "input")


def effects(data):
    EffectSet.from_yaml(_file(data))


def config(data):
    FilterConfig.from_yaml(_file(data))


def antenna(data):
    antenna_from_yaml(_file(data)).gain(np.eye(3))


def places(data):
    AnchorPlaces.from_yaml(_file(data))


def walls(data):
    Walls.from_yaml(_file(data)).between(np.zeros((1, 3)), np.ones((1, 3)))


def survey(data):
    read_survey(_file(data))


def table(data):
    path = _file(data)
    for line, row in CsvTable(path, ("true_x", "x")):
        number(path, line, row, "x")


def log(data):
    read_usd_log(_file(data), ANCHORS)


def log_sealed(data):
    read_usd_log(_file(data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))), ANCHORS)


def log_salvaged(data):
    _finite(read_usd_log(_file(data), ANCHORS, salvage=True))


def csv(data):
    _finite(read_util_csv(_file(data), ANCHORS))


def csv_salvaged(data):
    _finite(read_util_csv(_file(data), ANCHORS, salvage=True))


def csv_gzip(data):
    """Compress the changed content again."""
    packed = data if data.startswith(b"\x1f\x8b") else gzip.compress(data, 1, mtime=0)
    _finite(read_util_csv(_file(packed), ANCHORS))


def bag_mcap(data):
    read_bag(_file(data, "input.mcap"), anchors=ANCHORS)


def bag_mcap_sealed(data):
    path = _file(data, "input.mcap")
    try:
        mcap.fill_checksums(path)
    except mcap.Damaged:
        return
    _finite(read_bag(path, anchors=ANCHORS))


def bag_mcap_salvaged(data):
    _finite(read_bag(_file(data, "input.mcap"), anchors=ANCHORS, salvage=True))


def bag_sqlite(data):
    _finite(read_bag(_file(data, "input.db3")))


def bag_sqlite_salvaged(data):
    _finite(read_bag(_file(data, "input.db3"), anchors=ANCHORS, salvage=True))


def bag_metadata(data):
    folder = FOLDER / "bag"
    folder.mkdir(exist_ok=True)
    if not (folder / "small.mcap").exists():
        shutil.copy(CORPUS / "bag_mcap" / "small", folder / "small.mcap")
    (folder / "metadata.yaml").write_bytes(data)
    _finite(read_bag(folder))


def bag_message(data):
    """The first byte selects the topic; the remaining bytes are its message."""
    topic, msgtype = list(MESSAGES.items())[data[0] % len(MESSAGES) if data else 0]
    path = _file(bag_of(topic, msgtype, data[1:]), "message.mcap")
    if topic == "/odometry":
        read_odometry(path)
    else:
        _finite(read_bag(path, anchors=None if topic == "/uwb/anchors" else ANCHORS))


def bag_packed(data):
    """A bag whose file is compressed as a whole.

    data : content of the file. If it is no MCAP, it is the compressed file itself.
    """
    folder = FOLDER / "packed"
    folder.mkdir(exist_ok=True)
    (folder / "small.mcap.zstd").write_bytes(
        mcap.zstd.compress(data) if data.startswith(mcap.MAGIC) else data
    )
    text = (CORPUS / "bag_metadata" / "0").read_text().replace("small.mcap", "small.mcap.zstd")
    text = text.replace("compression_mode: ''", "compression_mode: FILE").replace(
        "compression_format: ''", "compression_format: zstd"
    )
    (folder / "metadata.yaml").write_text(text)
    _finite(read_bag(folder))


def columns(data):
    asked = parse_columns(
        "time=t:ms,anchor_a=from,anchor_b=to,tdoa=d:mm,gyro_x=gx,gyro_y=gy,gyro_z=gz,accel_x=ax,accel_y=ay,accel_z=az"
    )
    _finite(read_by_profile([_file(data)], Profile.of_columns(asked), NamedAnchors(ANCHORS)))


def profile(data):
    """Used on a bag, too."""
    read = load_profile(_file(data, "profile.yaml"))
    read_by_profile([CORPUS / "bag_ros_1" / "plain"], read, NamedAnchors(ANCHORS))


def bag_ros_1(data):
    _finite(
        read_by_profile([_file(data, "input.bag")], load_profile("uwb_msgs"), NamedAnchors(ANCHORS))
    )


def suggestion(data):
    suggest([_file(data, "input.bag")])


def marks(data):
    read_marks(_file(data), [_flight()])


def distances(data):
    read_distances(_file(data), ANCHORS)


def tags(data):
    launching.tags(_file(data), {})


def peers(data):
    read_others(_file(data))


def flyable(data):
    FlyableVolume.load(_file(data))


def flyable_sealed(data):
    FlyableVolume.load(_repacked(data))


def bias_map(data):
    BiasMap.load(_file(data))


def bias_map_sealed(data):
    BiasMap.load(_repacked(data))


def model(data):
    with patch.object(trial, "tried_out", _judged_by_a_copy):
        Network(_file(data))


def _judged_by_a_copy(content):
    """As `trial.tried_out`, in a fork of this process: a new Python takes 0.3 s to start."""
    ours, theirs = os.pipe()
    if not (child := os.fork()):
        try:
            os.chdir(FOLDER)
            os.write(theirs, json.dumps(trial.judge(content)).encode())
        finally:
            os._exit(0)
    os.close(theirs)
    with open(ours, "rb") as answer:
        said = answer.read()
    os.waitpid(child, 0)
    alone, why = json.loads(said or '[false, "it was ended"]')
    if why:
        raise trial.Unplayable(why)
    return alone


def _finite(flight):
    """Raise AssertionError if a value of a Flight is not finite.

    (A height of inf or NaN means that nothing was in range.)
    """
    finite = {
        "tdoa": "tabd",
        "imu": ("t", "gyro", "accel"),
        "truth": "tp",
        "height": "t",
        "pressure": ("t", "pressure"),
        "velocity": "t",
    }
    for stream, names in finite.items():
        part = getattr(flight, stream)
        for name in names if part is not None else ():
            assert np.isfinite(getattr(part, name)).all(), (stream, name)
    if flight.velocity is not None:
        measured = np.isfinite(flight.velocity.std)
        assert (flight.velocity.std >= 0.0).all() and np.isfinite(flight.velocity.v[measured]).all()


def _repacked(data):
    """A .npz file with the members of the data, its checksums set right: members end where the next
    zip header is.
    """
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        at = data.find(b"PK\x03\x04")
        while 0 <= at and at + 30 <= len(data):
            length, extra = struct.unpack_from("<HH", data, at + 26)
            end = data.find(b"PK", at + 30 + length + extra)
            name = data[at + 30 : at + 30 + length].decode("latin-1")
            if re.fullmatch(r"[a-z]+\.npy", name) and name not in file.namelist():
                file.writestr(name, data[at + 30 + length + extra : end if end >= 0 else len(data)])
            at = data.find(b"PK\x03\x04", at + 4)
    return _file(out.getvalue())


def _flight():
    return Flight(
        "monday",
        ANCHORS,
        Tdoas(np.array([0.0, 60.0]), np.zeros(2, int), np.ones(2, int), np.ones(2)),
    )


@cache
def _definition(msgtype):
    return typestore().generate_msgdef(msgtype, ros_version=2)[0]


@cache
def _tdoa():
    """A message that is right."""
    ((_, message),) = tdoa_messages(
        Tdoas(np.ones(1), np.zeros(1, int), np.ones(1, int), np.ones(1)), typestore()
    )
    return bytes(typestore().serialize_cdr(message, TDOA))


def bag_of(topic, msgtype, data):
    """An MCAP file, without chunks and index, of one TDOA and one message with the data."""

    def text(content):
        return struct.pack("<I", len(content)) + content.encode()

    def record(kind, content):
        return struct.pack("<BQ", kind, len(content)) + content

    parts = [record(mcap.HEADER, text("ros2") + text(""))]
    for place, (name, kind, content) in enumerate(
        (("/uwb/tdoa", TDOA, _tdoa()), (topic, msgtype, data)), start=1
    ):
        schema = struct.pack("<H", place) + text(kind) + text("ros2msg") + text(_definition(kind))
        parts.append(record(mcap.SCHEMA, schema))
        parts.append(
            record(
                mcap.CHANNEL, struct.pack("<HH", place, place) + text(name) + text("cdr") + bytes(4)
            )
        )
        parts.append(record(mcap.MESSAGE, struct.pack("<HIQQ", place, 0, place, place) + content))
    parts += [record(mcap.DATA_END, bytes(4)), record(mcap.FOOTER, bytes(20))]
    return mcap.MAGIC + b"".join(parts) + mcap.MAGIC


TARGETS = {
    function.__name__: function
    for function in (
        yaml,
        effects,
        config,
        antenna,
        places,
        walls,
        survey,
        table,
        log,
        log_sealed,
        log_salvaged,
        csv,
        csv_salvaged,
        csv_gzip,
        bag_mcap,
        bag_mcap_sealed,
        bag_mcap_salvaged,
        bag_sqlite,
        bag_sqlite_salvaged,
        bag_metadata,
        bag_message,
        bag_packed,
        columns,
        profile,
        bag_ros_1,
        suggestion,
        marks,
        distances,
        tags,
        peers,
        flyable,
        flyable_sealed,
        bias_map,
        bias_map_sealed,
        model,
    )
}
SEEDS = {  # whose corpus a target starts from, if not its own
    "log_sealed": "log",
    "log_salvaged": "log",
    "csv_salvaged": "csv",
    "csv_gzip": "csv",
    "bag_mcap_sealed": "bag_mcap",
    "bag_mcap_salvaged": "bag_mcap",
    "bag_sqlite_salvaged": "bag_sqlite",
    "suggestion": "bag_ros_1",
}


def seeds(name):
    """Paths of the corpus of a target."""
    return sorted(path for path in (CORPUS / SEEDS.get(name, name)).iterdir() if path.is_file())


def run(name, data):
    """One execution. Anything but a return is a finding."""
    try:
        TARGETS[name](data)
    except InputError:
        pass
