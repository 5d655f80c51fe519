# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""users: judge the filter for bodies, sensors, rates and errors unlike those of the measured rooms.

The recordings come from a simulator in this file. Two textbook estimators run beside the filter: an
extended Kalman filter with constant velocity, and batch least squares over the whole recording.
Both know the noise of the TDOAs and the density of the random acceleration, and both bound what a TDOA
beyond GATE deviations does. The filter has its defaults.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import make_interp_spline
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors.velocity import Velocity
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.smoother import smooth
from uwb_tdoa_tools import cli

from . import table

DURATION, SETTLED = 40.0, 5.0  # s; errors count from SETTLED on
BEGIN = 3.0  # s until the tag has its speed
NOISE, DELAY, SURVEY = 0.1, 0.08, 0.05  # m
GATE = 3.0  # standard deviations up to which the textbook estimators believe a TDOA
OUTLIERS, LATE = 0.05, 2.0  # share of outliers, and their mean size (m), exponential
REFLECTION, CHANGES = 0.12, 0.5  # m; a reflection changes over this length
STEP = 0.5  # m between two estimates that the motion does not explain
KNOT = 0.1  # s between positions of the batch least squares
GRAVITY = np.array([0.0, 0.0, 9.81])


@dataclass(frozen=True)
class Body:
    """Lissajous figure of a tag: half axes (m), speed (m/s), height of steps (m).

    tilts : thrust tilts it. holds : it stands still for half of each period (s).
    """

    reach: tuple[float, float, float]
    speed: float
    bob: float = 0.0
    tilts: bool = False
    holds: float = 0.0


BODIES = {
    "rest": Body((2.0, 1.5, 0.0), 0.0),
    "person": Body((2.5, 2.5, 0.0), 1.2, 0.03),
    "runner": Body((3.0, 3.0, 0.0), 3.0, 0.05),
    "rover": Body((2.5, 2.0, 0.0), 0.5),
    "quadrotor": Body((2.0, 2.0, 0.6), 1.0, tilts=True),
    "racing": Body((3.5, 3.5, 0.5), 8.0, tilts=True),
    "lift": Body((0.3, 0.3, 1.0), 0.5),
    "arm": Body((0.8, 0.8, 0.5), 0.8, holds=6.0),
    "forklift": Body((17.0, 12.0, 0.0), 2.5),
    "train": Body((28.0, 0.8, 0.0), 3.0),
}
# errors of anchors; and anchors on one line that is no axis, anchors of the ceiling alone, rates beyond
# the range of the gyroscope, a height that is fixed, for a lift wrongly
ERRORS = "white", "delays", "survey", "reflections", "outliers"
LINE, CEILING, CLIPPED, FIXED = "oblique line", "ceiling", "clipped gyroscope", "fixed height"
# anchors of a hall of 40 x 30 m and of a tunnel of 60 x 4 m, of which the tag hears the nearest eight;
# wheels that measure velocity and yaw rate; an IMU with a tenth of the noise
HALL, TUNNEL, WHEELS, QUIET = "hall", "tunnel", "wheels", "quiet IMU"
HEIGHT, HEIGHT_STD = 1.2, 0.05  # m, fixed height
SHARE = 0.023  # of the samples of a gyroscope, beyond its range
CELLS = [  # body, IMU (Hz), TDOAs/s, errors
    ("rest", 0, 1, "white"),
    ("rest", 0, 2, "white"),
    ("rest", 0, 10, "white"),
    ("rest", 0, 10, "delays"),
    ("rest", 0, 50, "reflections"),
    ("rest", 0, 200, "white"),
    ("rest", 100, 10, "survey"),
    ("rest", 100, 50, "delays"),
    ("rest", 500, 400, "delays"),
    ("rest", 100, 2, QUIET),
    ("rest", 100, 10, QUIET),
    ("rest", 500, 400, QUIET),
    ("person", 0, 1, "white"),
    ("person", 0, 2, "white"),
    ("person", 0, 5, "reflections"),
    ("person", 0, 10, "delays"),
    ("person", 0, 2, "outliers"),
    ("person", 0, 5, "outliers"),
    ("person", 0, 10, "outliers"),
    ("person", 0, 50, "survey"),
    ("person", 0, 200, "reflections"),
    ("person", 100, 10, "white"),
    ("person", 100, 10, "outliers"),
    ("person", 100, 50, "reflections"),
    ("runner", 0, 5, "white"),
    ("runner", 0, 10, "delays"),
    ("runner", 0, 20, "white"),
    ("runner", 0, 20, "reflections"),
    ("runner", 100, 20, "survey"),
    ("rover", 0, 5, "white"),
    ("rover", 0, 5, "outliers"),
    ("rover", 0, 20, "reflections"),
    ("rover", 0, 200, "delays"),
    ("rover", 100, 5, "delays"),
    ("rover", 100, 20, "survey"),
    ("rover", 100, 200, "white"),
    ("quadrotor", 500, 5, "white"),
    ("quadrotor", 500, 20, "delays"),
    ("quadrotor", 500, 20, "outliers"),
    ("quadrotor", 500, 50, "white"),
    ("quadrotor", 100, 200, "survey"),
    ("quadrotor", 500, 400, "reflections"),
    ("quadrotor", 500, 1000, "survey"),
    ("racing", 500, 50, "white"),
    ("racing", 500, 200, "white"),
    ("racing", 500, 400, "delays"),
    ("racing", 0, 200, "white"),
    ("person", 0, 10, CEILING),
    ("quadrotor", 500, 200, CEILING),
    ("quadrotor", 500, 50, LINE),
    ("racing", 500, 200, CLIPPED),
    ("lift", 100, 50, FIXED),
    ("lift", 0, 10, FIXED),
    ("rest", 0, 2, FIXED),
    ("person", 0, 5, FIXED),
    ("runner", 0, 5, FIXED),
    ("rover", 0, 10, FIXED),
    ("forklift", 0, 2, f"{FIXED} in a {HALL}"),
    ("forklift", 0, 2, HALL),
    ("forklift", 0, 10, HALL),
    ("forklift", 100, 20, HALL),
    ("train", 0, 10, TUNNEL),
    ("train", 100, 50, TUNNEL),
    ("arm", 0, 10, "white"),
    ("arm", 0, 20, "delays"),
    ("arm", 100, 50, "delays"),
    ("rover", 0, 2, WHEELS),
    ("rover", 0, 10, WHEELS),
    ("rover", 100, 50, WHEELS),
]


