# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ODOMETRY over MAVLink, for PX4 and ArduPilot, by pymavlink.

Stamps are those of the filter, on the clock of the node. PX4 asks for that clock by TIMESYNC and
converts the stamps itself; ArduPilot finds the offset from the stamps alone.
"""

from __future__ import annotations

from collections.abc import Callable
import os
import re
import time
from typing import Any

from uwb_tdoa_bias.common.errors import InputError

from .estimate import FRD, UPPER, Estimate, Link, missing

CONNECTION = re.compile(r"(udpin|udpout|tcp|tcpin):[^:\s]+:\d{1,5}|/dev/[\w./-]+")
FORMS = "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or /dev/NAME"
COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
HEARTBEAT, SILENT = 1.0, 3.0  # s between our heartbeats; s without one of the autopilot
MOST_READ = 100  # messages of one turn; a flood must not hold up the odometry
NAMES = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT
INVALID = 8  # MAV_AUTOPILOT of a sender that is no autopilot, e.g. a ground station


class MavlinkLink(Link):
    """A link to PX4 or ArduPilot."""

    def __init__(
        self, connection: str, baud: int, system: int, world_frame: str, clock: Callable[[], int]
    ) -> None:
        """Open the connection.

        Parameters
        ----------
        connection : str
            One of FORMS.
        baud : int
            Of a serial port.
        system : int
            MAVLink system id to send with: that of the vehicle.
        world_frame : str
            Frame of ODOMETRY: FRD or NED (Estimate.in_mavlink).
        clock : callable
            Returns the time that stamps refer to, in ns since 1970.
        """
        if not CONNECTION.fullmatch(connection):
            raise InputError(f"connection: {connection!r} is none of {FORMS}.")
        # ODOMETRY is in MAVLink 2 alone; pymavlink reads this on import
        os.environ["MAVLINK20"] = "1"
        try:
            from pymavlink import mavutil
        except ImportError as error:
            raise missing("mavlink", error, "pymavlink") from error
        self._world_frame, self._clock = world_frame, clock
        try:
            self._port = mavutil.mavlink_connection(
                connection,
                baud=baud,
                source_system=system,
                source_component=COMPONENT,
                autoreconnect=True,
                dialect="common",
            )
        except ImportError as error:
            raise missing("mavlink", error, "pyserial") from error
        except (OSError, ValueError, OverflowError) as error:
            raise InputError(
                f"connection: {connection} cannot be opened ({error}); connect the autopilot, or "
                "correct the connection."
            ) from error
        self._dialect = mavutil.mavlink
        self._odometry_sent = self._timesync_answered = 0  # numbers of messages
        self._heartbeat_sent_at = self._heartbeat_heard_at = -SILENT  # time.monotonic(), s
        self._autopilot = "none"

    def send(self, estimate: Estimate, resets: int) -> None:
        """Send ODOMETRY, in the frames of MAVLink."""
        ours, dialect = estimate.in_mavlink(self._world_frame), self._dialect
        is_frd = self._world_frame == FRD
        local = dialect.MAV_FRAME_LOCAL_FRD if is_frd else dialect.MAV_FRAME_LOCAL_NED
        x, y, z, w = ours.q.tolist()
        self._write(
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

    def turn(self) -> None:
        """Answer TIMESYNC, note heartbeats of the autopilot, and send ours."""
        now = time.monotonic()
        if now >= self._heartbeat_sent_at + HEARTBEAT:
            self._heartbeat_sent_at, dialect = now, self._dialect
            self._write(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                    dialect.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    dialect.MAV_STATE_ACTIVE,
                    3,
                )
            )
        for _ in range(MOST_READ):
            message = self._read()
            if message is None:
                return
            kind = message.get_type()
            if kind == "TIMESYNC" and message.tc1 == 0:  # a request; others are answers
                self._write(self._dialect.MAVLink_timesync_message(self._clock(), message.ts1))
                self._timesync_answered += 1
            elif kind == "HEARTBEAT" and message.autopilot != INVALID:
                self._heartbeat_heard_at = now
                self._autopilot = NAMES.get(message.autopilot, f"type {message.autopilot}")

    def _read(self) -> Any:
        try:
            return self._port.recv_msg()
        except OSError:  # of a port that is gone; pymavlink opens it again
            return None

    def _write(self, message: Any) -> None:
        try:
            self._port.mav.send(message)
        except OSError:
            pass  # as above; `report` returns the missing heartbeats as the trouble

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return the trouble, "" if there is none, and the counts for /diagnostics."""
        silent = time.monotonic() - self._heartbeat_heard_at > SILENT
        trouble = (
            "no heartbeat comes from the autopilot: check the connection, and that this port of the "
            "autopilot speaks MAVLink"
        )
        return trouble if silent else "", {
            "autopilot": self._autopilot,
            "ODOMETRY sent": self._odometry_sent,
            "TIMESYNC answered": self._timesync_answered,
        }

    def close(self) -> None:
        """Close the port."""
        self._port.close()
