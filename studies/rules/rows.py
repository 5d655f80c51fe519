# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the filter, and how its output is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
import math
from pathlib import Path
import pickle
from typing import Any

import halls
import numpy as np
import rovers
from scipy.spatial.transform import Rotation

from studies import ranges, rover, situations
from studies.faults.flown import FAULTS as FLOWN
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Imu
from uwb_tdoa_bias.common.sensors import SENSORS, Height
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.world import world_of
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.metrics import READY, Score
from uwb_tdoa_tools.scoring.phases import phases
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.rooms import corners

SHORT = 40.0  # s of a long recording, in the screen
LONG = 90.0  # s of a long recording whose residuals are watched
BEGIN, END, CUT = 12.0, 15.0, 22.0  # s: a fault begins and ends, the recording is cut
FLOWN_SEED = 5001
SCREENED = (  # recordings of the screen, each of another constellation, or day
    "0422-log02",
    "0425-traj13",
    "0426-traj1",
    "tdoa2-obs-log1",
    "const1-trial2-tdoa2",
    "const4-trial1-tdoa2-traj1",
)
WORLDS = "hall", "person", "rectifying", "outliers", "anchor-late", "silence-3s", "table"
SCREENED_FLIGHTS = {"hall": 2, "person": 1}
FIRST_SEED = 9301  # of flights of `fly`


@dataclass(frozen=True)
class Case:
    """One run.

    spans : {name: (begin, end) s} to judge
    over : s from which the time to be right again counts, or None
    arm : m, lever arm of the tag, which is corrected
    effects : known effects
    """

    flight: Flight
    spans: dict[str, tuple[float, float]]
    over: float | None = None
    config: dict[str, Any] = field(default_factory=dict)
    arm: tuple[float, ...] = ()
    effects: EffectSet = EffectSet()


@dataclass(frozen=True)
class Row:
    """One row of the study.

    group : "measured", "flown", "starts", "halls", "faults" or "sensors"
    needs : sensors of the row. The rules of a sensor run only on rows that have this sensor.
    screen : whether it is in the screen
    """

    name: str
    group: str
    make: Callable[[], Case]
    screen: bool = False
    needs: tuple[str, ...] = ()


def judged(case: Case) -> dict[str, list[float | None]]:
    """{span: [3D RMSE m, NEES, s without an estimate, RMSE of the yaw, rad]}, and {"again": [s]}."""
    effects = case.effects
    if case.arm:
        effects = EffectSet((EFFECTS["tag_lever_arm"](dict(zip("xyz", case.arm))),))
    flight = case.flight
    corrector = Corrector(flight.anchors, effects)
    odometry = run_offline(flight, FilterConfig(**case.config), corrector).odometry
    series = Score(flight.name, odometry, flight.truth).series
    out = {}
    for name, (begin, end) in case.spans.items():
        of = series.figures(begin, end)
        figures = [of["rmse_3d"], of["nees_mean"], of["without_estimate"]]
        out[name] = [*map(_finite, figures), _finite(_yaw_error(odometry, flight, begin, end))]
    if case.over is not None:
        out["again"] = [situations.again(series, case.over)]
    return out


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _yaw_error(odometry: Any, flight: Flight, begin: float, end: float) -> float:
    kept = (odometry.t >= begin) & (odometry.t <= end)
    if not kept.any():
        return math.nan
    true = np.interp(odometry.t[kept], flight.truth.t, np.unwrap(rover.yaw_of(flight.truth.q)))
    off = (rover.yaw_of(odometry.q[kept]) - true + math.pi) % (2.0 * math.pi) - math.pi
    return float(np.sqrt(np.mean(off**2)))


