# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""rover: judge the filter, and the effects that diagnose writes, on simulated drives over a floor.

A rover drives for 90 s among six anchors in 12 x 8 m. It has wheels (50 Hz, 2 % too fast, slip), an
IMU (100 Hz) and 100 TDOAs a second. The TDOAs have a noise of 0.1 m and antenna delays of 5 cm;
both make up `tdoa_std`. The antenna is on a mast 0.4 m above base_link, which is on the floor.

The filter learns how far errors persist. `adapt_noise: false` states that they are white, as here.
 Rows of a hall have the errors of real halls, and the default
`tdoa_std`. There, anchors are surveyed to 3 cm, have delays of 10 cm, and errors by received power
and by both antennas. 3 % of the TDOAs are outliers, and each of four places blocks one anchor.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import effects_of
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from . import table

DURATION, NOISE, DELAY_STD = 90.0, 0.1, 0.05  # s, m, m
HEIGHT_STD = 0.02  # m, by which the height of the floor is not known
SETTLED = 15.0  # s after which it is judged: the yaw is known
LATE_ANCHORS, LATE_FROM, LATE_FOR, LATE_BY = (0, 3), 40.0, 5.0, 1.5  # s, s, m
PLANAR = FilterConfig(
    planar=True, fixed_height=0.0, tdoa_std=float(np.hypot(NOISE, DELAY_STD * np.sqrt(2.0)))
)
# As in real halls: m, surveyed; m, of an anchor's delay; m; share of outliers
SURVEY_STD, HALL_DELAY_STD, HALL_NOISE, OUTLIERS = 0.03, 0.1, 0.08, 0.03
BLOCKED, RADIUS, METAL = 4, 1.5, (0.2, 0.6)  # places, m around each, m by which one anchor is late
ROWS = {
    "wheels, IMU": (("imu", "velocity"), PLANAR, False),
    "wheels alone": (("velocity",), replace(PLANAR, use_imu=False), False),
    "TDOAs alone": ((), replace(PLANAR, use_imu=False), False),
    "wheels, IMU; two anchors late": (("imu", "velocity"), PLANAR, True),
}
HEAD = (
    "xy RMSE m",
    "yaw degrees",
    "NEES xy",
    "NEES z",
    "NEES yaw",
    "largest error m",
    "largest step m",
)
VALUES = {  # that a diagnosis is to find
    "gyro_bias": "xyz",
    "accel_bias": "xyz",
    "velocity_scale": ("scale",),
    "yaw_rate_scale": ("scale",),
    "tag_lever_arm": "xyz",
}


def add_options(add):
    """The options of the study."""
    add("--diagnose", action="store_true", help="diagnose drives and flights instead")
    table.add_options(add, draws=20)


def run(args):
    """Print the table."""
    if args.diagnose:
        for kind, found in table.trials(deviations, ("planar", "flown"), args):
            cli.show(f"{kind}:", *told(found))
        return
    cli.show(table.head("", *HEAD))
    results = list(table.results(judged, table.seeds(args), args, unit="drive"))
    for name in results[0]:
        columns = np.array([result[name] for result in results])
        means = (
            np.sqrt(np.mean(columns[:, :2] ** 2, axis=0)),
            columns[:, 2:5].mean(axis=0),
            columns[:, 5:].max(axis=0),
        )
        cli.show(table.line([name, *(f"{value:.2f}" for value in np.concatenate(means))]))


def drive(seed):
    """(Flight, delays of its anchors (N,) m) of a rover."""
    config = SimulationConfig.of(
        "rover",
        seed=seed,
        duration=DURATION,
        noise_std=NOISE,
        bias=False,
        multipath=False,
        outlier_probability=0.01,
        floor_time=5.0,
    )
    return _delayed(simulate(config), seed)


