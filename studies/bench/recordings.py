# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the time of a whole recording without ROS, s: filter, correction, smoother."""

from __future__ import annotations

from dataclasses import replace
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, TagLeverArm, samples_at
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.smoother import smooth

from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.correction.model import Network

SECONDS = 45.0
TARGET, TARGET_CORRECTED = 0.1, 0.2  # s for such a flight, without and with corrections
ANCHORS = (4, 16, 32, 64)
CORRECTION_TARGET = 12.0  # us, of one TDOA alone
BATCHES = (1, 4, 16)  # TDOAs that arrive together


def measure(
    progress: Callable[[str], object], quick: bool = False, model: str | Path | None = None
) -> Iterator[Figure]:
    """Generator of Figures; model : path of an ONNX network, whose figures come too.
    progress(text).
    """
    repeats = 2 if quick else 7
    flight = make_flight(SECONDS)
    section = f"recording of {SECONDS:g} s, 1 kHz IMU, 400 Hz TDOA"
    progress("recording, first call")
    name = "first call: compiled, or compiled code read from numba's cache"
    yield Figure.of(section, name, "s", _seconds(run_offline, flight))
    network = load_network(model)
    effects = EffectSet(
        (
            AnchorDelay(flight.meta["parameters"]["anchor_delays"]),
            TagLeverArm({"x": 0.01, "y": 0.0, "z": 0.05}),
        )
    )
    ways: dict[str, tuple[Callable[..., object], Corrector | None]] = {
        "no correction": (run_offline, None),
        "no correction, smoothed": (smooth, None),
        f"effects ({effects.name})": (run_offline, Corrector(flight.anchors, effects)),
    }
    if network is not None:
        alone = Corrector(flight.anchors, network=network)
        both = Corrector(flight.anchors, effects, network)
        ways[f"network ({network.name})"] = run_offline, alone
        ways[f"effects and network ({network.name})"] = run_offline, both
    for name, (function, corrector) in ways.items():
        progress(f"recording, {name}")
        # compiles, or loads, what the ways before it did not need
        function(flight, None, corrector)
        taken = [_seconds(function, flight, None, corrector) for _ in range(repeats)]
        target = TARGET if corrector is None else TARGET_CORRECTED
        yield Figure.of(section, name, "s", taken, None if function is smooth else target)
        if corrector is None and function is run_offline:
            yield Figure.of(
                section, "the same per second of flight", "ms/s", [1e3 * s / SECONDS for s in taken]
            )
    if network is not None:
        progress("single TDOAs")
        name = f"prediction by the network ({network.name}), 1 at a time"
        yield Figure.of(section, name, "us", _per_prediction(flight, network, repeats))
        for batch in BATCHES:
            name = f"correction of a TDOA by the network ({network.name}), {batch} at a time"
            corrector = Corrector(flight.anchors, network=network)
            taken = _per_tdoa(flight, corrector, batch, repeats)
            yield Figure.of(section, name, "us", taken, CORRECTION_TARGET if batch == 1 else None)
    for anchors in () if quick else ANCHORS:
        progress(f"recording, {anchors} anchors")
        flight = make_flight(SECONDS, anchors)
        yield Figure.of(
            section,
            f"no correction, {anchors} anchors",
            "s",
            [_seconds(run_offline, flight) for _ in range(repeats)],
        )


def _per_prediction(flight: Flight, network: Network, repeats: int) -> np.ndarray:
    """us per TDOA of a Flight that the network alone takes, one at a time: (repeats,)."""
    assert flight.truth is not None
    truth, tdoa = flight.truth, flight.tdoa
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    some = slice(400)
    samples = samples_at(tdoa.t[some], a[some], b[some], truth, flight.anchors, lag=None)
    alone = [
        replace(
            samples,
            **{name: getattr(samples, name)[k : k + 1] for name in ("t", "a", "b", "p", "q")},
        )
        for k in range(len(samples))
    ]

    def predict() -> None:
        for samples in alone:
            network.predict(samples)

    predict()
    return np.array([_seconds(predict) for _ in range(repeats)]) * 1e6 / len(alone)


def _per_tdoa(flight: Flight, corrector: Corrector, batch: int, repeats: int) -> np.ndarray:
    """us per TDOA of a Flight, corrected in batches of `batch`: (repeats,)."""
    assert flight.truth is not None
    truth, tdoa = flight.truth, flight.tdoa
    corrector.add_pose(truth.t, truth.p, truth.q)
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    parts = [slice(k, k + batch) for k in range(0, 400 * batch, batch) if k + batch <= len(tdoa)]

    def correct() -> None:
        for part in parts:
            corrector.correct(tdoa.t[part], a[part], b[part], tdoa.d[part])

    correct()
    return np.array([_seconds(correct) for _ in range(repeats)]) * 1e6 / (len(parts) * batch)


def _seconds(function: Callable[..., object], *arguments: Any) -> float:
    began = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - began
