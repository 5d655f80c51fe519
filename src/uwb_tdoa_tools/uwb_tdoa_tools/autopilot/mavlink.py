# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ODOMETRY over MAVLink, for PX4 and ArduPilot; pymavlink packs and parses the messages.

Stamps are those of the filter, on the clock of the node. PX4 asks for that clock by TIMESYNC and
converts the stamps itself; ArduPilot finds the offset from the stamps alone.

Nothing is signed. The link has one peer: the source of the first valid HEARTBEAT of the vehicle. It
hears and answers no other source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
import os
import re
import socket
import time
from typing import Any

from uwb_tdoa_bias.common.errors import InputError

from .estimate import FRD, UPPER, Estimate, Link, missing

CONNECTION = re.compile(r"(udpin|udpout|tcp|tcpin):[^:\s]+:\d{1,5}|/dev/[\w./-]+")
FORMS = "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or /dev/NAME"
COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
HEARTBEAT, SILENT = 1.0, 3.0  # s between our heartbeats; s without one of the autopilot
AGAIN = 2.0  # s between two attempts to open a port
# Of one turn, because a flood must not hold up the odometry: datagrams or messages, and bytes of a
# datagram or a stream.
MOST_READ, LONGEST = 100, 2048
MOST_CALLERS = 8  # connections to tcpin without a HEARTBEAT; one more ends the oldest
NAMES = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT
TEXT = 50  # bytes of a STATUSTEXT
INVALID = 8  # MAV_AUTOPILOT of a sender that is no autopilot, e.g. a ground station


class Port:
    """Bytes from one peer and to it, by a socket or a serial port that never blocks.

    Attributes
    ----------
    datagrams : whether each piece of bytes is a datagram.
    waits : whether the peer calls. Every source is read until `keep`.
    peer : address of the peer, or None.
    """

    def __init__(self, connection: str, baud: int) -> None:
        """Open one of FORMS; raise OSError. baud : of a serial port."""
        self._form, _, place = connection.partition(":")
        host, _, number = place.partition(":")
        self._place: Any = (host, int(number)) if place else (self._form, baud)
        self.datagrams, self.waits = self._form.startswith("udp"), self._form.endswith("in")
        self._ends: dict[Any, Any] = {}  # {address: socket}; the listening one is the first
        self.peer: Any = None
        self.open()

    def open(self) -> None:
        """Open the port. Raises OSError."""
        end: Any
        if self._form.startswith("/"):
            end = _Serial(*self._place)
        elif self._form == "tcpin":
            end = socket.create_server(self._place)
        else:
            end = socket.socket(type=socket.SOCK_DGRAM if self.datagrams else socket.SOCK_STREAM)
        end.setblocking(False)
        if self._form.startswith("tcp"):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self._form == "udpin":
            end.bind(self._place)
        elif not self.waits:
            with suppress(BlockingIOError):  # a stream is connected later
                end.connect(self._place)
            self.peer = self._place
        self._ends[self._place] = end

    def keep(self, source: Any) -> None:
        """Make a source the peer: from now on, no other is read."""
        end = self._ends.pop(self._place if self.datagrams else source)
        if self.datagrams:
            end.connect(source)
        self.close()
        self._ends, self.peer = {source: end}, source

    def read(self) -> Iterator[tuple[Any, bytes]]:
        """Yield (source, bytes) of what came: datagrams, and one piece of each stream.

        Raises OSError if the stream of the peer has ended.
        """
        several = self.datagrams or self.peer is None
        for place, end in [*self._ends.items()]:
            for _ in range(MOST_READ if self.datagrams else 1):
                try:
                    if self._form == "tcpin" and place == self._place:
                        self._accept(end)
                    data, source = end.recvfrom(LONGEST)
                    if not (data or several):
                        raise ConnectionError("the other side has closed it")
                except OSError as error:
                    if several or isinstance(error, BlockingIOError):
                        break
                    raise
                source = source if self._form == "udpin" else place
                if self.peer in (None, source):
                    yield source, data

    def _accept(self, listening: socket.socket) -> None:
        end, place = listening.accept()
        end.setblocking(False)
        self._ends[place] = end
        if len(self._ends) > MOST_CALLERS + 1:
            self._ends.pop([*self._ends][1]).close()

    @property
    def is_open(self) -> bool:
        return bool(self._ends)

    def write(self, data: bytes) -> None:
        """Write what the socket takes at once; `read` raises if the peer is gone."""
        with suppress(KeyError, OSError):  # without a peer, there is nobody to write to
            self._ends[self.peer].send(data)

    def close(self) -> None:
        """Close the port and forget the peer."""
        for end in self._ends.values():
            end.close()
        self._ends, self.peer = {}, None