class Inputs:
    """Cases, made once and kept in a folder."""

    def __init__(self, data: Path, cache: Path) -> None:
        """data : folder of measured flights; cache : folder."""
        self._data, self._cache = data, cache / "inputs"
        self.anew = False  # count streams again, because constants of their counters have changed
        self._cache.mkdir(parents=True, exist_ok=True)
        self._kept: dict[str, Any] = {}

    def case(self, row: Row) -> Case:
        """The Case of a Row."""
        return self.kept(row.name, row.make)

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        """make(), from the folder if it is there. Only this study writes and reads that folder."""
        if self.anew and name.startswith("seen "):
            return make()
        if name in self._kept:
            return self._kept[name]
        path = self._cache / f"{name.replace('/', ' ')}.pickle"
        if path.exists():
            made = pickle.loads(path.read_bytes())
        else:
            made = make()
            write_bytes(path, pickle.dumps(made))
        self._kept[name] = made
        return made

    def rows(self) -> list[Row]:
        """All rows. The rows of the screen come first."""
        made = [
            *self._measured(),
            *self._flown(),
            *self._starts(),
            *self._faults(),
            *self._sensors(),
            *_halls(),
            *_rovers(),
        ]
        order = "starts", "halls", "faults", "measured", "sensors", "flown"
        return sorted(made, key=lambda row: (not row.screen, order.index(row.group)))

    def _measured(self) -> Iterator[Row]:
        paths = sorted((self._data / "flights").glob("*/*")) + sorted(
            (self._data / "flights").glob("*/*/*")
        )
        paths = [path for path in paths if not path.is_dir()]
        for path in [*paths, *sorted((self._data / "util").glob("*.csv.gz"))]:
            name = path.name.removesuffix(".csv.gz")
            make = partial(self._recording, path)
            long = path.suffix == ".gz"
            yield Row(name, "measured", make, name in SCREENED and not long)
            if long and name in SCREENED:
                make = partial(self._recording, path, until=SHORT)
                yield Row(f"{name}, {SHORT:g} s", "measured", make, True)

    def _recording(self, path: Path, sensors: bool = False, until: float = math.inf) -> Case:
        (flight,) = Reading(self._data / "surveys").flights([path])
        flight = _cut(flight if sensors else flight.without(*SENSOR_NAMES), -math.inf, until)
        return Case(flight, phases(flight.truth))

    def recording(self, name: str) -> Case:
        """A measured flight by its name, with all its streams."""
        return self.kept(f"{name} whole", lambda: self._recording(self._path(name), sensors=True))

    def measured(self) -> list[str]:
        """Names of the measured flights that are kept as logs."""
        return sorted(one.name for one in (self._data / "flights").rglob("*") if one.is_file())

    def long_recording(self, name: str) -> Case:
        """The first LONG s of a recording of `util`."""
        path = self._data / "util" / f"{name}.csv.gz"
        return self.kept(f"{name} first", lambda: self._recording(path, until=LONG))

    def _path(self, name: str) -> Path:
        return next((self._data / "flights").rglob(name))

    def flight_of(self, world: str, seed: int) -> Flight:
        """A flight of `fly` in a world, with TDOAs and IMU; "sensors": the hall, with more sensors."""
        sensors = ("height", "velocity") if world == "sensors" else ()
        task = Task(world_of("hall" if world == "sensors" else world, sensors=sensors), seed)
        return self.kept(f"flown {world} {seed}", lambda: fly(task).flight)

    def _flown(self) -> Iterator[Row]:
        for world in WORLDS:
            for k in range(3):
                seed = FIRST_SEED + k
                screen = k < SCREENED_FLIGHTS.get(world, 0)
                make = partial(self._of_world, world, seed)
                yield Row(f"fly {world} {seed}", "flown", make, screen)

    def _of_world(self, world: str, seed: int) -> Case:
        flight = self.flight_of(world, seed)
        return Case(_thinned(flight), phases(flight.truth))

    def _starts(self) -> Iterator[Row]:
        chosen = {"start in the air", "start moving, 2 m/s", "start on a table"}
        chosen |= {
            "on the floor, low anchors 3.2 m late",
            "lift-off, 3 s",
            "all anchors in a plane",
        }
        chosen |= {
            "landing, low anchors 3.2 m late on the floor",
            "outside, 3 m beyond the workspace",
        }
        chosen |= {
            "5 s without TDOAs",
            "5 s without both",
            "at rest, TDOAs for 1 s, then none for 10 s",
        }
        for one in situations.SITUATIONS:
            for seed in range(3):
                make = partial(_situation, one, seed)
                screen = one.name in chosen and seed == 0
                yield Row(f"{one.name}, seed {seed}", "starts", make, screen)
        for name in ("0425-traj2", "0426-traj9"):
            for share in (10, 40):
                make = partial(self._few, name, share)
                yield Row(f"{name}, one TDOA in {share}", "starts", make, share == 40)
            make = partial(self._with_outliers, name)
            yield Row(f"{name}, outliers of 2 to 6 m", "starts", make)
            yield Row(f"{name} from the air", "starts", partial(self._from_the_air, name), True)
            yield Row(f"{name}, wrong yaw", "starts", partial(self._wrong_yaw, name), True)
        for name in ("0425-traj2", "0426-traj9", "0422-log02", "0426-traj1"):
            for degrees in (60, 180):
                make = partial(self._wrong_yaw, name, degrees)
                yield Row(f"{name}, yaw wrong by {degrees} degrees", "starts", make)
        for seed in range(3):
            for what in KNOWN_FLOORS:
                make = partial(_known_floor, what, seed)
                name = f"floor delays are known, {what}, seed {seed}"
                yield Row(name, "starts", make)
            for late in (False, True):
                words = ", low anchors 3.2 m late" if late else ""
                make = partial(_silent_lift_off, seed, late)
                yield Row(f"lift-off in a silence{words}, seed {seed}", "starts", make)
            make = partial(_landing_after, seed, "imu: in degrees/s")
            yield Row(f"landing after a gyroscope in degrees/s, seed {seed}", "faults", make)
            make = partial(_landing_after, seed, "imu: in g")
            yield Row(f"landing after an accelerometer in g, seed {seed}", "faults", make)
        hall = partial(_simulated, constellation="hall", radio_reach=15.0, duration=30.0)
        yield Row("a hall", "starts", hall, True)
        yield Row("40 s without both", "starts", _long_gap, False)
        yield Row("45 s without TDOAs", "starts", _long_silence, False)
        yield Row("the IMU comes after 8 s", "starts", _late_imu, True)
        for turn, angles in TURNS.items():
            make = partial(_late_imu, angles)
            yield Row(f"the IMU comes after 8 s, {turn}", "faults", make, False)

    def _few(self, name: str, share: int) -> Case:
        case = self._recording(self._path(name))
        flight = case.flight
        tdoa = rows_of(flight.tdoa, slice(None, None, share))
        return replace(case, flight=replace(flight, tdoa=tdoa))

    def _with_outliers(self, name: str) -> Case:
        case, rng = self._recording(self._path(name)), np.random.default_rng(0)
        tdoa = case.flight.tdoa
        n = len(tdoa)
        size = rng.uniform(2.0, 6.0, n) * rng.choice([-1.0, 1.0], n)
        tdoa = replace(tdoa, d=tdoa.d + np.where(rng.random(n) < 0.1, size, 0.0))
        return replace(case, flight=replace(case.flight, tdoa=tdoa))

    def _from_the_air(self, name: str) -> Case:
        flight = self._recording(self._path(name)).flight
        begin = phases(flight.truth)["in_the_air"][0] + 5.0
        flight = _cut(flight, begin, begin + 12.0)
        spans = {"first 3 s": (begin, begin + 3.0), "then": (begin + 3.0, begin + 12.0)}
        return Case(flight, spans, flight.tdoa.t[READY - 1])

    def _wrong_yaw(self, name: str, degrees: float = 90.0) -> Case:
        case = self._recording(self._path(name))
        begin, end = case.spans["in_the_air"]
        middle = 0.5 * (begin + end)
        config = {"initial_yaw": math.radians(degrees), "initial_yaw_std": 0.1}
        return replace(case, spans={"first": (begin, middle), "then": (middle, end)}, config=config)

    def _faults(self) -> Iterator[Row]:
        screen = {"tdoa: silent, 1 s", "tdoa: sign", "tdoa: half are outliers", "imu: in g"}
        screen |= {"tdoa: an anchor 1 m late", "tdoa: two low anchors 1.5 m late", "imu: silent"}
        screen |= {"imu: gyroscope 0.5 rad/s off", "imu: upside down", "imu: in degrees/s"}
        for name, change in VALUES.items():
            make = partial(self.faulty, change, name.split(":")[0])
            yield Row(name, "faults", make, name in screen)

    def faulty(self, change: Callable[[Any], Any], stream: str) -> Case:
        """A flight of `fly` with a change of a stream, beginning in flight."""
        flight = _cut(self.flight_of("hall", FIRST_SEED), -math.inf, CUT)
        flight = _during(flight, stream, change)
        return Case(flight, {"during": (BEGIN, END), "after": (END, CUT)}, END)

    def _sensors(self) -> Iterator[Row]:
        for name in ("0425-traj2", "0425-traj13"):
            make = partial(self._recording, self._path(name), sensors=True)
            yield Row(
                f"{name}, all sensors", "sensors", make, True, ("height", "pressure", "velocity")
            )
        for name, fault in FLOWN.items():
            stream = fault.stream
            if stream in SENSORS and "ahead" not in name:
                make = partial(self._faulty_sensor, stream, fault.change)
                yield Row(f"fly, {name}", "sensors", make, True, (stream,))
        for name, (stream, change) in OF_A_SENSOR.items():
            make = partial(self._faulty_sensor, stream, change)
            yield Row(f"fly, {name}", "sensors", make, False, (stream,))
        for name, (stream, change) in OF_A_SENSOR.items():
            for seed in range(2):
                make = partial(self._wrong_until_landed, stream, change, FIRST_SEED + seed)
                words = f"fly, {name}, until it has landed, seed {seed}"
                yield Row(words, "sensors", make, False, (stream,))
        for silent in (False, True):
            for seed in range(2):
                words = ", range finder silent for 2 s" if silent else ""
                make = partial(self._over_a_table, FIRST_SEED + seed, silent)
                name = f"over a table{words}, seed {seed}"
                yield Row(name, "sensors", make, False, ("height",))
        for room in ("ceiling, 4", "ceiling, 8"):
            for seed in range(SEEDS):
                make = partial(_with_range_finder, room, seed)
                yield Row(f"{room}, range finder, seed {seed}", "sensors", make, False, ("height",))
        for what in ("ranges", "both"):
            for seed in range(3):
                make = partial(_ranged, what, twice=True, seed=seed)
                name = f"each range twice, {what}, seed {seed}"
                yield Row(name, "sensors", make, False, ("range",))
        make = partial(self._at_fixed_height)
        yield Row("flying, with a fixed height", "sensors", make, False, ("plane",))
        for name, (streams, config, late) in rover.ROWS.items():
            for seed in range(SEEDS):
                make = partial(_driven, seed, streams, config, late)
                yield Row(
                    f"rover, {name}, seed {seed}", "sensors", make, seed == 0, ("velocity", "plane")
                )
        for what in ("ranges", "both"):
            yield Row(f"{what} of ranges", "sensors", partial(_ranged, what), True, ("range",))
        for name in ranges.FAULTS:
            make = partial(_ranged, "both", name)
            yield Row(f"ranges {name}", "sensors", make, False, ("range",))

    def _at_fixed_height(self) -> Case:
        case = self._recording(self._path("0426-traj1"))
        return replace(case, config={"fixed_height_std": 0.02})

    def _over_a_table(self, seed: int, silent: bool) -> Case:
        """A flight from a table over the floor, with a range finder."""
        flight = fly_with(world_of("table", sensors=("height",)), seed, self)
        begin, end = phases(flight.truth)["in_the_air"]
        if silent:
            middle = 0.5 * (begin + end)
            t = flight.height.t
            kept = (t < middle) | (t > middle + 2.0)
            flight = replace(flight, height=rows_of(flight.height, kept))
        return Case(_thinned(flight), phases(flight.truth))

    def _wrong_until_landed(self, stream: str, change: Callable, seed: int) -> Case:
        flight = self.flight_of("sensors", seed)
        begin, end = phases(flight.truth)["in_the_air"]
        part = getattr(flight, stream)
        middle = 0.5 * (begin + end)
        pieces = rows_of(part, part.t < middle), change(rows_of(part, part.t >= middle))
        joined = type(part)(*map(np.concatenate, zip(*(vars(one).values() for one in pieces))))
        spans = {"in the air": (middle, end), "then": (end, float(flight.truth.t[-1]))}
        return Case(_thinned(replace(flight, **{stream: joined})), spans)

    def _faulty_sensor(self, stream: str, change: Callable[[Any], Any]) -> Case:
        flight = _cut(self.flight_of("sensors", FIRST_SEED), -math.inf, CUT)
        flight = _during(flight, stream, change)
        return Case(flight, {"during": (BEGIN, END), "after": (END, CUT)}, END)