def drive_of_hall(seed):
    """(Flight, delays of its anchors (N,) m, which its TDOAs have) of a rover among errors as real
    halls have them.
    """
    config = SimulationConfig.of(
        "rover",
        seed=seed,
        duration=DURATION,
        noise_std=HALL_NOISE,
        anchor_delay_std=0.0,
        tag_unit=1 + seed,
        outlier_probability=OUTLIERS,
        floor_time=5.0,
    )
    flight, delays = _delayed(simulate(config), seed, HALL_DELAY_STD)
    rng, anchors = np.random.default_rng([seed, 50]), flight.anchors
    values = {}
    places = zip(rng.permutation(anchors.ids)[:BLOCKED], rng.uniform(-0.7, 0.7, (BLOCKED, 2)))
    for anchor, place in places:
        x, y = place * np.abs(anchors.positions[:, :2]).max(axis=0)
        values |= {f"{anchor}.x": x, f"{anchor}.y": y, f"{anchor}.radius": RADIUS}
        values[f"{anchor}.delay"] = rng.uniform(*METAL)
    flight = EFFECTS["nlos"](values).inject(flight)
    off = SURVEY_STD * rng.standard_normal(anchors.positions.shape)
    return replace(flight, anchors=replace(anchors, positions=anchors.positions + off)), delays


def flown(seed):
    """As `drive`, of a quadrotor whose antenna is off its centre."""
    config = SimulationConfig(
        seed=seed,
        duration=DURATION,
        noise_std=NOISE,
        bias=False,
        multipath=False,
        protocol="tdoa3",
        imu_rate=100.0,
        truth_rate=50.0,
        yaw="rotating",
        tag_lever_arm=(0.05, 0.02, 0.1),
        velocity_noise=0.02,
    )
    flight, delays = _delayed(simulate(config), seed)
    return EFFECTS["velocity_scale"]({"scale": 0.02}).inject(flight), delays


def _delayed(flight, seed, std=DELAY_STD):
    delays = std * np.random.default_rng([seed, 48]).standard_normal(len(flight.anchors))
    return EFFECTS["anchor_delay"](
        dict(zip(map(str, flight.anchors.ids.tolist()), delays.tolist()))
    ).inject(flight), delays


def late(flight):
    """The Flight with two anchors that are late for a while."""
    tdoas, ids = flight.tdoa, flight.anchors.ids[list(LATE_ANCHORS)]
    during = (tdoas.t > LATE_FROM) & (tdoas.t < LATE_FROM + LATE_FOR)
    by = LATE_BY * during * (np.isin(tdoas.b, ids).astype(float) - np.isin(tdoas.a, ids))
    return replace(flight, tdoa=replace(tdoas, d=tdoas.d + by))


def judged(seed):
    """{row: figures as in HEAD} of one drive.

    The filter knows where the antenna is, as /tf_static says it.
    """
    out = {}
    for block, (made, changed) in BLOCKS.items():
        flight, _ = made(seed)
        for name, (streams, config, is_late) in ROWS.items():
            told = replace(config, **changed)
            out[block + name] = _figures(flight, seed, streams, told, is_late)
    return out


def _figures(flight, seed, streams, config, is_late):
    """Figures of one row. streams : that are used; is_late : two anchors are."""
    arm = dict(zip("xyz", flight.meta["config"]["tag_lever_arm"]))
    corrector = Corrector(flight.anchors, EffectSet((EFFECTS["tag_lever_arm"](arm),)))
    off = HEIGHT_STD * np.random.default_rng([seed, 49]).standard_normal()  # as it was measured
    others = [stream for stream in ("imu", "velocity") if stream not in streams]
    given = (late(flight) if is_late else flight).without(*others)
    return figures(
        flight, run_offline(given, replace(config, fixed_height=off), corrector).odometry
    )


BLOCKS = {  # {beginning of a row's name: (what makes its drives, parameters)}
    "": (drive, {}),
    "white noise stated: ": (drive, {"adapt_noise": False}),
    "hall: ": (drive_of_hall, {"tdoa_std": FilterConfig().tdoa_std}),
}


