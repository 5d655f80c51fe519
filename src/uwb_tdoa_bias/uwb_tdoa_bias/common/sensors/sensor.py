"""What a sensor is, beside inertia and TDOAs: everything that is not its mathematics in the filter,
said once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

# in a message, whose covariances are to be finite: at which and above nothing was measured
UNKNOWN_VARIANCE = 1e6
UNKNOWN_STD = 1e6  # that stands for an infinite one where it is computed with
RATE = 25.0  # Hz, of simulated sensors
# of anything in a recording, in whatever unit: what is computed of it stays finite
LARGEST_NUMBER = 1e30


@dataclass(frozen=True)
class Stream:
    """Measurements of one sensor: a frozen dataclass of arrays of one length, the first of which is
    t (n,), s.
    """

    t: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    @property
    def columns(self) -> list:
        """Its arrays, stamps first."""
        return [getattr(self, each.name) for each in fields(self)]

    @property
    def values(self) -> np.ndarray:
        """What was measured as effects see it, (n, k)."""
        raise NotImplementedError

    def with_values(self, values: np.ndarray) -> Stream:
        """The same with other values (n, k)."""
        raise NotImplementedError

    def sensed(self, values: np.ndarray) -> Stream:
        """The same with other values (n, k) as the sensor would give them."""
        return self.with_values(values)

    @property
    def parts(self) -> dict[str, Stream]:
        """{channel of the diagnosis: Stream} of what its messages measure besides, if they do."""
        return {}

    def with_part(self, channel: str, part: Stream) -> Stream:
        """The same with another one of its `parts`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Compared:
    """How the diagnosis compares a sensor with poses; see diagnosis/channels/aid.py and radio.py of
    uwb_tdoa_tools.

    reading : callable of (Track, t (n,)) -> (n, k), what should have been read; None for distances
        to anchors
    needs : what a flight must have for it, words
    negligible : unit of the stream, a constant error below it is nothing
    floating : a constant tells nothing
    of_attitude : the attitude must be known
    axes : what is added to its name in labels
    positions : coordinates that the reference must know
    """

    reading: Callable | None
    needs: str
    negligible: float
    unit: str = "m"
    floating: bool = False
    of_attitude: bool = True
    axes: tuple = ("",)
    positions: tuple = (2,)


@dataclass(frozen=True)
class Mistake:
    """What a rule of `check` finds: its name, what is wrong, the numbers that show it, a line to
    copy, and the number that decided.
    """

    rule: str
    cause: str
    evidence: str
    remedy: str
    value: float
    severe: bool = True  # or a warning


@dataclass(frozen=True)
class Sensor:
    """A kind of measurement. `name` is that of its stream in a Flight, of its counters on
    /diagnostics, of its use_<name> and of `--without`; core/ of uwb_tdoa_ekf has its update of the
    filter.

    plural : words for several measurements
    stream : class of its Stream
    message, fields : type of its messages, and {field: how many numbers} of what is read of them
    columns : callable of {field: (n,) or (n, k)} -> columns of the Stream, without stamps
    content : callable of a Stream -> {field: value, (n,) or (n, k)} of its messages; what is not
        among them is 0
    sound : callable of {field: (n,) or (n, k)} -> the same of bool: which of these numbers a
        recording may hold
    measured : callable of a Stream -> ({field of an AID: (n,) or (n, k)}, usable (n,) bool); AID:
        core/memory.py of
        uwb_tdoa_ekf
    simulated : callable of (SimulationConfig, Room, motion, turn, noise) -> columns, without
        stamps: what it says in truth,
        and white noise. motion : of the body; turn : its Rotations; noise(...) : standard normal
        numbers (n, ...)
    noise : (unit, words) of the std of that, for the options of `simulate`
    parameters : {name: `parameter`} of the filter; use_<name> is the first
    invalid, remedy : what a message must hold; what to check where it contradicts everything else
    compared : Compared, or None: it is not diagnosed
    parts : {channel of the diagnosis: Compared} of the `parts` of its Stream
    topic : "" for its name; rate : Hz, when it is simulated; locates : the filter can start from it
        alone
    rules : of `check`: callables of (Stream, Anchors) -> Mistake or None
    others : ((topic, message), ...) with the same fields that serve as well
    assumed : callable of a Stream -> names of the parameters that count where its messages state no
        deviation; None: all state theirs
    """

    name: str
    plural: str
    stream: type
    message: str
    fields: dict
    columns: Callable
    content: Callable
    sound: Callable
    measured: Callable
    simulated: Callable
    noise: tuple
    parameters: dict
    invalid: str
    remedy: str
    compared: Compared | None = None
    parts: dict[str, Compared] = field(default_factory=dict)
    topic: str = ""
    rate: float = RATE
    locates: bool = False
    rules: tuple = ()
    others: tuple = ()
    assumed: Callable | None = None

    @property
    def topics(self) -> tuple:
        """((topic, type of its messages), ...), its own first."""
        return ((self.topic or self.name, self.message), *self.others)

    def split(self, rows: np.ndarray) -> dict:
        """{field: (n,) or (n, k)} of all fields side by side, (n, m)."""
        ends, parts = np.cumsum(list(self.fields.values())), {}
        for (name, width), end in zip(self.fields.items(), ends):
            parts[name] = rows[:, end - width : end] if width > 1 else rows[:, end - 1]
        return parts

    def read(self, t: np.ndarray, fields: dict) -> Stream:
        """The Stream of messages with stamps t (n,), s, and these fields."""
        return self.stream(t, *self.columns(fields))


def parameter(
    default: float | str,
    text: str,
    high: float | None = None,
    low: float = 0.0,
    with_low: bool = False,
    fixed: bool = False,
) -> Any:
    """A field of FilterConfig. text : unit and meaning, as in ekf_node.yaml; a number must be above
    `low`, or may be that too, and at most `high`; fixed : cannot change while the filter runs.
    """
    limits = {"low": low, "high": high, "with_low": with_low}
    return field(default=default, metadata={"text": text, "fixed": fixed, **limits})


def finite(fields: dict) -> dict:
    """{field: bool}: every number of a recording is to be one."""
    return {name: np.abs(values) <= LARGEST_NUMBER for name, values in fields.items()}  # NaN is not