def fly_with(world: Any, seed: int, inputs: Inputs) -> Flight:
    """A flight of `fly` in a World with a range finder."""
    return inputs.kept(f"flown table height {seed}", lambda: fly(Task(world, seed)).flight)


def _frozen(part: Any, name: str) -> Any:
    column = getattr(part, name)
    return replace(part, **{name: np.broadcast_to(column[:1], column.shape).copy()})


# Faults of sensors that fly-faults does not have
OF_A_SENSOR: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "height: frozen": ("height", lambda part: _frozen(part, "range")),
    "velocity: frozen": ("velocity", lambda part: _frozen(part, "v")),
    "velocity: twice as fast": ("velocity", lambda part: replace(part, v=2.0 * part.v)),
    "velocity: 1 m/s to the side": ("velocity", lambda part: replace(part, v=part.v + [0, 1, 0])),
    "velocity: 0.2 m/s to the side": (
        "velocity",
        lambda part: replace(part, v=part.v + [0, 0.2, 0]),
    ),
    "velocity: 0.1 m/s to the side": (
        "velocity",
        lambda part: replace(part, v=part.v + [0, 0.1, 0]),
    ),
    "velocity: a fifth too fast": ("velocity", lambda part: replace(part, v=1.2 * part.v)),
}


def _turned(part: Imu, R: np.ndarray) -> Imu:
    return replace(part, gyro=part.gyro @ R.T, accel=part.accel @ R.T)


