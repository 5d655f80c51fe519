# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert a recording of any kind to a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import Stream
from uwb_tdoa_ekf.results import rows_of

from ..choices import STREAMS
from .bag import check_output, write_bag

Timed = Tdoas | Imu | Truth | Stream

SENSORS = *STREAMS, *SENSOR_NAMES


@dataclass(frozen=True)
class Converted:
    """Summary of a conversion.

    Attributes
    ----------
    flight, bag : name of the flight, path of the bag.
    messages : {topic: count}.
    read : {stream: (samples, s of the first, s of the last)}.
    start, end : s.
    anchors : number of anchors.
    tdoa_unknown_anchor : number of TDOAs and ranges of anchors outside of the survey.
    left_out : {stream without a place in a bag: events}.
    meta : of the Flight.
    apart : sentences on sensors without common time with TDOAs or ranges.
    """

    flight: str
    bag: str
    messages: dict[str, int]
    read: dict[str, tuple[int, float, float]]
    start: float
    end: float
    anchors: int
    tdoa_unknown_anchor: int
    left_out: dict[str, int]
    meta: dict[str, Any]
    apart: list[str]


def convert(
    read: Callable[[], Flight], out: str | Path, storage: str = "mcap", force: bool = False
) -> Converted:
    """Write a recording as a bag, see `write_bag`; `read` returns the Flight.

    Raises InputError.
    """
    check_output(out, force)  # before the work, not after it
    flight = _from_zero_on(read())
    counts = write_bag(flight, out, storage, force)
    together = [
        stream for name in _held(flight) if _overlaps(stream := getattr(flight, name), flight)
    ]
    known = (flight.anchors.index(flight.tdoa.a) >= 0) & (flight.anchors.index(flight.tdoa.b) >= 0)
    ranges_known = (
        np.ones(0, bool) if flight.range is None else flight.anchors.index(flight.range.anchor) >= 0
    )
    return Converted(
        flight=flight.name,
        bag=str(out),
        messages=counts,
        read={
            name: (len(t), float(t[0]), float(t[-1]))
            for name in _held(flight)
            for t in [getattr(flight, name).t]
        },
        start=min(float(stream.t[0]) for stream in together),
        end=max(float(stream.t[-1]) for stream in together),
        anchors=len(flight.anchors),
        tdoa_unknown_anchor=int(np.count_nonzero(~known) + np.count_nonzero(~ranges_known)),
        left_out={name: len(columns["t"]) for name, columns in flight.extra.items()},
        meta=flight.meta,
        apart=_disjoint_sensors(flight),
    )


def described(converted: Converted) -> list[str]:
    """Return a conversion as lines: what was read and written, with counts, and what was left out."""
    meta, seconds = converted.meta, converted.end - converted.start
    out = [f"{converted.flight}: {seconds:.1f} s, {meta.get('protocol', 'protocol unknown')}"]
    if ids := meta.get("anchor_ids"):
        listed = ", ".join(f"{name} is {number}" for name, number in ids.items())
        out.append(f"  ids in the bag: {listed}")
    out += [f"  read {sentence}" for sentence in meta.get("read", ())]
    out += [f"  not read {sentence}" for sentence in meta.get("unread", ())]
    out += [f"  {remark}" for remark in meta.get("remarks", ())]
    for stream, (count, first, last) in converted.read.items():
        out.append(f"  {stream}: {count}, {first:.1f} to {last:.1f} s")
    out += [f"  {topic}: {count}" for topic, count in converted.messages.items()]
    for name, count in converted.left_out.items():
        out.append(f"  {name}: {count} events left out, a bag has no place for them")
    for topic, falls in meta.get("reordered", {}).items():
        out.append(f"  {topic}: sorted, its stamps fell {falls} times")
    if count := converted.tdoa_unknown_anchor:
        out.append(
            f"  {count} measurements name an anchor that the survey does not have; check lists them"
        )
    return out


def shifted(flight: Flight, offsets: dict[str, float]) -> Flight:
    """Return the Flight with offsets {sensor: s} added to its stamps.

    Raises InputError for a sensor that the Flight does not have.
    """
    changed = {}
    for sensor, offset in offsets.items():
        stream = getattr(flight, sensor)
        if stream is None:
            raise InputError(
                f"--time-offset: {flight.name} holds no {sensor}; it holds "
                f"{', '.join(_held(flight))}."
            )
        changed[sensor] = replace(stream, t=stream.t + offset)
    return replace(flight, **changed)


def _from_zero_on(flight: Flight) -> Flight:
    """Return the Flight without samples before 0 s of sensors, if TDOAs and ranges start later.

    A shifted clock may start there, and a bag has no negative stamps.
    """
    changed, remarks = {}, list(flight.meta.get("remarks", ()))
    for name in _held(flight) if flight.start >= 0.0 else ():
        stream = getattr(flight, name)
        inside = stream.t >= 0.0
        if inside.any() and not inside.all():
            changed[name] = rows_of(stream, inside)
            remarks.append(
                f"{name}: {np.count_nonzero(~inside)} samples before 0 s, which a bag has no "
                "place for, are left out"
            )
    return (
        replace(flight, **changed, meta={**flight.meta, "remarks": remarks}) if changed else flight
    )


def _held(flight: Flight) -> list[str]:
    return [
        name
        for name in SENSORS
        if getattr(flight, name) is not None and len(getattr(flight, name).t)
    ]


def _overlaps(one: Timed, flight: Flight) -> bool:
    """Return whether a stream has a time in common with TDOAs or ranges."""
    return one.t[-1] >= flight.start and one.t[0] <= flight.end


def _disjoint_sensors(flight: Flight) -> list[str]:
    """Return sentences on sensors without common time with TDOAs or ranges: another clock."""
    begin, end, remarks = flight.start, flight.end, []
    radio = "TDOAs" if len(flight.tdoa) else "ranges"
    for name in _held(flight):
        t = getattr(flight, name).t
        if not _overlaps(getattr(flight, name), flight):
            remarks.append(
                f"{name} runs from {t[0]:.1f} to {t[-1]:.1f} s, the {radio} from {begin:.1f} "
                f"to {end:.1f} s: clocks that have no time in common; "
                f"--time-offset {name}={begin - t[0]:.3f} lets both begin together, if they did."
            )
    return remarks
