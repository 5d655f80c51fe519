# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert a recording to a bag, and state what was read, written and left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import Stream
from uwb_tdoa_ekf.results import rows_of

from .bags.bag import check_output, write_bag

Timed = Tdoas | Imu | Truth | Stream


def convert(
    read: Callable[[], Flight], out: str | Path, storage: str = "mcap", force: bool = False
) -> dict[str, Any]:
    """Write a recording as a bag, see `write_bag`, and return a summary.

    Parameters
    ----------
    read : returns the Flight.

    Returns
    -------
    flight, bag : name of the flight, path of the bag.
    messages : {topic: count}.
    read : {stream: (samples, s of the first, s of the last)}.
    start, end : s.
    anchors : number of anchors.
    tdoa_unknown_anchor : number of TDOAs and ranges of anchors outside of the survey.
    left_out : {stream without a place in a bag: events}.
    meta : of the Flight.
    apart : sentences on sensors without common time with TDOAs or ranges.

    Raises InputError.
    """
    check_output(out, force)  # before the work, not after it
    flight = _from_zero_on(read())
    counts, held = write_bag(flight, out, storage, force), _held(flight)
    together = [stream for stream in held.values() if _overlaps(stream, flight)]
    known = (flight.anchors.index(flight.tdoa.a) >= 0) & (flight.anchors.index(flight.tdoa.b) >= 0)
    ranges_known = (
        np.ones(0, bool) if flight.range is None else flight.anchors.index(flight.range.anchor) >= 0
    )
    return {
        "flight": flight.name,
        "bag": str(out),
        "messages": counts,
        "read": {name: (len(of.t), float(of.t[0]), float(of.t[-1])) for name, of in held.items()},
        "start": min(float(stream.t[0]) for stream in together),
        "end": max(float(stream.t[-1]) for stream in together),
        "anchors": len(flight.anchors),
        "tdoa_unknown_anchor": int(np.count_nonzero(~known) + np.count_nonzero(~ranges_known)),
        "left_out": {name: len(columns["t"]) for name, columns in flight.extra.items()},
        "meta": flight.meta,
        "apart": _disjoint_sensors(flight),
    }


def described(made: dict[str, Any]) -> list[str]:
    """Return the summary of `convert` as lines: what was read and written, with counts, and what was left out."""
    meta, seconds = made["meta"], made["end"] - made["start"]
    out = [f"{made['flight']}: {seconds:.1f} s, {meta.get('protocol', 'protocol unknown')}"]
    if ids := meta.get("anchor_ids"):
        listed = ", ".join(f"{name} is {number}" for name, number in ids.items())
        out.append(f"  ids in the bag: {listed}")
    out += [f"  read {sentence}" for sentence in meta.get("read", ())]
    out += [f"  not read {sentence}" for sentence in meta.get("unread", ())]
    out += [f"  {remark}" for remark in meta.get("remarks", ())]
    out += [
        f"  {stream}: {count}, {first:.1f} to {last:.1f} s"
        for stream, (count, first, last) in made["read"].items()
    ]
    out += [f"  {topic}: {count}" for topic, count in made["messages"].items()]
    out += [
        f"  {name}: {count} events left out, a bag has no place for them"
        for name, count in made["left_out"].items()
    ]
    out += [
        f"  {topic}: sorted, its stamps fell {falls} times"
        for topic, falls in meta.get("reordered", {}).items()
    ]
    if count := made["tdoa_unknown_anchor"]:
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
    changed, remarks = dict[str, Any](), list(flight.meta.get("remarks", ()))
    for name, stream in _held(flight).items() if flight.start >= 0.0 else ():
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


def _held(flight: Flight) -> dict[str, Timed]:
    """Return {name: stream} of the streams that have messages."""
    return {name: of for name, of in flight.streams.items() if len(of.t)}


def _overlaps(one: Timed, flight: Flight) -> bool:
    """Return whether a stream has a time in common with TDOAs or ranges."""
    return one.t[-1] >= flight.start and one.t[0] <= flight.end


def _disjoint_sensors(flight: Flight) -> list[str]:
    """Return sentences on sensors without common time with TDOAs or ranges: another clock."""
    begin, end, remarks = flight.start, flight.end, []
    radio = "TDOAs" if len(flight.tdoa) else "ranges"
    for name, stream in _held(flight).items():
        t = stream.t
        if not _overlaps(stream, flight):
            remarks.append(
                f"{name} runs from {t[0]:.1f} to {t[-1]:.1f} s, the {radio} from {begin:.1f} "
                f"to {end:.1f} s: clocks that have no time in common; "
                f"--time-offset {name}={begin - t[0]:.3f} lets both begin together, if they did."
            )
    return remarks