_Y_AND_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# Faults of values: what they change of a stream. Those of stamps are not the core's
VALUES: dict[str, Callable[[Any], Any]] = {
    name: fault.change
    for name, fault in FLOWN.items()
    if fault.stream in ("tdoa", "imu") and not fault.once and "stamps" not in name
} | {
    "imu: upside down": lambda part: _turned(part, np.diag([1.0, -1.0, -1.0])),
    "imu: y and z exchanged": lambda part: _turned(part, _Y_AND_Z),
    "imu: in degrees/s": lambda part: replace(part, gyro=np.degrees(part.gyro)),
    "imu: frozen": lambda part: replace(
        part,
        gyro=np.broadcast_to(part.gyro[:1], part.gyro.shape),
        accel=np.broadcast_to(part.accel[:1], part.accel.shape),
    ),
}


def _between(part: Any, begin: float, end: float) -> Any:
    return rows_of(part, (part.t >= begin) & (part.t < end))


def _cut(flight: Flight, begin: float, end: float) -> Flight:
    names = ("tdoa", "imu", "truth", *SENSORS)
    parts = {name: getattr(flight, name) for name in names}
    return replace(
        flight,
        **{name: _between(part, begin, end) for name, part in parts.items() if part is not None},
    )


def _thinned(flight: Flight) -> Flight:
    """With every fourth pose of the truth, which comes with each inertial sample."""
    return replace(flight, truth=rows_of(flight.truth, slice(None, None, 4)))