class _Serial:
    """A serial port with the methods of a socket."""

    def __init__(self, device: str, baud: int) -> None:
        from serial import Serial

        # some versions of Linux set a rate only if it differs from that of the start
        self._port = Serial(device, 1200, timeout=0)
        self._port.baudrate, self.close = baud, self._port.close
        self.setblocking = self.connect = lambda _: None

    def recvfrom(self, size: int) -> tuple[bytes, None]:
        if data := self._port.read(size):
            return data, None
        raise BlockingIOError

    def send(self, data: bytes) -> int:
        return os.write(self._port.fileno(), data)  # write() of pyserial would wait


class MavlinkLink(Link):
    """A link to PX4 or ArduPilot."""

    def __init__(
        self,
        connection: str,
        baud: int,
        system: int,
        world: tuple[str, float],
        origin: Sequence[float],
        clock: Callable[[], int],
    ) -> None:
        """Open the connection.

        Parameters
        ----------
        connection : str
            One of FORMS.
        baud : int
            Of a serial port.
        system : int
            MAVLink system id of the vehicle: to send with, and the only one that is heard.
        world : tuple
            Frame of ODOMETRY, FRD or NED, and yaw of the hall, in rad (Estimate.in_mavlink).
        origin : sequence of float
            Latitude and longitude, in degrees, and altitude, in m, of the origin; or empty.
        clock : callable
            Returns the time that stamps refer to, in ns since 1970.
        """
        if not CONNECTION.fullmatch(connection):
            raise InputError(f"connection: {connection!r} is none of {FORMS}.")
        try:
            from pymavlink.dialects.v20 import common

            self._port = Port(connection, baud)
        except ImportError as error:
            raise missing("mavlink", error, "pymavlink pyserial") from error
        except (OSError, ValueError, OverflowError) as error:
            raise InputError(
                f"connection: {connection} cannot be opened ({error}); connect the autopilot, or "
                "correct the connection."
            ) from error
        self._world, self._clock, self._system = world, clock, system
        self._origin, self._origin_set, self._said, self._texts = tuple(origin), False, "", 0
        self._dialect = common
        self._mav = common.MAVLink(self._port, srcSystem=system, srcComponent=COMPONENT)
        self._parser: Any = None
        self._odometry_sent = self._timesync_answered = 0  # numbers of messages
        self._opened_at = time.monotonic()  # s
        # time.monotonic(), s
        self._heartbeat_sent_at = self._heartbeat_heard_at = self._odometry_sent_at = -SILENT
        self._autopilot, self._why = "none", ""

    def send(self, estimate: Estimate, resets: int) -> None:
        """Send ODOMETRY, in the frames of MAVLink."""
        if self._port.peer is None:
            return
        ours, dialect = estimate.in_mavlink(*self._world), self._dialect
        # ArduPilot takes the name FRD alone, and x as north
        is_frd = self._world[0] == FRD or self._autopilot == NAMES[3]
        local = dialect.MAV_FRAME_LOCAL_FRD if is_frd else dialect.MAV_FRAME_LOCAL_NED
        x, y, z, w = ours.q.tolist()
        self._mav.send(
            dialect.MAVLink_odometry_message(
                ours.stamp // 1000,  # us
                local,
                dialect.MAV_FRAME_BODY_FRD,
                *ours.p.tolist(),
                [w, x, y, z],
                *ours.v.tolist(),
                *ours.w.tolist(),
                ours.pose_covariance[UPPER].tolist(),
                ours.twist_covariance[UPPER].tolist(),
                resets % 256,  # MAVLink has 8 bits for it
                dialect.MAV_ESTIMATOR_TYPE_VIO,
                ours.quality,
            )
        )
        self._odometry_sent += 1
        self._odometry_sent_at = time.monotonic()

    def say(self, text: str) -> None:
        """Send a STATUSTEXT if the text is another than the last one."""
        if text == self._said or self._port.peer is None:
            return
        self._said, self._texts = text, self._texts % 255 + 1
        content = (text or "odometry is sent again").encode("ascii", "replace")
        severity = self._dialect.MAV_SEVERITY_WARNING if text else self._dialect.MAV_SEVERITY_INFO
        for number, begin in enumerate(range(0, len(content), TEXT)):
            part = content[begin : begin + TEXT]
            self._mav.statustext_send(severity, part, self._texts, number)

    def turn(self) -> None:
        """Answer TIMESYNC, note heartbeats of the autopilot, and send ours."""
        now = time.monotonic()
        try:
            for source, data in self._port.read():
                for message in self._parse(data):
                    self._take(message, source, now)
            silent = now > max(self._heartbeat_heard_at, self._opened_at) + SILENT
            if silent and self._port.peer and (self._port.waits or self._port.datagrams):
                self._port.close()  # another source may become the peer, or our address has changed
            if now >= self._opened_at + AGAIN and not self._port.is_open:
                self._opened_at = now
                self._port.open()
        except OSError as error:
            self._why = f" ({error.strerror or error})"
            self._port.close()
        if now >= self._heartbeat_sent_at + HEARTBEAT:
            self._heartbeat_sent_at, dialect = now, self._dialect
            is_active = now < self._odometry_sent_at + HEARTBEAT
            if self._origin and not self._origin_set:
                degrees, altitude = self._origin[:2], round(1e3 * self._origin[2])
                place = [round(1e7 * one) for one in degrees]
                self._mav.set_gps_global_origin_send(
                    self._system, *place, altitude, self._clock() // 1000
                )
            self._mav.send(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                    dialect.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    dialect.MAV_STATE_ACTIVE if is_active else dialect.MAV_STATE_STANDBY,
                    3,
                )
            )

    def _parse(self, data: bytes) -> list[Any]:
        """Return the messages of a datagram, or the next ones of the stream of the peer."""
        if self._parser is None or self._port.datagrams or self._port.peer is None:
            self._parser = self._dialect.MAVLink(None)
            self._parser.robust_parsing = True
        messages = self._parser.parse_buffer(data) or []
        # pymavlink would let the buffer grow
        self._parser.buf, self._parser.buf_index = self._parser.buf[self._parser.buf_index :], 0
        return messages

    def _take(self, message: Any, source: Any, now: float) -> None:
        """Take one message, from the peer or from a source that may become the peer."""
        kind, system = message.get_type(), message.get_srcSystem()
        is_autopilot = kind == "HEARTBEAT" and message.autopilot != INVALID
        if system != self._system:
            if is_autopilot:
                self._why = f", but one of system {system}: set system_id if that is the vehicle"
        elif is_autopilot:
            if self._port.peer is None:
                self._port.keep(source)
            if now > self._heartbeat_heard_at + SILENT:
                self._origin_set, self._said = False, ""  # it may have been started anew
            self._heartbeat_heard_at, self._why = now, ""
            self._autopilot = NAMES.get(message.autopilot, f"type {message.autopilot}")
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin_set = True
        elif kind == "TIMESYNC" and message.tc1 == 0 and self._port.peer is not None:
            self._mav.send(self._dialect.MAVLink_timesync_message(self._clock(), message.ts1))
            self._timesync_answered += 1

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return the trouble, "" if there is none, and the counts for /diagnostics."""
        trouble = (
            f"no heartbeat comes from the autopilot, system {self._system}{self._why}: check the "
            "connection, and that this port of the autopilot speaks MAVLink"
        )
        peer = self._port.peer
        silent = peer is None or time.monotonic() > self._heartbeat_heard_at + SILENT
        return trouble if silent else "", {
            "autopilot": self._autopilot,
            "peer": ":".join(map(str, peer or ["none"])),
            "ODOMETRY sent": self._odometry_sent,
            "TIMESYNC answered": self._timesync_answered,
        }

    def close(self) -> None:
        """Close the port."""
        self._port.close()
