"""A recording of any kind as a bag."""

from dataclasses import dataclass

import numpy as np

from .bag import check_output, write_bag


@dataclass(frozen=True)
class Converted:
    """flight : name; bag : path; messages : {topic: count}; start, end : s; anchors : how many; tdoa_unknown_anchor :
    measurements of anchors that the survey does not have; left_out : {stream that a bag has no place for: events};
    meta : of the Flight."""

    flight: str
    bag: str
    messages: dict
    start: float
    end: float
    anchors: int
    tdoa_unknown_anchor: int
    left_out: dict
    meta: dict


def convert(read, out, storage="mcap", force=False):
    """Write a recording as a bag, see `write_bag`. read : callable, gives the Flight. Returns Converted. Raises
    InputError."""
    check_output(out, force)  # before the work, not after it
    flight = read()
    counts = write_bag(flight, out, storage, force)
    streams = [stream for stream in (flight.tdoa, flight.imu, flight.truth) if stream is not None and len(stream)]
    known = (flight.anchors.index(flight.tdoa.a) >= 0) & (flight.anchors.index(flight.tdoa.b) >= 0)
    return Converted(
        flight=flight.name,
        bag=str(out),
        messages=counts,
        start=min(float(stream.t[0]) for stream in streams),
        end=max(float(stream.t[-1]) for stream in streams),
        anchors=len(flight.anchors),
        tdoa_unknown_anchor=int(np.count_nonzero(~known)),
        left_out={name: len(columns["t"]) for name, columns in flight.extra.items()},
        meta=flight.meta,
    )
