# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Crazyflie over cflib: log blocks become topics, and positions are sent to it.

The vehicle is a process of the test. It speaks CRTP over UDP on loopback, like the firmware, and
logs the content of a recording.
"""

import socket
import struct
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")

from autopilots import at_rest, bench  # noqa: E402
from cflib_objects import PARAMETERS, Crazyflie, cflib  # noqa: E402, F401
from sensor_msgs.msg import FluidPressure, Imu, Range  # noqa: E402

from uwb_tdoa_bias.ros.topics import OUTPUT_QOS  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus, Tdoa  # noqa: E402
from uwb_tdoa_tools.autopilot import crazyflie  # noqa: E402
from uwb_tdoa_tools.autopilot.crazyflie import ATTITUDE_STD, POSITION_STD, CrazyflieLink  # noqa: E402
from uwb_tdoa_tools.autopilot.estimate import Estimate  # noqa: E402
from uwb_tdoa_tools.crazyflie import BLOCKS, PERIOD, WRAP  # noqa: E402
from uwb_tdoa_tools.readers import read_flight  # noqa: E402
from uwb_tdoa_tools.readers.streams import GRAVITY  # noqa: E402

RUNNING = EstimatorStatus.STATUS_RUNNING
KINDS = {"FP16": (8, "e"), "float": (7, "f"), "uint16_t": (2, "H")}  # codes of log variables
STORED = {"FP16": "float"}  # how the firmware stores variables that it sends as half floats
SECONDS = 3.0


class Recording:
    """Values of log variables over the time of a recording. seconds : its length."""

    def __init__(self, t, columns):
        """columns : {variable: values (n,)}; each value holds from its stamp t (n,), s, on."""
        self._t, self._columns, self.seconds = t, columns, t[-1] - t[0]

    def __call__(self, variable, t):
        k = np.searchsorted(self._t, self._t[0] + t, side="right") - 1
        return float(self._columns[variable][max(k, 0)])

    def values(self, variable):
        return self._columns[variable]


def random_recording():
    rng, n = np.random.default_rng(2), 800
    t = np.arange(n) * PERIOD / 2.0
    columns = {name: np.repeat(rng.normal(0.0, 2.0, n // 4), 4) for name in BLOCKS["tdoa"][0]}
    columns |= {name: rng.normal(0.0, 1.0, n) for name in BLOCKS["imu"][0]}
    columns["range.zrange"] = np.repeat(rng.integers(100, 3000, n // 5), 5)
    columns["baro.pressure"] = np.repeat(950.0 + rng.normal(0.0, 0.1, n // 5), 5)
    return Recording(t, columns)


def measured_recording(folder):
    """Return a Recording of 10 s of a measured log. Values before the first sample are 0."""
    flight = read_flight(
        folder / "flights/0425/TDOA2/0425-traj1", folder / "surveys/anchor_0425.txt"
    )
    t = np.arange(flight.imu.t[0] + 20.0, flight.imu.t[0] + 30.0, 1e-3)

    def held(stamps, values):
        k = np.searchsorted(stamps, t, side="right") - 1
        return np.where(k < 0, 0.0, values[np.maximum(k, 0)])

    columns, tdoa = {}, flight.tdoa
    for name in BLOCKS["tdoa"][0]:
        mine = (tdoa.a == int(name[7])) & (tdoa.b == int(name[9]))
        columns[name] = held(tdoa.t[mine], tdoa.d[mine])
    for axis, letter in enumerate("xyz"):
        columns[f"gyro.{letter}"] = held(flight.imu.t, np.rad2deg(flight.imu.gyro[:, axis]))
        columns[f"acc.{letter}"] = held(flight.imu.t, flight.imu.accel[:, axis] / GRAVITY)
    height, pressure = flight.height, flight.pressure
    columns["range.zrange"] = held(height.t, np.minimum(1e3 * height.range, 32767.0)).astype(int)
    columns["baro.pressure"] = held(pressure.t, 0.01 * pressure.pressure)
    return Recording(t, columns)


class Vehicle:
    """The part of the firmware that cflib uses.

    go : Event that starts the time of the log
    came : (port, channel, data) of packets that need no answer
    logged : {variable: [(s since 1970, value)]} as sent
    """

    def __init__(self, recording, booted):
        """booted : clock of the vehicle at the start, s."""
        self.recording, self.came, self.parameters = recording, [], dict(PARAMETERS)
        self.go, self.logged, self.over = threading.Event(), {}, False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.001)
        self.uri = f"udp://127.0.0.1:{self._socket.getsockname()[1]}"
        self._variables = {
            name: STORED.get(kind, kind)
            for some, _ in BLOCKS.values()
            for name, kind in some.items()
        }
        self._names, self._blocks, self._started = list(self._variables), {}, {}
        self._booted, self._client = booted, None
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self):
        self._ends.set()
        self._thread.join()
        self._socket.close()

    def _run(self):
        while not self._ends.is_set():
            try:
                data, self._client = self._socket.recvfrom(64)
                self._take(data[0] >> 4, data[0] & 3, data[1:])
            except TimeoutError:
                pass
            self._log()

    def _answer(self, port, channel, data):
        self._socket.sendto(bytes([port << 4 | 0x0C | channel]) + data, self._client)

    def _take(self, port, channel, data):
        if (port, channel) == (15, 1):
            self._answer(port, channel, b"Bitcraze Crazyflie")
        elif (port, channel) == (15, 0):  # the ping
            self._answer(port, channel, data)
        elif (port, channel) == (13, 1):
            self._answer(port, channel, bytes([0, 7]))  # protocol version
        elif (port, channel) == (4, 0):
            self._answer(port, channel, bytes([1, 0]))  # no memories
        elif channel == 0 and port in (2, 5):
            self._answer(port, channel, self._contents(port, data))
        elif port == 2:
            name = list(self.parameters)[struct.unpack("<H", data[:2])[0]]
            if channel == 2:
                (self.parameters[name],) = struct.unpack("<f", data[2:])
                self.came.append((port, channel, data))
            value = struct.pack("<f", self.parameters[name])
            self._answer(port, channel, data[:2] + (b"\0" if channel == 1 else b"") + value)
        elif (port, channel) == (5, 1):
            self._command(data)
        else:
            self.came.append((port, channel, data))

    def _contents(self, port, data):
        """Answer a request for a table of contents."""
        names = list(self.parameters) if port == 2 else self._names
        if data[0] == 3:
            return struct.pack("<BHI", 3, len(names), port)
        name = names[struct.unpack("<H", data[1:3])[0]]
        kind = 6 if port == 2 else KINDS[self._variables[name]][0]
        return data[:3] + bytes([kind]) + name.replace(".", "\0").encode() + b"\0"

    def _command(self, data):
        """Create or start a log block."""
        command, number = data[0], data[1] if len(data) > 1 else 0
        if command == 6:
            entries = [data[k : k + 3] for k in range(2, len(data), 3)]
            codes = {code: letter for code, letter in KINDS.values()}
            self._blocks[number] = [
                (self._names[struct.unpack("<H", entry[1:])[0]], codes[entry[0] & 15])
                for entry in entries
            ]
        elif command == 3:
            self._started[number] = (data[2] * 0.01, 0.0)
        self._answer(5, 1, bytes([command, number, 0]))

    def _log(self):
        now = time.time()
        if not self.go.is_set():
            self._began = now
            return
        t = now - self._began
        self.over = t > SECONDS
        for number, (period, due) in list(self._started.items()):
            if t < due or self.over:
                continue
            values = b""
            for name, code in self._blocks[number]:
                packed = struct.pack(
                    "<" + code,
                    self.recording(name, t) if code != "H" else int(self.recording(name, t)),
                )
                values += packed
                self.logged.setdefault(name, []).append((now, struct.unpack("<" + code, packed)[0]))
            assert len(values) <= 26  # bytes, the largest size of a packet
            stamp = struct.pack("<I", round(1e3 * (self._booted + t)) % 2**24)[:3]
            self._answer(5, 2, bytes([number]) + stamp + values)
            self._started[number] = (period, max(due + period, t))

    def changes(self, name):
        """Return [(t, value)] where a logged value changes. 0 means no value."""
        found, before = [], 0.0
        for t, value in self.logged[name]:
            if value != before:
                found.append((t, value))
            before = value
        return found


@pytest.fixture(params=["random", "measured"])
def recording(request):
    if request.param == "random":
        return random_recording()
    return measured_recording(request.getfixturevalue("shared_data"))


def test_a_crazyflie_logs_to_topics_and_gets_poses(recording):
    """The clock of the vehicle wraps during the test."""
    pytest.importorskip("cflib")
    vehicle = Vehicle(recording, WRAP - 0.5 * SECONDS)
    got = {name: [] for name in BLOCKS}
    try:
        with bench(lambda: None) as rig:
            for name, topic, kind in (
                ("tdoa", "uwb/tdoa", Tdoa),
                ("imu", "imu/data", Imu),
                ("height", "height", Range),
                ("pressure", "pressure", FluidPressure),
            ):
                rig.node.create_subscription(kind, topic, got[name].append, OUTPUT_QOS)
            log = "log:=[tdoa, imu, height, pressure]"
            rig.start("protocol:=crazyflie", f"connection:={vehicle.uri}", log)
            rig.tell(RUNNING)

            rig.wait(
                lambda: (
                    rig.values.get("autopilot") == "Crazyflie"
                    and all(
                        rig.values[f"subscribers of {topic}"] == "1"
                        for topic in ("uwb/tdoa", "imu/data", "height", "pressure")
                    )
                ),
                "link",
            )
            vehicle.go.set()

            def is_over():
                rig.publish(at_rest(1))
                return vehicle.over

            rig.wait(is_over, "the end of the log")
            expected = _expected(vehicle)
            rig.wait(
                lambda: all(len(got[name]) >= len(some) for name, some in expected.items()),
                "all samples",
            )
            assert rig.end() == 0
        assert not [line for line in rig.lines if "Traceback" in line]
    finally:
        vehicle.close()
    _check_samples(got, expected)
    _check_poses(vehicle)


def _expected(vehicle):
    """Return {stream: sorted [(value, s since 1970)]}, as sent by the vehicle, in SI units.

    The value of a TDOA is (a, b, difference). The value of an inertial sample is its force along z.
    """
    out = {"tdoa": [], "imu": [(GRAVITY * z, t) for t, z in vehicle.logged["acc.z"]]}
    for name in BLOCKS["tdoa"][0]:
        pair = int(name[7]), int(name[9])
        out["tdoa"] += [((*pair, d), t - 0.5 * PERIOD) for t, d in vehicle.changes(name)]
    heights = [
        (1e-3 * mm if mm < 32000 else np.inf, t) for t, mm in vehicle.changes("range.zrange")
    ]
    out["height"] = [(height, t - PERIOD) for height, t in heights]
    out["pressure"] = [(100.0 * p, t - PERIOD) for t, p in vehicle.changes("baro.pressure")]
    return out


def _check_samples(got, expected):
    """Check that each sample arrives once, with its value and stamp.

    The smallest delay of the link remains in the stamps.
    """
    values = {
        "tdoa": lambda m: (m.anchor_a, m.anchor_b, m.distance_difference),
        "imu": lambda m: m.linear_acceleration.z,
        "height": lambda m: m.range,
        "pressure": lambda m: m.fluid_pressure,
    }
    assert {(a, b) for (a, b, _), _ in expected["tdoa"]} == {
        (int(name[7]), int(name[9])) for name in BLOCKS["tdoa"][0]
    }
    for name, messages in got.items():
        rows = sorted(
            (m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec, values[name](m)) for m in messages
        )
        wanted = sorted((t, value) for value, t in expected[name])
        assert len(rows) == len(wanted) > 20, name
        delays = np.array([t - at for (t, _), (at, _) in zip(rows, wanted)])
        # the wrap neither loses nor adds a second
        assert delays.min() > -0.01 and delays.max() < 0.5, name
        got_values = sorted(value for _, value in rows)
        for value, other in zip(got_values, sorted(value for _, value in wanted)):
            assert value == pytest.approx(other, rel=1e-6), name


def _check_poses(vehicle):
    """Check that the vehicle got the standard deviations before the first pose, and no commands."""
    ports = [(port, channel) for port, channel, _ in vehicle.came]
    # port of the commander; close_link() sends a thrust of 0 on it
    assert 3 not in {port for port, _ in ports}
    first = ports.index((6, 1))
    assert ports[:first].count((2, 2)) >= 2
    (message,) = at_rest(1)
    covariance = np.reshape(message.pose.covariance, (6, 6)).diagonal()
    for name, part in ((POSITION_STD, covariance[:3]), (ATTITUDE_STD, covariance[3:])):
        assert vehicle.parameters[name] == pytest.approx(np.sqrt(part.max()), rel=1e-6)
    poses = [data for port, channel, data in vehicle.came if (port, channel) == (6, 1)]
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    wanted = [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
    assert len(poses) > 30 * SECONDS
    for data in poses:
        kind, *values = struct.unpack("<B7f", data)
        assert kind == 8 and values == pytest.approx(wanted, abs=1e-6)


# --- without cflib: what the link does with its objects ---


def link(content="pose", streams=("imu",), taken=None):
    taken = [] if taken is None else taken
    samples = SimpleNamespace(take=lambda *what: taken.append(what), restart=taken.clear)
    address = "radio://0/80/2M/E7E7E7E7E7"
    made = CrazyflieLink(address, content, streams, samples, time.time_ns)
    made.turn()
    return made, Crazyflie.made


def an_estimate(std):
    covariance = std**2 * np.eye(6)
    q = np.array([0.0, 0.0, 0.0, 1.0])
    return Estimate(0, np.arange(3.0), q, np.zeros(3), np.zeros(3), covariance, covariance)


def test_log_blocks_fit_their_packets(cflib):  # noqa: F811
    taken = []
    made, vehicle = link(streams=BLOCKS, taken=taken)
    vehicle.fully_connected.call("")
    made.turn()
    sizes = {"FP16": 2, "float": 4, "uint16_t": 2}
    for config in vehicle.configs:
        assert config.started and sum(sizes[kind] for kind in config.variables.values()) <= 26
        assert config.period % 10 == 0
    imu = next(config for config in vehicle.configs if config.name == "imu")
    imu.data_received_cb.call(1000, dict.fromkeys(imu.variables, 1.0), imu)
    made.turn()
    _, timestamp, values, arrival = taken[-1]
    assert (timestamp, values) == (1000, [1.0] * 6) and abs(arrival - time.time()) < 60.0


def test_it_sends_nothing_that_the_crazyflie_would_believe_too_much(cflib):  # noqa: F811
    made, vehicle = link()
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == []  # no link yet
    vehicle.fully_connected.call("")
    made.turn()
    vehicle.param.set_value = lambda name, value: None  # the vehicle ignores the parameter
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == []
    vehicle.values |= {POSITION_STD: 0.2, ATTITUDE_STD: 0.2}
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == [(0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0)]
    made.send(an_estimate(0.4), 0)
    assert len(vehicle.poses) == 1
    made.send(an_estimate(0.02), 0)  # smaller errors than announced are safe
    assert len(vehicle.poses) == 2


def test_a_position_needs_no_attitude(cflib):  # noqa: F811
    made, vehicle = link(content="position")
    vehicle.fully_connected.call("")
    made.turn()
    made.send(an_estimate(0.2), 0)
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == [(0.0, 1.0, 2.0)]
    assert vehicle.values == {POSITION_STD: 0.2, ATTITUDE_STD: 0.0045}


def test_a_link_that_is_lost_is_opened_again(cflib, monkeypatch):  # noqa: F811
    made, vehicle = link()
    assert "not known yet" in made.report()[0]
    vehicle.connection_failed.call("", "no radio\nTraceback ...")
    made.turn()
    assert "no link to the Crazyflie (no radio): check" in made.report()[0]
    assert vehicle.opened == 1
    monkeypatch.setattr(crazyflie, "AGAIN", 0.0)
    vehicle.connection_failed.call("", "no radio")
    made.turn()
    assert vehicle.opened == 2
    vehicle.fully_connected.call("")
    made.turn()
    assert made.report()[0] == ""
    monkeypatch.setattr(crazyflie, "CONNECTING", -1.0)
    vehicle.connection_lost.call("", "too many packets lost")
    made.turn()
    assert "too many packets lost" in made.report()[0] and vehicle.opened == 3
    made.turn()
    assert "it does not answer" in made.report()[0]


def test_log_variables_that_it_does_not_have_are_named(cflib):  # noqa: F811
    made, vehicle = link(streams=("height", "imu"))

    def add(config):
        if config.name == "height":
            raise KeyError("Variable range.zrange not in TOC")
        vehicle.configs.append(config)

    vehicle.log.add_config = add
    vehicle.fully_connected.call("")
    made.turn()
    assert "no log variables for height" in made.report()[0]
    assert [config.name for config in vehicle.configs if config.started] == ["imu"]
