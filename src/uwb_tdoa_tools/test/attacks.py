# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Attacks on the link to an autopilot, and an autopilot on loopback that counts what it gets.

    python src/uwb_tdoa_tools/test/attacks.py

measures each attack on the real node (docs/notebook/reliability.md).
"""

from contextlib import ExitStack
import pathlib
import random
import socket
import subprocess
import sys
import time

LOOPBACK = "127.0.0.1"


class Autopilot:
    """One end of a MAVLink connection, by a socket that never blocks.

    odometry : received ODOMETRY messages
    ages : their ages at arrival, s
    answers : number of received TIMESYNC
    """

    def __init__(self, end: socket.socket, system: int = 1, kind: int = 12) -> None:
        """end : socket that is connected to the node, or sends to it; kind : MAV_AUTOPILOT."""
        from pymavlink.dialects.v20 import common

        self.end, self.dialect = end, common
        self.end.setblocking(False)
        self.mav = common.MAVLink(self, srcSystem=system, srcComponent=1)
        self.mav.robust_parsing = True
        self.odometry, self.ages, self.answers, self.kind = [], [], 0, kind
        self.heard = {}  # {type: messages}

    @classmethod
    def calling(cls, port, system=1, kind=socket.SOCK_DGRAM):
        """Return an autopilot that calls a port of loopback."""
        end = socket.socket(type=kind)
        end.connect((LOOPBACK, port))
        return cls(end, system)

    def write(self, data):
        try:
            self.end.send(data)
        except OSError:  # nobody listens
            pass

    def beat(self):
        self.mav.heartbeat_send(self.dialect.MAV_TYPE_QUADROTOR, self.kind, 0, 0, 4)

    def ask(self):
        """Ask for the clock of the node."""
        self.mav.timesync_send(0, 12345)

    def receive(self):
        """Read what came. Return whether anything did."""
        any_came = False
        while True:
            try:
                data = self.end.recv(65536)
            except OSError:
                return any_came
            if not data:
                return any_came
            any_came = True
            for message in self.mav.parse_buffer(data) or []:
                kind = message.get_type()
                self.answers += kind == "TIMESYNC"
                if kind != "ODOMETRY":
                    self.heard.setdefault(kind, []).append(message)
                else:
                    self.odometry.append(message)
                    self.ages.append(time.time() - 1e-6 * message.time_usec)

    def close(self):
        self.end.close()


def free_port(kind=socket.SOCK_DGRAM):
    """Return a port of loopback that nobody has."""
    with socket.socket(type=kind) as end:
        end.bind((LOOPBACK, 0))
        return end.getsockname()[1]


# --- attacks by datagrams: each sends to a port ---


def _sources(count):
    return [socket.socket(type=socket.SOCK_DGRAM) for _ in range(count)]


def one_byte(port, number=30_000):
    """Send datagrams of one byte, each from another port. Return the first 100 sockets."""
    sources = []
    for k in range(number):
        source = socket.socket(type=socket.SOCK_DGRAM)
        source.sendto(b"x", (LOOPBACK, port))
        if k < 100:
            sources.append(source)
        else:
            source.close()
    return sources


def empty(port, number=1):
    """Send empty datagrams, each from another port."""
    sources = _sources(number)
    for source in sources:
        source.sendto(b"", (LOOPBACK, port))
    return sources


def _packed(fill, system):
    from pymavlink.dialects.v20 import common

    mav = common.MAVLink(None, srcSystem=system, srcComponent=1)
    return b"".join(message.pack(mav) for message in fill(common))


def heartbeats(port, number=1, system=7, each=1):
    """Send datagrams of `each` heartbeats of a system, each from another port."""
    data = _packed(lambda it: [it.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)] * each, system)
    sources = _sources(min(number, 1000))
    for k in range(number):
        sources[k % len(sources)].sendto(data, (LOOPBACK, port))
    return sources


def parameters(send, number, system=1):
    """Send PARAM_VALUE with random names by a callable."""
    draw = random.Random()
    for _ in range(number):
        name = bytes(draw.randrange(65, 91) for _ in range(16))
        send(_packed(lambda it: [it.MAVLink_param_value_message(name, 1.0, 9, 1, 0)], system))


# --- the same on the real node ---


QUIET, LASTS = 4.0, 10.0  # s before an attack, and from its begin
ROWS = {  # attack: (form of the connection, what another process sends to the port)
    "none": ("udpin", ""),
    "30 000 datagrams of one byte": ("udpin", "strangers = one_byte(port)"),
    "one empty datagram": ("udpin", "strangers = empty(port)"),
    "heartbeats of another system": ("udpin", "strangers = heartbeats(port, 3000, each=60)"),
    "random parameters of the peer": ("udpin", ""),
    "a silent first caller": ("tcpin", ""),
    "a peer that accepts and closes": ("tcp", ""),
}


def measure(name):
    """Return a row of the table: an attack on the node, and what becomes of the stream."""
    from autopilots import at_rest, bench

    from uwb_tdoa_msgs.msg import EstimatorStatus

    form, attack = ROWS[name]
    kind = socket.SOCK_DGRAM if form == "udpin" else socket.SOCK_STREAM
    port, autopilots, calls = free_port(kind), [], []
    with ExitStack() as stack:
        listening = stack.enter_context(socket.create_server((LOOPBACK, port)))
        listening.setblocking(False)
        if form != "tcp":
            listening.close()

        def turn():
            for autopilot in autopilots:
                autopilot.receive()
            if form == "tcp":
                try:
                    listening.accept()[0].close()
                    calls.append(time.time())
                except OSError:
                    pass

        rig = stack.enter_context(bench(turn))
        rig.start("protocol:=mavlink", f"connection:={form}:{LOOPBACK}:{port}")
        rig.tell(EstimatorStatus.STATUS_RUNNING)
        if form == "tcpin":
            stack.enter_context(socket.create_connection((LOOPBACK, port)))
            time.sleep(0.5)
        if form != "tcp":
            autopilots.append(Autopilot.calling(port, kind=kind))

        def fly(seconds, each_time=lambda: None):
            begun = beaten = published = time.monotonic()
            until = begun + seconds

            def is_over():
                nonlocal beaten, published
                now = time.monotonic()
                if autopilots and now > beaten:
                    beaten += 1.0
                    autopilots[0].beat()
                while published < now:
                    published += 0.01
                    rig.publish(at_rest(1))
                each_time()
                return now > until

            rig.wait(is_over, "end")
            got = [(each.odometry[:], each.ages[:]) for each in autopilots] or [([], [])]
            for each in autopilots:
                each.odometry.clear(), each.ages.clear()
            return len(got[0][0]) / seconds, max(got[0][1], default=float("nan"))

        def resident():
            text = pathlib.Path(f"/proc/{rig.process.pid}/status").read_text()
            return int(text.partition("VmRSS:")[2].split()[0]) / 1024

        fly(2.0)
        before, memory, lines = fly(QUIET), resident(), len("".join(rig.lines))
        heard = "strangers = []"
        code = f"from attacks import *; port = {port}; {attack or heard}; time.sleep({LASTS}); "
        code += "print(sum(map(heard_by, strangers)))"
        stranger = subprocess.Popen(
            [sys.executable, "-c", code], cwd=pathlib.Path(__file__).parent, stdout=subprocess.PIPE
        )
        send = (lambda: parameters(autopilots[0].write, 50)) if "parameters" in name else None
        after = fly(LASTS, send or (lambda: None))
        grown, told = resident() - memory, len("".join(rig.lines)) - lines
        leaked = int(stranger.communicate()[0])
        text = rig.text
        for each in autopilots:
            each.close()
    return (
        f"| {name} | {form} | {before[0]:.0f} | {after[0]:.0f} | {after[1]:.2f} | {leaked} | "
        f"{grown:.1f} | {told} | {len(calls)} | {text} |"
    )


def heard_by(source):
    """Return how many datagrams a socket was sent."""
    source.setblocking(False)
    count = 0
    try:
        while True:
            source.recv(65536)
            count += 1
    except OSError:
        return count


if __name__ == "__main__":
    # as conftest.py does for pytest
    sys.path.append(str(pathlib.Path(__file__).resolve().parents[2] / "uwb_tdoa_bias" / "test"))
    for row in sys.argv[1:] or ROWS:
        print(measure(row), flush=True)