def _during(flight: Flight, stream: str, change: Callable[[Any], Any]) -> Flight:
    """With a change of a stream from BEGIN to END."""
    part = getattr(flight, stream)
    t = part.t
    changed = change(rows_of(part, (t >= BEGIN) & (t < END)))
    pieces = rows_of(part, t < BEGIN), changed, rows_of(part, t >= END)
    columns = zip(*(vars(piece).values() for piece in pieces))
    joined = type(part)(*map(np.concatenate, columns))
    joined = rows_of(joined, np.argsort(joined.t, kind="stable"))
    return _thinned(replace(flight, **{stream: joined}))


def _situation(one: Any, seed: int) -> Case:
    common = {
        "seed": seed,
        "imu_rate": 500.0,
        "truth_rate": 100.0,
        "protocol": "tdoa2" if seed % 2 else "tdoa3",
        "anchors": corners(),
    }
    flight = one.make(np.random.default_rng([seed, 28]), common)
    over = flight.tdoa.t[READY - 1] if one.over is None else one.over
    return Case(flight, {"judged": one.judged}, over, one.config)


def _simulated(**config: Any) -> Case:
    flight = simulate(SimulationConfig(imu_rate=500.0, truth_rate=100.0, **config))
    return Case(flight, phases(flight.truth))