def figures(flight, odometry):
    """Figures as in HEAD, of an Odometry against the truth of a Flight."""
    kept = (odometry.t > SETTLED) & (odometry.t <= flight.truth.t[-1])
    t, q, covariance = odometry.t[kept], odometry.q[kept], odometry.covariance[kept]
    error = odometry.p[kept] - position_at(t, flight.truth)
    yaw = np.interp(t, flight.truth.t, np.unwrap(yaw_of(flight.truth.q)))
    off = (yaw_of(q) - yaw + np.pi) % (2.0 * np.pi) - np.pi
    turn = Rotation.from_quat(q).as_matrix()
    yaw_variance = (turn @ covariance[:, 6:9, 6:9] @ np.swapaxes(turn, 1, 2))[:, 2, 2]
    xy = error[:, :2]
    nees = (
        np.einsum("ni,ni->n", xy, np.linalg.solve(covariance[:, :2, :2], xy[:, :, None])[:, :, 0])
        / 2.0
    )
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    return [
        np.sqrt(np.mean(np.sum(xy**2, axis=1))),
        np.degrees(np.sqrt(np.mean(off**2))),
        nees.mean(),
        np.mean(error[:, 2] ** 2 / covariance[:, 2, 2]),
        np.mean(off**2 / yaw_variance),
        np.linalg.norm(xy, axis=1).max(),
        steps.max(),
    ]


def yaw_of(q):
    """(n,) rad of quaternions (n, 4)."""
    x, y, z, w = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))


def deviations(trial):
    """{value: (error, stated deviation), or None where diagnose finds none} of a drive or a flight:
    ("planar" or "flown", seed).

    The diagnosis uses its ground truth and the effects of the catalogue.
    """
    kind, seed = trial
    flight, delays = (drive if kind == "planar" else flown)(seed)
    reference = GroundTruth()
    (prepared, _) = reference.settled(reference.prepare(flight), EffectSet())
    found = {
        effect.name: effect
        for effect in effects_of(attribute([prepared], reference, undeclared=False).selection)
    }
    state, arm = flight.extra["state_truth"], flight.meta["config"]["tag_lever_arm"]
    true = {("velocity_scale", "scale"): 0.02} | {
        ("tag_lever_arm", axis): arm[k] for k, axis in enumerate("xyz")
    }
    true |= {
        (f"{name}_bias", axis): float(np.mean(state[f"{name}_bias_{axis}"]))
        for name in ("gyro", "accel")
        for axis in "xyz"
    }
    if flight.velocity.parts:
        true["yaw_rate_scale", "scale"] = 0.02
    ids = np.array([str(i) for i in flight.anchors.ids.tolist()])
    late = found["anchor_delay"].values if "anchor_delay" in found else {}
    zero = ~np.isin(ids, list(late)) if len(late) < len(ids) else np.ones(len(ids), bool)
    true |= {  # relative to the mean delay of the anchors that diagnose does not write
        ("anchor_delay", i): d
        for i, d in zip(ids.tolist(), (delays - delays[zero].mean()).tolist())
    }
    out = {}
    for (name, key), value in true.items():
        one = found.get(name)
        out[f"{name}.{key}"] = (
            (one.values[key] - value, one.std[key])
            if one is not None and key in one.values
            else None
        )
    return out


def told(results):
    """Lines: of each effect how many values were written, the share within three stated deviations,
    errors and deviations.
    """
    columns = "written", "within 3 deviations", "error, rms", "stated, rms"
    lines = [table.head("effect", *columns)]
    for name in (*VALUES, "anchor_delay"):
        every = [
            pair for result in results for key, pair in result.items() if key.startswith(f"{name}.")
        ]
        if not every:  # a quadrotor has no wheels
            continue
        errors, std = np.array([pair for pair in every if pair is not None]).reshape(-1, 2).T
        within = np.mean(np.abs(errors) <= 3.0 * std) if len(std) else np.nan
        root = [np.sqrt(np.mean(column**2)) if len(column) else np.nan for column in (errors, std)]
        written = f"{len(std)} of {len(every)}"
        lines.append(
            table.line([name, written, f"{within:.0%}", *(f"{value:.5f}" for value in root)])
        )
    return lines
