# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit the frame of the ground truth jointly with what bends the estimate: lever arm and delays.

A rigid alignment with the estimate takes over its bias. Here the residuals of raw TDOAs are fitted
(hand-eye calibration, with anchors in place of a camera).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.effects import EffectSet, Samples, true_samples

from ..scoring.evaluation import Alignment, rigid_transform, transform_truth
from ..scoring.metrics import scored_phase

FRAME, LEVER = ("roll", "pitch", "yaw", "x", "y", "z"), ("lever.x", "lever.y", "lever.z")
# standard deviations before the data: rad and m of the frame, s, m of the lever arm and of a delay
PRIOR = {**dict.fromkeys(FRAME, 10.0), "clock": 0.1, **dict.fromkeys(LEVER, 0.3)}
DELAY = 0.3
# rad, m, s, m; a value whose 95 % interval (2 standard deviations) is wider is not determined
LIMITS = (
    dict.fromkeys(FRAME[:3], np.deg2rad(0.5))
    | dict.fromkeys(FRAME[3:], 0.02)
    | {"clock": 0.01, **dict.fromkeys(LEVER, 0.01)}
)
BLOCK = 5.0  # s; errors of TDOAs in a block have a common cause
STEPS = 15  # reweighted Gauss-Newton steps
ROUNDING = 1e-6  # m, difference of a path that a rigid transform moves
FILE = "truth_to_survey.txt"
TO_APPLY = f'T = np.loadtxt("{FILE}")', "p_survey = p_truth @ T[:3, :3].T + T[:3, 3]"