def simulate(
    name: str, imu_rate: float, rate: float, errors: str, seed: int
) -> tuple[Flight, float]:
    """Return a Flight, and the density of its random acceleration, m^2/s^3."""
    rng, body = np.random.default_rng([seed, 73]), BODIES[name]
    t = np.arange(-0.1, DURATION + 0.1, 1e-3)
    ratio, phase = np.array([1.0, 1.31, 1.7]), rng.uniform(0.0, 2.0 * np.pi, 3)
    reach = np.array(body.reach)
    rates = body.speed / math.sqrt(0.5 * np.sum((reach * ratio) ** 2)) * ratio
    since = np.clip(t / BEGIN, 0.0, 1.0)  # from rest to full speed over BEGIN
    way = np.where(t < BEGIN, BEGIN * (since**3 - 0.5 * since**4), t - 0.5 * BEGIN)
    if body.holds:
        number, share = np.divmod(t / body.holds, 1.0)
        moves = np.minimum(2.0 * share, 1.0)
        way = 0.5 * body.holds * (number + moves**3 * (10.0 - 15.0 * moves + 6.0 * moves**2))
    p = [0.0, 0.0, 1.2] + reach * np.sin(way[:, None] * rates + phase)
    p[:, 2] += body.bob * np.sin(2.0 * np.pi * 1.9 * t)
    path = make_interp_spline(t, p, k=5)
    v, a = path(t, 1), path(t, 2)
    yaw = (
        np.unwrap(np.arctan2(v[:, 1], v[:, 0]))
        if body.speed and not (body.tilts or body.holds)
        else np.full(len(t), phase[0])
    )
    up = (a if body.tilts else 0.0 * a) + GRAVITY
    up /= np.linalg.norm(up, axis=1)[:, None]
    left = np.cross(up, np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw]))
    left /= np.linalg.norm(left, axis=1)[:, None]
    q = Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=2))
    places = np.array([(x, y, z) for z in (0.2, 2.8) for x in (-4.0, 4.0) for y in (-4.0, 4.0)])
    if errors == CEILING:  # below it, the others half way between the corners
        places[:4] = [(4.0, 0.0, 2.6), (0.0, 4.0, 2.6), (-4.0, 0.0, 2.6), (0.0, -4.0, 2.6)]
    if errors == LINE:
        places = np.linspace((-4.0, -2.4, 2.8), (4.0, 2.4, 2.8), 8)
    if errors.endswith((HALL, TUNNEL)):
        x, y = (
            ([-20, -10, 0, 10, 20], [-15, -5, 5, 15])
            if errors.endswith(HALL)
            else (range(-30, 31, 6), [-2, 2])
        )
        places = np.array(
            [(i, j, (0.5, 4.0)[(m + n) % 2]) for m, i in enumerate(x) for n, j in enumerate(y)]
        )
    count = len(places)
    surveyed = places + SURVEY * (errors == "survey") * rng.normal(size=(count, 3))
    anchors = Anchors(np.arange(count), surveyed, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
    flight = Flight(
        name,
        anchors,
        _tdoas(path, places, rate, errors, rng),
        _imu(t, a, q, imu_rate, errors, rng) if imu_rate else None,
        Truth(t[::10], p[::10], q.as_quat()[::10]),
    )
    if errors == WHEELS:
        flight = flight.replaced(velocity=_wheels(t[::50], v[::50], q[::50], rng))
    return flight, float(np.mean(np.sum((v[500:] - v[:-500]) ** 2, axis=1)) / 1.5)


def _tdoas(path: Any, places: np.ndarray, rate: float, errors: str, rng: Any) -> Tdoas:
    """Return the TDOAs of pairs in random order, at `rate` (1/s)."""
    t = np.arange(0.01, DURATION, 1.0 / rate)
    a = rng.integers(0, 8, len(t))
    b = (a + rng.integers(1, 8, len(t))) % 8
    p, each = path(t), DELAY * (errors == "delays") * rng.normal(size=len(places))
    nearest = np.argsort(np.linalg.norm(p[:, None] - places, axis=2), axis=1)
    if len(places) > 8:
        a, b = nearest[range(len(t)), a], nearest[range(len(t)), b]
    arrival = np.linalg.norm(p[:, None] - places, axis=2) + each
    if errors == "reflections":
        waves, phases = (
            rng.normal(size=(8, 20, 3)) / CHANGES,
            rng.uniform(0.0, 2.0 * np.pi, (8, 20)),
        )
        arrival += (
            REFLECTION * np.mean(np.cos(np.einsum("nk,awk->naw", p, waves) + phases), 2) * 40**0.5
        )
    rows = np.arange(len(t))
    d = arrival[rows, b] - arrival[rows, a] + NOISE * rng.normal(size=len(t))
    if errors == "outliers":
        size = rng.exponential(LATE, len(t)) * rng.choice([-1.0, 1.0], len(t))
        d += size * (rng.random(len(t)) < OUTLIERS)
    return Tdoas(t, a, b, d)


def _wheels(t: np.ndarray, v: np.ndarray, q: Rotation, rng: Any) -> Velocity:
    """Return velocities in the body frame and yaw rates, as wheels measure them, with stated noise."""
    n, yaw = len(t), np.unwrap(q.as_euler("ZYX")[:, 0])
    of_body = q.inv().apply(v) + [0.02, 0.0, 0.0] * rng.normal(size=(n, 1))
    std = np.tile([0.02, 0.02, np.inf], (n, 1))
    rate = np.gradient(yaw, t) + 0.02 * rng.normal(size=n)
    return Velocity(t, of_body * [1.0, 0.0, 0.0], std, rate, np.full(n, 0.02))


def _imu(t: np.ndarray, a: np.ndarray, q: Rotation, rate: float, errors: str, rng: Any) -> Imu:
    """Return inertial samples with biases and white noise."""
    rows = np.arange(0, len(t) - 1, round(1000 / rate))
    gyro = (q[rows].inv() * q[rows + 1]).as_rotvec() / 1e-3 + 0.005 * rng.normal(size=3)
    accel = q[rows].inv().apply(a[rows] + GRAVITY) + 0.05 * rng.normal(size=3)
    scatter = math.sqrt(rate) * rng.normal(size=(2, len(rows), 3))
    scatter *= 0.1 if errors == QUIET else 1.0
    limit = np.quantile(np.abs(gyro).max(axis=1), 1.0 - SHARE) if errors == CLIPPED else np.inf
    return Imu(
        t[rows], np.clip(gyro + 0.002 * scatter[0], -limit, limit), accel + 0.02 * scatter[1]
    )


def _geometry(flight: Flight, rows: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (n,) and Jacobian (n, 3) of TDOAs at positions p (n, 3)."""
    tdoa, places = flight.tdoa, flight.anchors.positions
    to_a, to_b = p - places[tdoa.a[rows]], p - places[tdoa.b[rows]]
    away_a, away_b = np.linalg.norm(to_a, axis=1), np.linalg.norm(to_b, axis=1)
    H = to_b / away_b[:, None] - to_a / away_a[:, None]
    return tdoa.d[rows] - (away_b - away_a), H


def kalman(
    flight: Flight, density: float, fixed: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps, positions and covariances of an extended iterated Kalman filter: constant velocity.

    Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, sections 6.2.2
    and 10.5.2. fixed : the height is known to be HEIGHT.
    """
    truth, t = flight.truth, flight.tdoa.t
    assert truth is not None
    x, P = np.append(truth.p[0], np.zeros(3)), np.diag([0.1] * 3 + [10.0] * 3)
    places, covariances = np.empty((len(t), 3)), np.empty((len(t), 3, 3))
    F, Q = np.eye(6), np.zeros((6, 6))
    for k in range(len(t)):
        dt = t[k] - t[k - 1] if k else 0.0
        for i in range(3):
            F[i, 3 + i] = dt
            Q[i, i], Q[i, 3 + i], Q[3 + i, i], Q[3 + i, 3 + i] = max(density, 1e-4) * np.array(
                [dt**3 / 3.0, dt**2 / 2.0, dt**2 / 2.0, dt]
            )
        x, P = F @ x, F @ P @ F.T + Q
        if fixed:
            gain = P[:, 2] / (P[2, 2] + HEIGHT_STD**2)
            x, P = x + gain * (HEIGHT - x[2]), P - np.outer(gain, P[2])
        prior = x
        for _ in range(5):  # iterated: linearized anew at the updated position
            r, H = _geometry(flight, np.array([k]), x[None, :3])
            h = np.append(H[0], np.zeros(3))
            variance = h @ P @ h + NOISE**2
            variance = max(variance, abs(r[0] + h @ (x - prior)) / GATE * math.sqrt(variance))
            gain = P @ h / variance
            x = prior + gain * (r + h @ (x - prior))
        P = P - np.outer(gain, h @ P)
        places[k], covariances[k] = x[:3], P[:3, :3]
    return t, places, covariances


def least_squares(
    flight: Flight, density: float, begin: np.ndarray, fixed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and positions of batch least squares: positions at knots, random acceleration.

    begin : (n, 3) positions at the stamps of the TDOAs, to start from.
    """
    tdoa, n = flight.tdoa, int(DURATION / KNOT) + 2
    t, p = KNOT * np.arange(n), np.empty((n, 3))
    for k in range(3):
        p[:, k] = np.interp(t, tdoa.t, begin[:, k])
    before = np.minimum((tdoa.t / KNOT).astype(int), n - 2)
    share = tdoa.t / KNOT - before
    rows = np.arange(len(tdoa))
    at = sparse.csr_matrix(
        (np.append(1.0 - share, share), (np.tile(rows, 2), np.append(before, before + 1))),
        (len(rows), n),
    )
    second = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], (n - 2, n))  # type: ignore[list-item]
    smooth_by = second.T @ second / (max(density, 1e-4) * KNOT**3)
    prior = sparse.block_diag([smooth_by] * 3) + 1e-6 * sparse.eye(3 * n)
    level = np.tile([0.0, 0.0, HEIGHT], (n, 1)) * fixed
    prior += sparse.diags([np.repeat([0.0, 0.0, fixed / HEIGHT_STD**2], n)], [0])
    for _ in range(8):
        r, H = _geometry(flight, rows, at @ p)
        J = sparse.hstack([sparse.diags(H[:, k]) @ at for k in range(3)]).tocsr()
        weighted = J.T @ sparse.diags(1.0 / np.maximum(NOISE**2, NOISE * np.abs(r) / GATE))
        system = weighted @ J + prior
        right = weighted @ r - prior @ (p - level).T.ravel()
        p += splu(system.tocsc()).solve(right).reshape(3, n).T
    return t, p


def _judge(
    flight: Flight, t: np.ndarray, p: np.ndarray, covariance: np.ndarray | None = None
) -> dict[str, float]:
    """Return RMSE and largest error (m), steps, and NEES per degree of freedom after SETTLED."""
    truth = flight.truth
    assert truth is not None
    late = (t >= SETTLED) & (t <= DURATION)
    t, p = t[late], p[late]
    true = np.stack([np.interp(t, truth.t, column) for column in truth.p.T], axis=1)
    off = p - true
    size = np.linalg.norm(off, axis=1)
    steps = np.linalg.norm(np.diff(off, axis=0), axis=1) > STEP
    out = {"rmse": math.sqrt(np.mean(size**2)), "max": size.max(), "steps": float(steps.sum())}
    if covariance is not None:
        nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance[late][:, :3, :3]), off)
        out["nees"] = float(np.mean(nees)) / 3.0
    return out


def _nees_of_yaw(flight: Flight, odometry: Any) -> float:
    """Return the mean NEES of the yaw after SETTLED."""
    truth, late = flight.truth, odometry.t >= SETTLED
    assert truth is not None
    true = np.unwrap(Rotation.from_quat(truth.q).as_euler("ZYX")[:, 0])
    estimated = Rotation.from_quat(odometry.q[late])
    off = estimated.as_euler("ZYX")[:, 0] - np.interp(odometry.t[late], truth.t, true)
    z = estimated.as_matrix()[:, 2]  # vertical axis of the world, in the body
    variance = np.einsum("ni,nij,nj->n", z, odometry.covariance[late][:, 6:9, 6:9], z)
    return float(np.mean(np.arctan2(np.sin(off), np.cos(off)) ** 2 / variance))


def add_options(add: Any) -> None:
    """Add the options of the study."""
    table.add_options(add, draws=5)
    table.add_only(add)


def run(args: Namespace) -> None:
    """Simulate, and print the table."""
    cells = {
        f"{body}, IMU {imu} Hz, {rate} TDOAs/s, {errors}": (body, imu, rate, errors)
        for body, imu, rate, errors in CELLS
    }
    cli.show(table.head("cell", *COLUMNS))
    for name, results in table.trials(measure, table.chosen(args, list(cells)), args):
        cli.show(table.line([name, *(_pooled(results, column) for column in COLUMNS.values())]))


COLUMNS = {
    "filter, RMSE m": ("filter", "rmse"),
    "largest": ("filter", "max"),
    "NEES": ("filter", "nees"),
    "NEES of yaw": ("filter", "yaw"),
    "smoother, RMSE m": ("smoother", "rmse"),
    "largest ": ("smoother", "max"),
    "steps": ("smoother", "steps"),
    "NEES ": ("smoother", "nees"),
    "EKF, RMSE m": ("kalman", "rmse"),
    "NEES  ": ("kalman", "nees"),
    "least squares, RMSE m": ("batch", "rmse"),
}


def _pooled(results: list[dict[str, dict[str, float]]], column: tuple[str, str]) -> str:
    """Return the cell of a column, pooled over seeds."""
    values = np.array([result[column[0]].get(column[1], math.nan) for result in results])
    if np.isnan(values).all():
        return ""
    if column[1] == "rmse":
        return f"{math.sqrt(np.mean(values**2)):.3f}"
    if column[1] in ("max", "steps"):
        return f"{values.max():.2f}" if column[1] == "max" else f"{values.sum():.0f}"
    return f"{values.mean():.2f}"


def measure(item: tuple[str, int]) -> dict[str, dict[str, float]]:
    """Return the figures of each estimator in a cell, for (name of the cell, seed)."""
    name, seed = item
    body, imu, rate, errors = name.split(", ")
    flight, density = simulate(body, float(imu.split()[1]), float(rate.split()[0]), errors, seed)
    config = FilterConfig(
        use_imu=flight.imu is not None,
        fixed_height=HEIGHT,
        fixed_height_std=HEIGHT_STD * errors.startswith(FIXED),
    )
    fixed = errors.startswith(FIXED) and body != "lift"
    online, smoothed = run_offline(flight, config).odometry, smooth(flight, config).odometry
    t, p, covariance = kalman(flight, density, fixed)
    out = {
        "filter": _judge(flight, online.t, online.p, online.covariance),
        "smoother": _judge(flight, smoothed.t, smoothed.p, smoothed.covariance),
        "kalman": _judge(flight, t, p, covariance),
        "batch": _judge(flight, *least_squares(flight, density, p, fixed)),
    }
    if flight.imu is not None and BODIES[body].speed:
        out["filter"]["yaw"] = _nees_of_yaw(flight, online)
    return out
