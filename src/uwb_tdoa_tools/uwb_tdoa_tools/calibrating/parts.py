"""A recording in parts by time."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.foundation.flight import AIDS, Flight

STREAMS = "tdoa", "imu", "truth", *AIDS


def between(flight: Flight, first: float, last: float) -> Flight:
    """What of a Flight is stamped from `first` on and before `last`, s."""
    cut = {}
    for name in STREAMS:
        stream = getattr(flight, name)
        if stream is not None:
            inside = (stream.t >= first) & (stream.t < last)
            cut[name] = type(stream)(*(column[inside] for column in vars(stream).values()))
    return replace(flight, extra={}, **cut)


def split(flight: Flight, share: float) -> tuple[Flight, Flight]:
    """A Flight until a share of the time in which it is located, and from there on."""
    middle = flight.start + share * (flight.end - flight.start)
    return between(flight, -np.inf, middle), between(flight, middle, np.inf)