@dataclass(frozen=True, eq=False)
class TruthTransform:
    """The rigid transform of positions of the ground truth to the survey, and how sure it is.

    turn : (3, 3); shift : (3,) m; late : s, delay of the stamps of the ground truth
    values, std : {parameter: rad, m or s}. The lever arm (tool), what is left between the clocks
        (of the ground truth and TDOAs) and delays of anchors, fitted with it. The deviations of x, y
        and z are those in the middle of the path.
    flights : names of the flights that are moved by it
    """

    turn: np.ndarray
    shift: np.ndarray
    late: float
    values: dict[str, float]
    std: dict[str, float]
    flights: tuple[str, ...] = ()

    @property
    def matrix(self) -> np.ndarray:
        """Return the homogeneous transform, (4, 4)."""
        return np.block([[self.turn, self.shift[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    @property
    def undetermined(self) -> list[str]:
        """Return the names of the parameters that the flights do not determine."""
        return [
            name for name, most in LIMITS.items() if not 2.0 * self.std.get(name, np.inf) < most
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values: m, rad, s."""
        return {
            "matrix": self.matrix,
            "quaternion": Rotation.from_matrix(self.turn).as_quat(),
            "translation": self.shift,
            "late": self.late,
            "beside": self.values,
            "std": self.std,
            "undetermined": self.undetermined,
            "flights": list(self.flights),
            "apply": list(TO_APPLY),
        }

    def files(self) -> dict[str, str]:
        """Return {name of a file: its text}: the matrix, and how it is applied."""
        head = (
            "positions of the ground truth to the survey, m:",
            *TO_APPLY,
            f"t_survey = t_truth - {self.late:.4f}",
        )
        rows = [" ".join(f"{value:.9f}" for value in row) for row in self.matrix]
        return {FILE: "\n".join([*(f"# {line}" for line in head), *rows]) + "\n"}

    def in_words(self) -> str:
        """Return what it is, and what the flights do not determine."""
        yaw, pitch, roll = Rotation.from_matrix(self.turn).as_euler("ZYX", degrees=True)
        x, y, z = self.shift
        about, off = (max(self.std[name] for name in names) for names in (FRAME[:3], FRAME[3:]))
        unsure = ", ".join(self.undetermined)
        limits = "0.5 degrees, 2 cm of the frame, 1 cm of the lever arm and 10 ms"
        return (
            "the ground truth is in another frame than the survey. It is moved to judge by, and "
            f"nodes get nothing of that: turned by yaw {yaw:.1f}, pitch {pitch:.1f}, roll "
            f"{roll:.1f} degrees (± {np.rad2deg(about):.1f}), then shifted by ({x:.3f}, {y:.3f}, "
            f"{z:.3f}) m (± {off:.3f} in the middle of the path). To apply it: {'; '.join(TO_APPLY)}."
            + f" Not determined within {limits}: {unsure}."
            * bool(unsure)
        )


# TDOAs d (n,) m of a flight, their Samples, and attitudes (n, 3, 3), None if unknown
_Part = tuple[np.ndarray, Samples, np.ndarray | None]


def moved_together(
    recorded: Sequence[Flight], settled: Sequence[Flight], count: int, base: EffectSet
) -> tuple[list[Flight], TruthTransform | None]:
    """Return the settled Flights, those in another frame moved jointly, and the TruthTransform.

    It is None if `settled` has no flight whose ground truth was turned or shifted.

    recorded, settled : Flights before and after `align_truth`
    count : of the first ones, that are fitted
    base : EffectSet of the model
    """
    found: dict[int, tuple[Flight, TruthTransform]] = {}
    for k, (one, other) in enumerate(zip(recorded, settled)):
        if one.truth is None or not len(one.tdoa):
            continue
        clocked = replace(one, truth=replace(one.truth, t=other.known_truth.t))
        start = rigid_transform(one.truth.p, other.known_truth.p)
        moved = transform_truth(one.truth, *start).p
        if np.abs(moved - other.known_truth.p).max() < ROUNDING < np.abs(moved - one.truth.p).max():
            found[k] = clocked, fitted([clocked], *start, base)
    if not found or min(found) >= count:
        return list(settled), None
    (first, common), *_ = found.values()
    found = {k: one for k, one in found.items() if not _differ(common, one[1], one[0].known_truth)}
    used = [flight for k, (flight, _) in found.items() if k < count]
    common = replace(
        fitted(used, common.turn, common.shift, base) if len(used) > 1 else common,
        late=recorded[min(found)].known_truth.t[0] - first.known_truth.t[0],
        flights=tuple(flight.name for flight, _ in found.values()),
    )
    out = {
        k: replace(settled[k], truth=transform_truth(one.known_truth, common.turn, common.shift))
        for k, (one, _) in found.items()
    }
    return [out.get(k, flight) for k, flight in enumerate(settled)], common


def fitted(
    flights: Sequence[Flight], turn: np.ndarray, shift: np.ndarray, base: EffectSet
) -> TruthTransform:
    """Return the TruthTransform of Flights with a ground truth on the clock of the TDOAs.

    turn, shift : (3, 3) and (3,) m to start from; base : EffectSet of the model
    """
    parts = [_rows(flight, turn, shift, base) for flight in flights]
    heard = np.unique(np.concatenate([[some.a, some.b] for _, some, _ in parts], axis=1))
    names = [*FRAME, "clock", *LEVER * all(turns is not None for *_, turns in parts)]
    first = len(names)
    names += [f"delay.{flights[0].anchors.ids[row]}" for row in heard]
    prior = np.diag([PRIOR.get(name, DELAY) ** -2.0 for name in names])
    middle = np.concatenate([some.p for _, some, _ in parts]).mean(axis=0)
    x, more = np.zeros(len(names)), np.eye(3)  # the turn goes on from `more`
    for _ in range(STEPS):
        made = [_equations(part, more, middle, x, heard, first) for part in parts]
        J, r = (np.concatenate(several) for several in zip(*made))
        scale = 1.4826 * np.median(np.abs(r)) + 1e-9
        weight = 1.0 / (scale**2 + 0.25 * r**2)
        inverse = np.linalg.inv(J.T @ (weight[:, None] * J) + prior)
        step = inverse @ (J.T @ (weight * r) - prior @ np.append(np.zeros(3), x[3:]))
        more = Rotation.from_rotvec(step[:3]).as_matrix() @ more
        x[3:] += step[3:]
    score = (weight * r)[:, None] * J
    blocks = [np.column_stack([0 * d + k, some.t // BLOCK]) for k, (d, some, _) in enumerate(parts)]
    block = np.unique(np.concatenate(blocks), axis=0, return_inverse=True)[1].reshape(-1)
    sums = np.stack([np.bincount(block, column) for column in score.T], axis=1)
    std = np.sqrt(np.maximum(np.diag(inverse @ (sums.T @ sums) @ inverse), np.diag(inverse)))
    return TruthTransform(
        more @ turn,
        more @ (shift - middle) + middle + x[3:6],
        0.0,
        dict(zip(names[6:], x[6:].tolist())),
        dict(zip(names, std.tolist())),
    )


def _rows(flight: Flight, turn: np.ndarray, shift: np.ndarray, base: EffectSet) -> _Part:
    truth = transform_truth(flight.known_truth, turn, shift)
    samples, rows = true_samples(replace(flight, truth=truth))
    _, begin, end = scored_phase(truth)
    d = flight.tdoa.d[rows] - base.bias(samples)
    used = (samples.t > begin) & (samples.t < end) & np.isfinite(d)
    of_rows = {k: v[used] for k, v in vars(samples).items() if isinstance(v, np.ndarray)}
    some = replace(samples, **of_rows)
    turns = Rotation.from_quat(some.q).as_matrix() if np.isfinite(some.q).all() else None
    return d[used], some, turns


def _equations(
    part: _Part, more: np.ndarray, middle: np.ndarray, x: np.ndarray, heard: np.ndarray, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian (n, k) and residual (n,) m of a flight."""
    (d, samples, turns), J = part, np.zeros((len(part[0]), len(x)))
    arms = np.zeros((len(d), 3)) if turns is None else turns @ x[7:10]
    away = (samples.p - middle + samples.velocity * x[6] + arms) @ more.T
    place = away + middle + x[3:6]
    slope = samples.position_jacobian(place)
    J[:, :3], J[:, 3:6] = np.cross(away, slope), slope
    J[:, 6] = np.sum(slope * (samples.velocity @ more.T), axis=1)
    if turns is not None:
        J[:, 7:10] = np.einsum("ni,nij->nj", slope @ more, turns)
    rows = np.arange(len(J))
    a, b = (first + np.searchsorted(heard, end) for end in (samples.a, samples.b))
    J[rows, b] += 1.0
    J[rows, a] -= 1.0
    return J, d - samples.predicted(place) - x[b] + x[a]


def _differ(first: TruthTransform, other: TruthTransform, truth: Truth) -> bool:
    """Return whether two transforms of a Truth differ by more than errors of a filter explain."""
    turn = first.turn @ other.turn.T
    middle = transform_truth(truth, other.turn, other.shift).p.mean(axis=0)
    apart = Alignment(0.0, None, np.eye(3), turn, first.shift - turn @ other.shift, middle)
    return apart.frame_differs
