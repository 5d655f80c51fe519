# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""UWB TDOA localization from Python, without ROS.

import uwb_tdoa as uwb
flight = uwb.read("flight.log", "anchors.yaml")
run = uwb.smooth(flight)
print(uwb.errors(flight, run).row()["rmse_3d"])
uwb.plot(flight, run).savefig("flight.png")

`__all__` lists the public names. docs/python.md says what a new version may change. Importing this
module is quick: a function imports what it needs when it is called.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.errors import InputError
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.correction.model import Model
    from uwb_tdoa_bias.effects import EFFECTS, ArrivalEffect, Effect, EffectSet, Row
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.monitoring.finding import Finding
    from uwb_tdoa_ekf.offline import Run
    from uwb_tdoa_tools.calibrating import Calibration
    from uwb_tdoa_tools.diagnosis import Diagnosis
    from uwb_tdoa_tools.diagnosis.self_calibration import Tape
    from uwb_tdoa_tools.scoring.metrics import Score

_PLACES = {  # where the public classes and registries are
    "Anchors": "uwb_tdoa_bias.common.anchors",
    "ArrivalEffect": "uwb_tdoa_bias.effects",
    "EFFECTS": "uwb_tdoa_bias.effects",
    "Effect": "uwb_tdoa_bias.effects",
    "EffectSet": "uwb_tdoa_bias.effects",
    "FilterConfig": "uwb_tdoa_ekf.core.config",
    "Flight": "uwb_tdoa_bias.common.flight",
    "InputError": "uwb_tdoa_bias.common.errors",
    "Row": "uwb_tdoa_bias.effects",
    "Run": "uwb_tdoa_ekf.offline",
    "Tape": "uwb_tdoa_tools.diagnosis.self_calibration",
}
__all__ = [
    "Anchors",
    "ArrivalEffect",
    "EFFECTS",
    "Effect",
    "EffectSet",
    "FilterConfig",
    "Flight",
    "InputError",
    "Row",
    "Run",
    "Tape",
    "calibrate",
    "check",
    "diagnose",
    "effect",
    "errors",
    "filter",
    "flight",
    "plot",
    "plot_errors",
    "read",
    "report",
    "simulate",
    "smooth",
    "table",
    "write",
]

Kind = TypeVar("Kind", bound="type[Effect]")


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from uwb_tdoa_bias.common.errors import version

        return version()
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module 'uwb_tdoa' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def read(
    path: str | Path,
    survey: str | Path | Anchors | None = None,
    *,
    namespace: str = "",
    topics: dict[str, str] | None = None,
    salvage: bool = False,
    profile: str | Path | None = None,
    tag: str = "",
) -> Flight:
    """Return the Flight of a recording: a micro-SD log, a UTIL CSV file, a ROS 2 bag, or by a profile.

    Parameters
    ----------
    survey : path or Anchors or None
        Positions of the anchors. A bag may hold its own.
    namespace : str
        Namespace of the topics in a bag.
    topics : dict or None
        {our topic: its name in a bag}, e.g. {"uwb/tdoa": "/my/tdoa"}.
    salvage : bool
        Read the intact part of a damaged recording; `meta["remarks"]` says what is missing.
    profile : str or path or None
        How to read a recording of another tool: the name of a shipped profile, or a YAML file
        (docs/recordings.md).
    tag : str
        Id of the tag, if such a recording has several.

    Raises
    ------
    InputError
        If the recording or the survey cannot be used. The message says what to do.
    """
    from uwb_tdoa_bias.common.errors import InputError
    from uwb_tdoa_tools.readers.inputs import Reading
    from uwb_tdoa_tools.readers.profile import load_profile

    if tag and profile is None:
        raise InputError("tag: chooses a tag of a recording that is read by a profile.")
    loaded = None if profile is None else load_profile(profile)
    reading = Reading(
        namespace=namespace, topics=topics or {}, salvage=salvage, profile=loaded, tag=tag
    )
    return reading.flight([path], survey)


