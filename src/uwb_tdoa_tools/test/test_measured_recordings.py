# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every measured file is read completely.

A second, simple parser counts the events.
"""

from collections import Counter
import gzip
from pathlib import Path
import struct

import numpy as np
import pytest

from uwb_tdoa_tools.readers import read_flight

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
LOGS = sorted(path for path in (DATA / "flights").rglob("*") if path.is_file())
TABLES = sorted((DATA / "util").glob("*.csv.gz"))


def relative(path):
    return str(path.relative_to(DATA))


def count_events(content):
    """Return {event name: number of events} of a version 2 log."""
    at = 5

    def string():
        nonlocal at
        start, at = at, content.index(0, at) + 1
        return content[start : at - 1].decode()

    def number():
        nonlocal at
        at += 2
        return struct.unpack_from("<H", content, at - 2)[0]

    sizes, names = {}, {}
    for _ in range(struct.unpack_from("<H", content, 3)[0]):
        event = number()
        names[event] = string()
        variables = [string() for _ in range(number())]
        sizes[event] = 10 + struct.calcsize("<" + "".join(variable[-2] for variable in variables))
    counts = Counter()
    end, unpack = len(content) - 4, struct.Struct("<H").unpack_from
    while at < end:
        (event,) = unpack(content, at)
        counts[event] += 1
        at += sizes[event]
    assert at == end
    return Counter({names[event]: count for event, count in counts.items()})


@pytest.mark.parametrize("path", LOGS, ids=relative)
def test_log(path):
    day = path.relative_to(DATA / "flights").parts[0]
    flight = read_flight(path, DATA / "surveys" / f"anchor_{day}.txt")
    counts = count_events(path.read_bytes())
    assert len(flight.tdoa) == counts.pop("estTDOA") > 5000
    assert len(flight.imu) == counts.pop("estGyroscope") == counts.pop("estAcceleration") > 30_000
    assert len(flight.truth) == counts.pop("estPose") > 8000
    assert len(flight.height or ()) == counts.pop("estTOF", 0)
    # the log repeats each reading up to a thousand times per second
    readings = len(flight.pressure or ())
    assert (readings > 500) == (counts.pop("estBarometer", 0) > 0)
    pixel_counts, velocities = (
        counts.pop("estFlow", 0),
        0 if flight.velocity is None else len(flight.velocity.t),
    )
    # about three readings for each velocity
    assert 0.2 * pixel_counts <= velocities <= 0.4 * pixel_counts
    assert {name: len(columns["t"]) for name, columns in flight.extra.items()} == dict(counts)
    assert "reordered" not in flight.meta and "imu_accel_interpolated" not in flight.meta
    assert set(flight.tdoa.a) == set(flight.tdoa.b) == set(range(8)) == set(flight.anchors.ids)
    assert (
        9.5 < np.linalg.norm(np.median(flight.imu.accel, axis=0)) < 10.2
    )  # it hovers most of the time
    np.testing.assert_allclose(np.linalg.norm(flight.truth.q, axis=1), 1.0, atol=1e-3)


@pytest.mark.parametrize("path", TABLES, ids=relative)
def test_table(path):
    constellation = path.name.split("-")[0]
    flight = read_flight(path, DATA / "surveys" / f"anchor_{constellation}.csv")
    header, *lines = gzip.decompress(path.read_bytes()).decode().splitlines()
    assert header == "t_tdoa,idA,idB,tdoa_meas,t_pose,pose_x,pose_y,pose_z"
    with_tdoa = [line for line in lines if not line.startswith(",")]
    assert len(flight.tdoa) == len(with_tdoa) > 30_000
    assert len(flight.truth) == sum(not line.endswith(",,,,") for line in lines) > 20_000
    assert flight.imu is None and np.isnan(flight.truth.q).all()
    last = [float(cell) for cell in with_tdoa[-1].split(",")[:4]]
    assert [flight.tdoa.t[-1], flight.tdoa.a[-1], flight.tdoa.b[-1], flight.tdoa.d[-1]] == last
    assert flight.meta["protocol"] == path.name.removesuffix(".csv.gz").split("-")[2]


def test_none_is_missing(shared_data):
    assert len(LOGS) == 22
    assert len(TABLES) >= 15
    flights = [read_flight(path, shared_data / "surveys" / "anchor_0425.txt") for path in LOGS]
    assert len({flight.name for flight in flights}) == 22
    peers = {
        line.split(",")[0] for line in (shared_data / "peers.csv").read_text().splitlines()[1:]
    }
    assert peers <= {flight.name for flight in flights}
    folders = {"TDOA2": "tdoa2", "TDOA3": "tdoa3"}
    told = [
        (log.meta["protocol"], folders.get(path.parent.name)) for log, path in zip(flights, LOGS)
    ]
    told = [pair for pair in told if pair[1]]
    assert len(told) > 5 and all(found == folder for found, folder in told)
