# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Attacks on the MAVLink link, without a node: strangers get nothing, and hold nothing up."""

import os
import re
import socket
import time
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("pymavlink")

from attacks import (  # noqa: E402
    LOOPBACK,
    Autopilot,
    empty,
    free_port,
    heartbeats,
    one_byte,
    parameters,
)

from uwb_tdoa_tools.autopilot import mavlink  # noqa: E402
from uwb_tdoa_tools.autopilot.estimate import FRD, NED, Estimate  # noqa: E402

BEAT = 0.5  # s of the clock of the test between two turns of `Rig.turns`


class Clock:
    """A clock that the test moves."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now


class Rig:
    """A link under test, on a clock that advances by BEAT with each turn."""

    def __init__(self, connection, clock, world=(FRD, 0.0), origin=()):
        self.link = mavlink.MavlinkLink(connection, 57600, 1, world, origin, time.time_ns)
        self._clock, self.port = clock, connection.rpartition(":")[2]
        self._estimate = Estimate(
            time.time_ns(), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), *np.zeros((2, 3)),
            *np.tile(0.01 * np.eye(6), (2, 1, 1)),
        )  # fmt: skip

    def turns(self, count=1, beating=(), step=BEAT, sends=True):
        """Run turns, each after a heartbeat of some autopilots, and send an estimate after each."""
        for _ in range(count):
            for autopilot in beating:
                autopilot.beat()
            time.sleep(0.002)  # loopback delivers
            self._clock.now += step
            self.link.turn()
            if sends:
                self.link.send(self._estimate, 0)
            for autopilot in beating:
                autopilot.receive()

    @property
    def trouble(self):
        return self.link.report()[0]


@pytest.fixture
def rig(monkeypatch):
    """Return a function that makes a Rig; its ports are closed in the end."""
    clock, made = Clock(), []
    monkeypatch.setattr(mavlink, "time", clock)

    def make(connection, *more):
        made.append(Rig(connection, clock, *more))
        return made[-1]

    yield make
    for each in made:
        each.link.close()


@pytest.fixture
def served(rig):
    """Return (Rig of udpin, its port, the autopilot that is its peer)."""
    port = free_port()
    made, autopilot = rig(f"udpin:{LOOPBACK}:{port}"), Autopilot.calling(port)
    made.turns(4, [autopilot])
    assert autopilot.odometry and not made.trouble
    yield made, port, autopilot
    autopilot.close()


def silent(sources):
    """Return whether none of the sockets was sent anything; close them."""
    for source in sources:
        source.setblocking(False)
    heard = []
    for source in sources:
        try:
            heard.append(source.recv(65536))
        except OSError:
            pass
        source.close()
    return not heard


@pytest.mark.parametrize(
    "attack",
    [
        lambda port: empty(port, 20),
        lambda port: one_byte(port, 100),
        lambda port: heartbeats(port, 20, system=7),
        lambda port: heartbeats(port, 20, system=1),  # forged, and too late
    ],
    ids=["empty", "one byte", "another system", "the same system"],
)
def test_a_stranger_gets_no_position(served, attack):
    made, port, autopilot = served
    sources, before = attack(port), len(autopilot.odometry)
    made.turns(10, [autopilot])
    assert silent(sources)
    assert len(autopilot.odometry) == before + 10 and not made.trouble


def test_strangers_who_come_first_get_no_position(rig):
    port = free_port()
    made = rig(f"udpin:{LOOPBACK}:{port}")
    sources = empty(port) + one_byte(port, 20) + heartbeats(port, system=7)
    made.turns(4)
    assert silent(sources)
    assert "but one of system 7: set system_id if that is the vehicle" in made.trouble


def test_the_autopilot_is_answered_at_once_below_a_flood(served):
    made, port, autopilot = served
    sources = one_byte(port, 3000)
    autopilot.ask()
    made.turns(1, [autopilot])
    assert autopilot.answers == 1
    assert silent(sources)


def test_another_source_is_the_peer_after_silence(served):
    made, port, autopilot = served
    other = Autopilot.calling(port)
    made.turns(8, [autopilot, other])
    assert not other.odometry
    made.turns(12, [other])  # the first is silent for 6 s
    assert other.odometry and not made.trouble
    count = len(autopilot.odometry)
    made.turns(4, [autopilot, other])
    assert len(autopilot.odometry) <= count + 8  # what was sent until it was silent for 3 s
    assert made.link.report()[1]["peer"] == "{}:{}".format(*other.end.getsockname())
    other.close()


def test_a_silent_place_is_called_anew(rig):
    """The first socket to it may have an address that the machine no longer has."""
    port = free_port()
    made = rig(f"udpout:{LOOPBACK}:{port}")
    with socket.socket(type=socket.SOCK_DGRAM) as end:
        end.bind((LOOPBACK, port))
        made.turns(2)
        first = end.recvfrom(4096)[1]
        made.turns(20)
        end.setblocking(False)
        *_, last = iter(lambda: _received(end), None)
        assert last != first
        end.connect(last)
        autopilot = Autopilot(end)
        made.turns(20, [autopilot])
        assert len(autopilot.odometry) == 20 and not made.trouble


def _received(end):
    try:
        return end.recvfrom(4096)[1]
    except OSError:
        return None


def test_a_silent_autopilot_is_reported_and_gets_nothing(served):
    made, _, autopilot = served
    made.turns(8)
    autopilot.receive()
    count = len(autopilot.odometry)
    made.turns(8)
    assert not autopilot.receive() and len(autopilot.odometry) == count
    assert "no heartbeat comes from the autopilot, system 1: check" in made.trouble


@pytest.mark.parametrize("connection", ["udpin", "udpout"])
def test_heartbeats_of_another_system_are_not_those_of_the_autopilot(rig, connection):
    port = free_port()
    end = socket.socket(type=socket.SOCK_DGRAM)
    if connection == "udpin":
        made = rig(f"udpin:{LOOPBACK}:{port}")
        end.connect((LOOPBACK, port))
    else:
        end.bind((LOOPBACK, port))
        made = rig(f"udpout:{LOOPBACK}:{port}")
        made.turns(1)
        end.connect(end.recvfrom(4096)[1])
    other = Autopilot(end, system=7)
    made.turns(8, [other])
    assert "but one of system 7" in made.trouble
    assert made.link.report()[1]["autopilot"] == "none"
    other.close()


@pytest.mark.parametrize("what", ["parameters", "heartbeats"])
def test_what_the_peer_sends_does_not_stay(served, what):
    made, _, autopilot = served
    send = autopilot.end.send

    beat = autopilot.dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    packed = b"".join(beat.pack(autopilot.mav) for _ in range(30))

    def attack():
        if what == "parameters":
            parameters(send, 150)
        else:
            for _ in range(30):
                send(packed)
        made.turns(3, [autopilot], step=0.01)
        autopilot.odometry.clear()

    attack()
    tracemalloc.start()
    before = tracemalloc.take_snapshot()
    for _ in range(10):
        attack()
    after = tracemalloc.take_snapshot()
    tracemalloc.stop()
    only = [tracemalloc.Filter(False, __file__)]
    changes = after.filter_traces(only).compare_to(before.filter_traces(only), "filename")
    assert sum(each.size_diff for each in changes) < 50_000  # it was 3 times as much


def test_a_peer_that_accepts_and_closes_is_called_again_at_times(rig, capfd):
    with socket.create_server((LOOPBACK, 0)) as listening:
        listening.setblocking(False)
        made, calls = rig(f"tcp:{LOOPBACK}:{listening.getsockname()[1]}"), 0
        for _ in range(40):
            made.turns(5, step=0.1)
            try:
                listening.accept()[0].close()
                calls += 1
            except OSError:
                pass
        assert 4 <= calls <= 11  # within 20 s
        assert re.search(
            r"system 1 \((the other side has closed it|Connection reset)", made.trouble
        )
    assert capfd.readouterr() == ("", "")


def test_a_peer_that_listens_later_gets_odometry(rig):
    port = free_port(socket.SOCK_STREAM)
    made = rig(f"tcp:{LOOPBACK}:{port}")
    made.turns(4)
    assert "refused" in made.trouble
    with socket.create_server((LOOPBACK, port)) as listening:
        listening.settimeout(10.0)
        made.turns(8)
        autopilot = Autopilot(listening.accept()[0])
    made.turns(4, [autopilot])
    assert autopilot.odometry and not made.trouble
    autopilot.close()


@pytest.mark.parametrize("count", [1, 3 * mavlink.__dict__.get("MOST_CALLERS", 8)])
def test_a_silent_caller_holds_no_slot(rig, count):
    port = free_port(socket.SOCK_STREAM)
    made = rig(f"tcpin:{LOOPBACK}:{port}")
    strangers = [socket.create_connection((LOOPBACK, port)) for _ in range(count)]
    made.turns(count)
    autopilot = Autopilot.calling(port, kind=socket.SOCK_STREAM)
    made.turns(6, [autopilot])
    assert autopilot.odometry and not made.trouble
    autopilot.close()
    made.turns(6)
    again = Autopilot.calling(port, kind=socket.SOCK_STREAM)
    made.turns(6, [again])
    assert again.odometry and not made.trouble
    again.close()
    for stranger in strangers:
        stranger.close()


def test_a_serial_port_carries_odometry_and_never_blocks(rig):
    pytest.importorskip("serial")
    ours, theirs = os.openpty()
    made = rig(os.ttyname(theirs))
    os.set_blocking(ours, False)

    class Line:
        def setblocking(self, _):
            pass

        def send(self, data):
            os.write(ours, data)

        def recv(self, size):
            return os.read(ours, size)

    autopilot = Autopilot(Line())
    made.turns(4, [autopilot])
    assert autopilot.odometry and not made.trouble
    made.turns(200)  # fills the line
    made.turns(1, [autopilot])
    made.turns(4, [autopilot])
    assert not made.trouble
    os.close(theirs)
    os.close(ours)
    made.turns(20)
    assert "no heartbeat comes" in made.trouble


PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT
ACTIVE, STANDBY = 4, 3  # MAV_STATE
LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12


@pytest.mark.parametrize(
    "kind, world, frame, nose",
    [
        (PX4, FRD, LOCAL_FRD, 0.0),
        (PX4, NED, LOCAL_NED, np.pi / 3),
        (ARDUPILOT, FRD, LOCAL_FRD, 0.0),
        (ARDUPILOT, NED, LOCAL_FRD, np.pi / 3),  # it takes no other name of a frame
    ],
)
def test_each_autopilot_gets_what_it_demands(rig, kind, world, frame, nose):
    """The rows of the table of docs/autopilot.md, one by one."""
    port = free_port()
    made = rig(f"udpin:{LOOPBACK}:{port}", (world, np.pi / 6), (47.4, 8.5, 408.0))
    end = socket.socket(type=socket.SOCK_DGRAM)
    end.connect((LOOPBACK, port))
    autopilot = Autopilot(end, kind=kind)
    made.turns(4, [autopilot])
    one = autopilot.odometry[-1]
    assert (one.frame_id, one.child_frame_id, one.estimator_type) == (frame, BODY_FRD, 3)
    assert abs(time.time() - 1e-6 * one.time_usec) < 60.0 and 1 <= one.quality <= 100
    w, x, y, z = one.q  # scalar first, rotation of the body to the world
    assert np.hypot(np.hypot(w, x), np.hypot(y, z)) == pytest.approx(1.0, abs=1e-6)
    assert 2.0 * np.arctan2(z, w) == pytest.approx(nose, abs=1e-6)  # clockwise from north
    for upper in (one.pose_covariance, one.velocity_covariance):
        assert len(upper) == 21 and np.isfinite(upper).all()
        assert min(upper[k] for k in (0, 6, 11, 15, 18, 20)) > 0.0  # variances
    assert autopilot.heard["HEARTBEAT"][-1].system_status == ACTIVE
    place = autopilot.heard["SET_GPS_GLOBAL_ORIGIN"][-1]
    assert (place.latitude, place.longitude) == (474000000, 85000000)
    assert (place.altitude, place.target_system) == (408000, 1)
    autopilot.mav.gps_global_origin_send(place.latitude, place.longitude, place.altitude)
    made.turns(2, [autopilot])
    count = len(autopilot.heard["SET_GPS_GLOBAL_ORIGIN"])
    reason = "nothing is sent to the autopilot: the yaw is not known yet, so fly a little"
    for _ in range(2):
        made.link.say(reason)
    made.turns(4, [autopilot], sends=False)
    texts = autopilot.heard["STATUSTEXT"]
    assert "".join(text.text for text in texts) == reason
    assert [text.chunk_seq for text in texts] == [0, 1] and len({text.id for text in texts}) == 1
    assert autopilot.heard["HEARTBEAT"][-1].system_status == STANDBY
    assert len(autopilot.heard["SET_GPS_GLOBAL_ORIGIN"]) == count
    autopilot.close()
