"""Does a stream come at the times that it says? Against the ground truth, by what its geometry, or
its turns, leave.

Limits are shares of the power that is left with a fault undone; healthy: the least of 37 measured
recordings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.geometry import tdoa_jacobian
from uwb_tdoa_ekf.streams import ERROR, Finding

from .delays import of_tdoas

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .delays import Delays
    from .known_path import KnownPath

LATE, OF_ALL, DRIFTS, JUMPS = (
    0.53,
    0.965,
    0.99,
    0.985,
)  # healthy: a pair 0.557; all together 0.984, drifting 0.9953, jumping 0.993
LEAST = 0.1  # s that count
SHUFFLED, MORE = (
    0.15,
    2.2,
)  # s, and times the scatter of successive errors that there is in quick motion; healthy 0.09, 1.85
STEP_LIMIT = 4.0  # standard deviations, robust, beyond which an error counts no more
CLOCK = (
    "stamp with one clock, when it is measured; tdoa_time_offset and truth_time_offset take out "
    "what is constant"
)


def tdoas(path: KnownPath) -> Iterator[Finding]:
    """TDOAs that are late, of one pair or of all; whose stamps drift or jump; that come in another
    order.
    """
    of = of_tdoas(path)
    if of is None:
        return
    ratio, delay = of.constant()
    found = list(changing("tdoa", "TDOAs", of))
    if not found and ratio < OF_ALL and abs(delay) >= LEAST:
        found = [_late("tdoa_late", "the TDOAs are", ratio, delay)]
    if found:
        yield from found
        return
    for k, pair in enumerate(path.pairs):
        ratio, delay = of.of_series(k)
        if ratio < LATE and abs(delay) >= LEAST:
            yield _late(
                "pair_late", f"the TDOA of the pair ({pair[0]}, {pair[1]}) is", ratio, delay
            )
    yield from _reordered(path)


def _late(rule: str, who: str, ratio: float, delay: float) -> Finding:
    cause = f"{who} {abs(delay):.2f} s {'late' if delay > 0.0 else 'early'}"
    evidence = f"{100 * (1 - ratio):.0f} % less mean square error with the geometry of that time"
    return Finding(
        rule,
        ERROR,
        cause,
        evidence,
        "publish a TDOA when it is taken, stamped with that instant",
        delay,
    )


def changing(stream: str, name: str, of: Delays) -> Iterator[Finding]:
    """Stamps of a stream, "tdoa" or "imu", that drift or jump, by its Delays."""
    (drift, by), (jump, step, _) = of.drift(), of.jump()
    jumps = jump < JUMPS and abs(step) >= LEAST
    if (
        drift < DRIFTS and abs(by) >= LEAST and not (jumps and jump / JUMPS < drift / DRIFTS)
    ):  # a jump has a parameter more
        evidence = (
            f"{by:+.2f} s over the flight; {100 * (1 - drift):.0f} % less mean square error then"
        )
        yield Finding(
            f"{stream}_drift",
            ERROR,
            f"the stamps of the {name} drift against the ground truth",
            evidence,
            CLOCK,
            by,
        )
    elif jumps:
        evidence = f"{step:+.2f} s; {100 * (1 - jump):.0f} % less mean square error then"
        yield Finding(
            f"{stream}_jump",
            ERROR,
            f"the stamps of the {name} jump against the ground truth",
            evidence,
            CLOCK,
            step,
        )


def _reordered(path: KnownPath) -> Iterator[Finding]:
    """Errors of successive TDOAs of a pair differ by what the tag moves in the time by which they
    are out of place.
    """
    samples, error = path.samples, path.d - path.true
    change = np.sum(
        tdoa_jacobian(samples.p, samples.position_a, samples.position_b) * samples.velocity, axis=1
    )
    step = np.concatenate([np.diff(error[rows]) for rows in path.pairs.values()])
    speed = np.concatenate(
        [0.5 * np.abs(change[rows][1:] + change[rows][:-1]) for rows in path.pairs.values()]
    )
    limit = STEP_LIMIT * 1.4826 * np.median(np.abs(step))
    power, (slow, quick) = (
        np.clip(step, -limit, limit) ** 2,
        (speed <= np.median(speed), speed >= np.quantile(speed, 0.9)),
    )
    ratio = np.mean(power[quick]) / np.mean(power[slow])
    growth = (np.mean(power[quick]) - np.mean(power[slow])) / (
        np.mean(speed[quick] ** 2) - np.mean(speed[slow] ** 2)
    )
    scatter = np.sqrt(max(growth, 0.0) / 2.0)
    if ratio > MORE and scatter > SHUFFLED:
        evidence = (
            f"{ratio:.1f} times the mean square difference of successive errors in quick motion: "
            f"{scatter:.2f} s out of place"
        )
        cause = "TDOAs are stamped out of their order"
        yield Finding(
            "tdoa_reordered",
            ERROR,
            cause,
            evidence,
            "stamp a TDOA when it is taken, not when it is passed on",
            scatter,
        )