def _gap(streams: tuple[str, ...], begin: float, end: float, until: float) -> Case:
    make = partial(situations._flying, until)
    made = partial(situations._without, streams, begin, end, make)
    return _situation(situations.Situation("", made, (max(begin, 2.0), until), end), 0)


def _long_gap() -> Case:
    return _gap(("tdoa", "imu"), 15.0, 55.0, 65.0)


def _long_silence() -> Case:
    return _gap(("tdoa",), 15.0, 60.0, 70.0)


# Situations in which low anchors are late on the floor, as a calibration knows
KNOWN_FLOORS = {
    "landing": "landing, low anchors 3.2 m late on the floor",
    "lift-off": "lift-off, low anchors 3.2 m late on the floor",
    "at rest": "on the floor, low anchors 3.2 m late",
}


def _known_floor(what: str, seed: int) -> Case:
    (one,) = [one for one in situations.SITUATIONS if one.name == KNOWN_FLOORS[what]]
    case = _situation(one, seed)
    anchors = case.flight.anchors
    low = anchors.ids[anchors.positions[:, 2] < situations.LOW]
    values = {f"{number}.delay": situations.LATE for number in low}
    values |= dict(zip("xy", case.flight.truth.p[-1, :2].tolist()))
    return replace(case, effects=EffectSet((EFFECTS["floor_multipath"](values),)))


def _silent_lift_off(seed: int, late: bool) -> Case:
    """It lifts off at 4 s; no TDOAs from 3 to 8 s."""
    make = partial(situations._low_late, situations._hop) if late else situations._hop
    made = partial(situations._without, ("tdoa",), 3.0, 8.0, make)
    return _situation(situations.Situation("", made, (4.0, 11.0), 8.0), seed)


def _landing_after(seed: int, fault: str) -> Case:
    """The inertial sensor is wrong from 6 to 13 s; the tag lands at 14 s."""
    case = _situation(situations.Situation("", situations._hop, (11.0, 18.0), 14.0), seed)
    imu = case.flight.imu
    wrong = (imu.t >= 6.0) & (imu.t < 13.0)
    changed = VALUES[fault](imu)
    gyro = np.where(wrong[:, None], changed.gyro, imu.gyro)
    accel = np.where(wrong[:, None], changed.accel, imu.accel)
    return replace(case, flight=replace(case.flight, imu=replace(imu, gyro=gyro, accel=accel)))