def flight(
    anchors: Anchors | str | Path | Mapping[Any, Any],
    *,
    units: Mapping[str, Any] | None = None,
    name: str = "flight",
    **tables: Any,
) -> Flight:
    """Return a Flight of arrays, lists or data frames.

    flight = uwb.flight(
        {0: (0.0, 0.0, 0.3), 1: (7.0, 0.0, 2.8), ...},
        tdoa={"time": t, "anchor_a": a, "anchor_b": b, "tdoa": d},
        imu={"time": t_imu, "gyro": gyro, "accel": accel},
        units={"time": "ms", "gyro": "deg/s"},
    )

    Parameters
    ----------
    anchors : Anchors, path of a survey, or {id or name: (x, y, z) in m}
    units : {column: unit}, or {table: {column: unit}}
        Default: s, m, rad/s, m/s^2.
    tables : {column: (n,) values} or DataFrame
        One for each set of sensors, under any name, e.g. tdoa, imu, truth. docs/csv.md lists the
        columns. "gyro", "accel" and "pose" may be (n, 3), "pose_q" (n, 4) x y z w.

    Raises
    ------
    InputError
        If a column or a unit is unknown or missing, or values are no numbers or of other lengths.
    """
    from uwb_tdoa_tools.readers.by_profile import flight_of_arrays

    return flight_of_arrays(anchors, tables, units, name)


def write(flight: Flight, path: str | Path, *, force: bool = False) -> None:
    """Write a Flight as a ROS 2 bag, a folder. `force` replaces an existing bag."""
    from uwb_tdoa_tools.bags.bag import write_bag

    write_bag(flight, path, force=force)


def simulate(vehicle: str = "quadrotor", **settings: Any) -> Flight:
    """Return a simulated Flight with ground truth.

    Parameters
    ----------
    vehicle : str
        "quadrotor", "rover" or "hand".
    settings
        Fields of `uwb_tdoa_tools.simulation.SimulationConfig`, e.g. duration=30.0, seed=3.
    """
    from uwb_tdoa_tools.simulation import SimulationConfig, simulate as run

    return run(SimulationConfig.of(vehicle, **settings))


def check(flight: Flight) -> list[Finding]:
    """Return the Findings on a recording, most severe first: mistakes of a driver, survey or clock.

    Each has `severity`, `cause`, `evidence` and `remedy`.
    """
    from uwb_tdoa_tools.checking.check import check as run
    from uwb_tdoa_tools.checking.recording import of_flight

    return list(run(of_flight(flight)).findings)


def filter(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    model: Model | str | Path | None = None,
) -> Run:
    """Run bias correction and filter on a Flight, as the nodes do, and return the Run.

    The ground truth is not used.

    Parameters
    ----------
    effects : EffectSet or None
        Systematic effects to correct, e.g. EffectSet.from_yaml("effects.yaml").
    config : FilterConfig or None
        Parameters of the filter; None for the defaults.
    model : Model or path or None
        ONNX file of `train` or `export` to correct TDOAs with.
    """
    return _estimate(flight, effects, config, model, False)


def smooth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    model: Model | str | Path | None = None,
) -> Run:
    """Run bias correction, filter and smoother on a Flight: each estimate uses all measurements.

    The parameters are those of `filter`.
    """
    return _estimate(flight, effects, config, model, True)


def _estimate(
    flight: Flight,
    effects: EffectSet | None,
    config: FilterConfig | None,
    model: Model | str | Path | None,
    smoothed: bool,
) -> Run:
    from uwb_tdoa_bias.correction.model import Model, load_network
    from uwb_tdoa_tools.estimate import FlightEstimator

    network = model if model is None or isinstance(model, Model) else load_network(model)
    return FlightEstimator(config, effects, network, smoothed)(flight)


def errors(flight: Flight, run: Run, effects: EffectSet | None = None) -> Score:
    """Return the errors of a Run against the ground truth of its Flight.

    `row()` of the result is a dict of figures, as `evaluate` prints them. `t` (n,) s and `error`
    (n, 3) m are the errors in the air.

    Parameters
    ----------
    effects : EffectSet or None
        Those of the Run: an effect on the ground truth is corrected here.
    """
    from uwb_tdoa_tools.scoring.evaluation import corrected_truth, require_truth
    from uwb_tdoa_tools.scoring.metrics import Score, radio_residuals

    require_truth(flight)
    truth, residuals = corrected_truth(flight, effects), radio_residuals(flight, run)
    return Score(flight.name, run.odometry, truth, residuals, flight.tdoa.t)


