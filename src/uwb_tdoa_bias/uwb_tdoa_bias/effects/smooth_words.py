"""Functions without a name in words: who is wrong by how much where, what could do such a thing,
and which trial tells.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .covariates import EXTRA, UNITS
from .wording import listed, measured, rounded

AXES = {"gyro": "the gyroscope reads {} about {}", "accel": "the accelerometer reads {} along {}"}
SENSOR_UNITS = {"gyro": "rad/s", "accel": "m/s^2"}
OF_PLACE = (
    "x",
    "y",
    "height",
    "range",
    "bearing",
    "elevation",
    "bearing_in_anchor",
    "elevation_in_anchor",
)
OF_DIRECTION = ("bearing_in_tag", "elevation_in_tag", "tilt")
# What could do such a thing, and what tells; the first of which both words fit: of whom, and over
# what.
_CAUSES = (
    (
        ("pair", "direction"),
        None,
        (
            "the time of flight that these anchors measured between them (Bitcraze documentation "
            "of TDoA2), or something between them"
        ),
        (
            "let them measure it again, then exchange one of the two modules: what stays is in "
            "the room"
        ),
    ),
    (
        ("anchor",),
        ("time",),
        (
            "something that came or went near it, its clock or its temperature (DW1000 user "
            "manual: 2.15 mm per degree)"
        ),
        "leave the tag at one place for as long: what still changes is in the anchor or near it",
    ),
    (
        ("anchor",),
        OF_PLACE,
        (
            "an obstacle or a reflector on that side of it, its antenna's pattern (Qorvo support: "
            "10 - 15 cm), or its place in the survey"
        ),
        (
            "exchange its module with that of another anchor and fly there again: what stays is "
            "in the room"
        ),
    ),
    (
        ("anchor", "arrival"),
        OF_DIRECTION,
        (
            "the pattern of the tag's antenna, or a part of the vehicle in the way (Qorvo "
            "support: 10 - 15 cm)"
        ),
        "turn the vehicle by hand on the spot",
    ),
    (
        ("arrival",),
        OF_PLACE,
        (
            "the detection of weak and strong signals (Decawave APS011), the antennas' pattern or "
            "the frame of the survey"
        ),
        "fly to and fro along one line to an anchor",
    ),
    (
        ("common",),
        ("time",),
        "the tag's clock, supply or temperature",
        "leave the tag at one place for as long",
    ),
    (
        None,
        ("speed", "climb_rate", "acceleration", "turning_rate", "vibration", "tilt"),
        "stamps that are late, the attitude of the antenna or its supply under load",
        "fly one straight line slowly and fast, level and tilted",
    ),
    (
        None,
        ("interval", "previous_anchor"),
        "the order in which packets come and how the tag handles them",
        "change the order of the anchors",
    ),
    (
        None,
        None,
        "nothing that is known to do this everywhere in the room",
        "fly where this changes and all else does not",
    ),
)
_SENSOR_CAUSES = {
    "time": (
        "warming up (BMI088 data sheet)",
        "leave the vehicle switched on and at rest for as long",
    ),
    "vibration": ("vibration that it rectifies", "mount it softer and fly again"),
    "turning": (
        "its scale, its axes, or a place off the centre of turns",
        "turn the vehicle by hand about one axis at a time",
    ),
    "force": (
        "its scale, its axes, or acceleration that it takes for turning (BMI088 data sheet)",
        "lay the vehicle on each side",
    ),
    "motion": (
        "air flow, magnetism or load that go with the motion",
        "carry the vehicle by hand along the same path",
    ),
}


class Function(Protocol):
    """What words need of a SmoothTerm."""

    channel: str
    covariate: str
    form: str
    shape: str
    knots: tuple[float, ...]
    values: dict[str, float]
    std: dict[str, float]

    @property
    def count(self) -> int: ...

    def curve(self, values: np.ndarray, prefix: str = "") -> np.ndarray: ...


def described(term: Function, part: str = "") -> str:
    """The function of an anchor "3", a pair "0-1" or of all, "", as a sentence without its end."""
    prefix = f"{part}." if part else ""
    name, unit = _named(term.covariate), UNITS.get(term.covariate, "")
    level, *more = (term.values.get(f"{prefix}c{k}", 0.0) for k in range(term.count))
    std = term.std.get(f"{prefix}c1")
    knots = [f"{rounded(knot)} {unit}".strip() for knot in term.knots]
    seen = f" (seen from {knots[0]} to {knots[-1]})" if term.shape != "wave" else ""
    if term.shape == "step":
        return _off(
            term,
            part,
            more[0],
            std,
            f" {_where(name, f'above {knots[1]}', f'after {knots[1]}')}{seen}",
        )
    if term.shape == "interval":
        return _off(
            term,
            part,
            more[0],
            std,
            (
                " "
                f"{_where(name, f'between {knots[1]} and {knots[2]}', f'from {knots[1]} to {knots[2]}')}{seen}"
            ),
        )
    if term.shape in ("line", "beyond", "below"):
        first, last = {"line": (0, 1), "beyond": (1, 2), "below": (1, 0)}[term.shape]
        slope = more[0] / (term.knots[last] - term.knots[first])
        error = None if std is None else std / abs(term.knots[last] - term.knots[first])
        reach = (
            ""
            if term.shape == "line"
            else f", {'above' if term.shape == 'beyond' else 'below'} {knots[1]}"
        )
        return _off(
            term, part, slope, error, f" for each {unit or 'unit'} more of {name}{reach}{seen}"
        )
    at = np.linspace(term.knots[0], term.knots[-1], 60)
    course = term.curve(at, prefix)
    top, bottom = int(np.argmax(course)), int(np.argmin(course))
    swing = course[top] - course[bottom]
    if term.shape == "wave":
        length = f"{rounded(term.knots[1] - term.knots[0])} {unit}".strip()
        return _off(term, part, swing, None, f" and less in turn, every {length} of {name}")
    where = (
        f" where {name} is {rounded(at[top])} {unit} than where it is {rounded(at[bottom])} {unit}"
    )
    return _off(term, part, swing, None, f"{where}{seen}")


def causes(term: Function) -> tuple[str, str]:
    """(what could do such a thing, which trial tells)."""
    sensor = term.channel.partition(".")[0]
    if term.covariate.startswith(EXTRA):
        return (
            "what warms, loads or supplies it",
            f"keep the vehicle at rest and change {_named(term.covariate)} alone",
        )
    if sensor in SENSOR_UNITS:
        return _SENSOR_CAUSES[_kind(term.covariate)]
    for forms, covariates, cause, trial in _CAUSES:
        if (forms is None or term.form in forms) and (
            covariates is None or term.covariate in covariates
        ):
            return cause, trial
    raise AssertionError


def sentences(term: Function) -> tuple[str, ...]:
    """What a person should look for: (sentence, ...)."""
    parts = list(dict.fromkeys(key.rpartition(".")[0] for key in term.values))
    if len(parts) > 3 or not parts:
        return ()
    cause, trial = causes(term)
    said = listed(described(term, part) for part in parts)
    return (f"Look for why {said}: {cause}. To tell: {trial}.",)


def _named(covariate: str) -> str:
    return covariate.removeprefix(EXTRA).replace("_", " ").replace(".", " ")


def _where(name: str, over: str, during: str) -> str:
    return during if name == "time" else f"where {name} is {over}"


def _kind(covariate: str) -> str:
    if covariate in ("time", "vibration"):
        return covariate
    if covariate.startswith("rate") or covariate == "turning_rate":
        return "turning"
    return "force" if covariate.startswith("accel") and covariate != "acceleration" else "motion"


def _off(term: Function, part: str, value: float, std: float | None, how: str) -> str:
    sensor, _, axis = term.channel.partition(".")
    if sensor in SENSOR_UNITS:
        amount = (
            f"{measured(abs(value), std, SENSOR_UNITS[sensor])} too "
            f"{'much' if value > 0.0 else 'little'}"
        )
        return AXES[sensor].format(amount, axis) + how
    amount = measured(abs(value), std, "m")
    if term.form in ("anchor", "arrival"):
        who = f"anchor {part}" if part else "each anchor"
        return f"{who} seems {amount} {'farther' if value > 0.0 else 'nearer'}{how}"
    subject = (
        f"the TDOA of {part}"
        if part
        else f"each value of {term.channel}"
        if sensor != "tdoa"
        else "every TDOA"
    )
    return f"{subject} is {amount} {'larger' if value > 0.0 else 'smaller'}{how}"