def _late_imu(turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Case:
    case = _gap(("imu",), -1.0, 8.0, 20.0)
    imu = _turned(case.flight.imu, Rotation.from_rotvec(turn).as_matrix())
    return replace(case, flight=replace(case.flight, imu=imu), spans={"judged": (8.0, 20.0)})


TURNS = {"on its side": (1.5, 0.0, 0.0), "upside down": (2.7, 0.4, 1.0)}  # rotation vectors
SEEDS = 6  # of what is short
HALL = "100 x 60 m, 77 anchors"


def _halls() -> Iterator[Row]:
    for seed in range(SEEDS):
        yield Row(f"{HALL}, seed {seed}", "halls", partial(_in_hall, HALL, seed, 20.0))
        for blinks in (0.5, 2.0):
            make = partial(_in_room, "corners", seed, 12.0, blinks=blinks, speed=1.0)
            yield Row(f"{blinks:g} blinks a second, seed {seed}", "halls", make)
        for rate in (2.0, 10.0):
            make = partial(_in_room, "corners", seed, 20.0, rate=rate, speed=1.0)
            yield Row(f"{rate:g} TDOAs a second, seed {seed}", "halls", make)
        for room in ("ceiling, 4", "ceiling, 8", "wall, 8", "line, 5"):
            make = partial(_in_room, room, seed, 12.0, speed=1.0)
            yield Row(f"{room}, seed {seed}", "halls", make)
    for seed in (3, 4, 15, 18):
        for imu in (True, False):
            make = partial(_in_hall, HALL, seed, 20.0, imu, dead=[(3.0, 16.3)])
            words = "" if imu else ", no IMU"
            yield Row(f"{HALL}, silent from 3 to 16.3 s, seed {seed}{words}", "halls", make)
    for seed in range(2):
        make = partial(_in_room, "corners", seed, 40.0, rate=5.0, dead=[(10.0, 25.0)])
        yield Row(f"5 TDOAs a second, silent for 15 s, seed {seed}", "halls", make)
    for seed in range(3):
        for room in ("ceiling, 8", "wall, 8"):
            make = partial(_in_room, room, seed, 25.0, speed=1.0, dead=[(6.0, 16.0)])
            yield Row(f"{room}, silent for 10 s, seed {seed}", "halls", make)
    for name in (HALL, "200 x 100 m, 231 anchors", "300 x 200 m, 988 anchors"):
        for seed in range(10, 18):
            yield Row(
                f"{name}, first 4 s, seed {seed}", "halls", partial(_in_hall, name, seed, 4.0)
            )
    for seed in range(SEEDS):
        yield Row(f"long wall, seed {seed}", "halls", partial(_at_a_long_wall, seed))
        yield Row(f"100 x 60 m, 8 anchors, seed {seed}", "halls", partial(_among_few, seed))
    for seed in range(3):
        make = partial(_in_hall, HALL, seed, 60.0, rate=5.0)
        yield Row(f"{HALL}, 5 TDOAs a second, seed {seed}", "halls", make)
    make = partial(_in_hall, HALL, 0, 120.0, dead=[(90.0, 103.3)])
    yield Row(f"{HALL}, silent after 90 s", "halls", make)
    make = partial(_in_hall, "300 x 200 m, 294 anchors", 0, 20.0)
    yield Row("300 x 200 m, 294 anchors", "halls", make)
    make = partial(_in_hall, HALL, 0, 60.0, floors=2, lift=20.0)
    yield Row(f"{HALL}, carried one floor up", "halls", make)


def _in_hall(
    name: str, seed: int, duration: float, imu: bool = True, floors: int = 1, **more: Any
) -> Case:
    return _walked(halls.hall(name, floors), seed, duration, imu, more)


def _in_room(name: str, seed: int, duration: float, **more: Any) -> Case:
    return _walked(halls.room(name), seed, duration, True, more)


def _at_a_long_wall(seed: int) -> Case:
    """Ten anchors on a wall of 32 m, a tag up to 14 m away."""
    positions = np.array([(0.0, y, z) for y in (0.0, 8.0, 16.0, 24.0, 32.0) for z in (0.5, 4.0)])
    anchors = Anchors.from_positions(positions)
    where = halls.Hall(anchors, (14.0, 32.0), 100.0, np.zeros(len(positions)))
    return _walked(where, seed, 12.0, True, {"speed": 1.0})


def _among_few(seed: int) -> Case:
    """Eight anchors in the corners of a large hall, heard everywhere."""
    corners_of = [(x, y, z) for x in (0.0, 100.0) for y in (0.0, 60.0) for z in (0.5, 6.0)]
    anchors = Anchors.from_positions(np.array(corners_of))
    where = halls.Hall(anchors, (100.0, 60.0), 200.0, np.zeros(len(anchors)))
    return _walked(where, seed, 6.0, True, {})


def _walked(where: Any, seed: int, duration: float, imu: bool, more: dict[str, Any]) -> Case:
    flight = halls.fly(where, seed, duration, **more)
    ends = [end for _, end in more.get("dead", [])]
    if "lift" in more:
        ends.append(more["lift"] + 10.0)
    spans = {"all": (0.0, duration)}
    if ends:
        spans |= {"after": (ends[-1], duration)}
    over = ends[-1] if ends else 0.0
    return Case(flight, spans, over, {} if imu else {"use_imu": False})


def _rovers() -> Iterator[Row]:
    needs = "velocity", "plane"
    for seed, late in ((3, (0, 4)), (5, (4, 3)), (2, (1, 4))):
        for imu in (True, False):
            make = partial(_contradicted, seed, late, imu)
            words = "wheels, IMU" if imu else "wheels alone"
            yield Row(f"rover, {words}, two late, seed {seed}", "sensors", make, False, needs)
    yield Row(
        "rover, wheels, then alone", "sensors", partial(_contradicted, 1, (), False), False, needs
    )


def _contradicted(seed: int, late: tuple[int, ...], imu: bool) -> Case:
    flight = rovers.drive(seed, 45.0)
    if late:
        flight = rovers.late(flight, late, since=33.0)
    begin = float(flight.truth.t[0])
    config = {"planar": True, "fixed_height": rovers.HEIGHT, "use_imu": imu}
    spans = {"late": (begin + 33.0, begin + 38.0), "then": (begin + 38.0, begin + 45.0)}
    return Case(flight, spans | {"before": (begin + 15.0, begin + 33.0)}, None, config)


def _driven(seed: int, streams: tuple[str, ...], config: FilterConfig, late: bool) -> Case:
    flight, _ = rover.drive(seed)
    others = [stream for stream in ("imu", "velocity") if stream not in streams]
    arm = tuple(flight.meta["config"]["tag_lever_arm"])
    given = (rover.late(flight) if late else flight).without(*others)
    default = FilterConfig()
    changed = {
        name: value for name, value in vars(config).items() if value != getattr(default, name)
    }
    spans = {"first 15 s": (5.0, 15.0), "then": (15.0, 90.0)}
    return Case(given, spans, None, changed, arm)


def _with_range_finder(room: str, seed: int) -> Case:
    """A tag below a ceiling of anchors, with a range finder over level ground."""
    case = _in_room(room, seed, 12.0, speed=1.0)
    truth = case.flight.truth
    t = truth.t[4::4]
    noise = 0.01 * np.random.default_rng(seed).standard_normal(len(t))
    height = Height(t, np.interp(t, truth.t, truth.p[:, 2]) + noise)
    return replace(case, flight=replace(case.flight, height=height))


def _ranged(what: str, fault: str = "sound", twice: bool = False, seed: int = 0) -> Case:
    flight = ranges.spoiled(ranges.flown(seed, persistent=True), ranges.FAULTS[fault], 0)
    flight = ranges.SETS[what](flight)
    if twice:
        both = np.repeat(np.arange(len(flight.range)), 2)
        flight = replace(flight, range=rows_of(flight.range, both))
    return Case(flight, phases(flight.truth))