def diagnose(
    flights: Sequence[Flight],
    holdout: Sequence[Flight] = (),
    *,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    reference: str = "truth",
) -> Diagnosis:
    """Find systematic effects in Flights, validate them, and return the Diagnosis.

    `effects` of the result is an EffectSet for `filter`. `report` makes a page of it.

    Parameters
    ----------
    holdout : sequence of Flight
        Flights for validation only.
    effects : EffectSet or None
        Effects that are in the model already.
    reference : str
        What the Flights are compared with: "truth", "heights" of a range finder, or "nothing".
    """
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_tools.diagnosis import diagnose as run, with_noise
    from uwb_tdoa_tools.diagnosis.references import REFERENCES

    compared = REFERENCES[reference](config, ())
    found = run(list(flights), list(holdout), effects or EffectSet(), config, compared)
    return with_noise(found, config)


def report(diagnosis: Diagnosis) -> str:
    """Return the report of a Diagnosis as one HTML page without external files."""
    from uwb_tdoa_tools.diagnosis.report.page import html

    return html(diagnosis)


def calibrate(
    flights: Sequence[Flight],
    holdout: Sequence[Flight] = (),
    *,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    truth: bool | None = None,
    tape: Tape | None = None,
) -> Calibration:
    """Calibrate a tag and its anchors from Flights, and validate that on `holdout`.

    Without `holdout` parts of the Flights validate it. Use `anchors` and `effects` of the result only
    if `why_not` is None: else it says why.

    Parameters
    ----------
    effects : EffectSet or None
        Effects that are in the model already.
    truth : bool or None
        Whether to use the ground truth; None: if every Flight has one.
    tape : Tape or None
        How well the anchors are known, without ground truth.
    """
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_tools.calibrating import with_truth, without_truth
    from uwb_tdoa_tools.diagnosis.self_calibration import Tape

    base, fitted, judges = effects or EffectSet(), list(flights), list(holdout)
    if truth is None:
        truth = all(flight.truth is not None for flight in fitted + judges)
    if truth:
        return with_truth(fitted, judges, base, config)
    return without_truth(fitted, judges, tape or Tape(), base, config)


def effect(kind: Kind) -> Kind:
    """Make an effect of your own known to `diagnose`, `inject` and effects.yaml; a class decorator.

    `kind` is a subclass of Effect with a `row`. docs/add_effect.md says what a kind of effect needs, and
    examples/own_effect.py shows one. A class of the same module and name is replaced, as when a cell
    of a notebook runs again.

    Raises
    ------
    ValueError
        If the class has no row, or another effect has its name.
    """
    from uwb_tdoa_bias.effects import EFFECTS

    name = getattr(kind, "name", None)
    if name is None:
        raise ValueError(f"{kind.__name__}: has no `row`; set one: row = Row(name=..., ...).")
    known = EFFECTS.get(name, kind)
    if (known.__module__, known.__qualname__) != (kind.__module__, kind.__qualname__):
        raise ValueError(f"{name}: an effect of that name exists; choose another name.")
    EFFECTS[name] = kind
    return kind


def table(part: Any) -> Any:
    """Return a table: a pandas DataFrame where pandas is installed, else a structured array.

    Parameters
    ----------
    part : Run, or a record of arrays
        Of a Run, its estimates with standard deviations, with the columns of `localize`. Of a stream
        of a Flight, or of the residuals of a Run, its arrays; a vector gets a column for each axis.
    """
    from uwb_tdoa_tools.tables import as_table, columns_of

    return as_table(columns_of(part))


def plot(flight: Flight, run: Run) -> Figure:
    """Return a matplotlib Figure of a Run: path and anchors from above and the side, and over time."""
    from uwb_tdoa_tools.localizing.localize import lost_spans
    from uwb_tdoa_tools.localizing.pictures import estimate_figure
    from uwb_tdoa_tools.scoring.metrics import radio_residuals

    lost = lost_spans(radio_residuals(flight, run).t, run.odometry)
    return estimate_figure(run.odometry, flight.anchors, lost, flight.name)


def plot_errors(flight: Flight, run: Run, effects: EffectSet | None = None) -> Figure:
    """Return a matplotlib Figure of the errors of a Run against the ground truth, over time."""
    from uwb_tdoa_tools.scoring.evaluation import corrected_truth
    from uwb_tdoa_tools.scoring.plots import error_figure

    score = errors(flight, run, effects)
    return error_figure(score, run.odometry, corrected_truth(flight, effects))
