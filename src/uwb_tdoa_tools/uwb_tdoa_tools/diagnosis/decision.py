"""Decide by one rule which share of each effect is applied.

Each effect displaces the estimated positions. A regression of the position errors of hold-out
flights on these displacements estimates the share of each effect that is valid in other flights:
1 if it is exact, 0 if it is unrelated to the errors. The remaining error of a flight correlates with
a displacement by chance and by other systematic errors. The standard deviation of this correlation
between flights, and a prior of the share, were measured on two splits of
`studies/diagnosis/measured.py` that no table reports. The posterior of the shares predicts the error of a future flight
(Gelman et al., Bayesian Data Analysis, 2013, chapter 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import ndtr

if TYPE_CHECKING:
    from collections.abc import Sequence

LOSS, RISK = 0.03, 0.05  # relative growth of the 3D RMSE of a flight, and its largest probability
RULE = (
    "Each effect is applied with the share that lowers the expected position error of a future "
    "flight most, down to nothing.",
    f"If that error rises by more than {100 * LOSS:.0f} % with a probability above "
    f"{100 * RISK:.0f} %, all shares shrink until the probability is below.",
)
# Prior of the share of an effect that other flights show, mean and standard deviation. Both, and the
# next constant, are from `0425 level` and `0426 three`.
VALID, VALID_STD = 0.75, 0.4
# Standard deviation, between flights, of the correlation of a displacement with the remaining error
CORRELATION = 0.25
LEAST_SHARE = 0.1  # a smaller share is nothing
# m, and share of the error; an effect that is worth less is not applied: it rounds to nothing
LEAST_WORTH, LEAST_OF_ERROR = 0.0005, 0.005
STEP = 0.1  # by which all shares shrink


@dataclass(frozen=True, eq=False)
class Decision:
    """The applied share of each effect, and the predicted change in a future flight.

    shares : (k,) 0 to 1; worth : (k,) m, growth of the mean 3D RMSE of the tried flights without it
    gain : expected relative decrease of the 3D RMSE of a future flight; std : its standard deviation
    risk : probability that it grows by more than LOSS
    """

    shares: np.ndarray
    worth: np.ndarray
    gain: float
    std: float
    risk: float


def risk(gain: float, std: float, loss: float = LOSS) -> float:
    """Return the probability that an error grows by more than `loss`.

    gain, std : relative decrease that is expected, and its standard deviation
    """
    return float(ndtr((-loss - gain) / max(std, 1e-12)))


def products(
    error: np.ndarray, displacements: Sequence[np.ndarray], change: np.ndarray
) -> np.ndarray:
    """Return the mean products of errors in a flight, (k + 2, k + 2) m^2, that `decide` needs.

    They are of the sum of the error and all displacements, of the displacements, and of the change.

    error : (n, 3) m, with all effects; displacements : k of (n, 3) m, change of the error without
        each; change : (n, 3) m, of the error without all
    """
    vectors = np.stack([error + sum(displacements), *displacements, change], axis=-1)
    return np.einsum("nxi,nxj->ij", vectors, vectors) / len(error)


def decide(flights: Sequence[np.ndarray], offered: np.ndarray | None = None) -> Decision:
    """Return the Decision on k effects from `products` of hold-out flights.

    offered : (k,) bool, effects that may be applied; None for all
    """
    count = len(flights[0]) - 2
    left = np.full(count, True) if offered is None else offered.copy()
    while True:
        shares = np.clip(_valid(flights, left), 0.0, 1.0)
        worth = np.mean([_worth(some, shares) for some in flights], axis=0)
        error = np.mean([np.sqrt(_power(some, _after(shares))) for some in flights])
        least = min(LEAST_WORTH, LEAST_OF_ERROR * float(error))
        small = left & ((shares < LEAST_SHARE) | (worth < least))
        if not small.any():
            break
        left[np.argmin(np.where(small, worth, np.inf))] = False
    nothing = Decision(np.zeros(count), worth, 0.0, 0.0, 0.0)
    if not shares.any():
        return nothing
    for factor in np.arange(1.0, 0.0, -STEP).tolist():
        gain, std, probability = _predicted(flights, shares, factor)
        if gain > 0.0 and probability < RISK:
            return Decision(factor * shares, worth, gain, std, probability)
    return nothing


def _valid(flights: Sequence[np.ndarray], left: np.ndarray) -> np.ndarray:
    """Return the posterior mean of the valid shares within 0 to 1, (k,).

    left : (k,) bool, effects that may be applied; the shares of the others are 0
    """
    valid = VALID * left
    for _ in range(2):  # the remaining error depends on the shares
        information = np.eye(len(left)) / VALID_STD**2
        vector = np.full(len(left), VALID / VALID_STD**2)
        for some in flights:
            weight = 1.0 / (CORRELATION**2 * _power(some, _after(valid)))
            information += weight * some[1:-1, 1:-1]
            vector += weight * some[0, 1:-1]
        root = np.linalg.cholesky(information)
        bounds = np.zeros(len(left)), np.where(left, 1.0, 1e-9)
        valid = lsq_linear(root.T, np.linalg.solve(root, vector), bounds).x
    return np.where(left, valid, 0.0)


def _after(shares: np.ndarray) -> np.ndarray:
    """Return the weights of `products` that give the error with some shares, (k + 2,)."""
    return np.concatenate([[1.0], -shares, [0.0]])


def _before(count: int) -> np.ndarray:
    """Return the weights of `products` that give the error without effects, (k + 2,)."""
    return np.concatenate([[1.0], -np.ones(count), [1.0]])


def _power(flight: np.ndarray, weights: np.ndarray) -> float:
    """Return the mean square of a sum with some weights of `products`, m^2."""
    return max(float(weights @ flight @ weights), 1e-12)


def _worth(flight: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return by how much the 3D RMSE grows without each effect, (k,) m.

    An effect that is not applied counts as if it were applied in full.
    """
    out = np.zeros(len(shares))
    for place, share in enumerate(shares):
        without, beside = shares.copy(), shares.copy()
        without[place], beside[place] = 0.0, share or 1.0
        out[place] = np.sqrt(_power(flight, _after(without))) - np.sqrt(
            _power(flight, _after(beside))
        )
    return out


def _predicted(
    flights: Sequence[np.ndarray], shares: np.ndarray, factor: float
) -> tuple[float, float, float]:
    """Return gain, std and risk in a future flight that is like one of `flights`.

    All effects together count as one, whose displacement is the change of the error by them.

    factor : share of this displacement that is applied
    """
    after = _after(shares)
    moved = _before(len(shares)) - after
    information, vector, known = VALID_STD**-2, VALID / VALID_STD**2, []
    for some in flights:
        left, size = _power(some, after), _power(some, moved)
        information += size / (CORRELATION**2 * left)
        vector += (size + float(after @ some @ moved)) / (CORRELATION**2 * left)
        known.append((left, size))
    valid, rows = vector / information, []
    for left, size in known:
        before = left + valid**2 * size
        change = (factor**2 - 2.0 * factor * valid) * size / before
        variance = size**2 / information + CORRELATION**2 * left * size
        std, ratio = 2.0 * factor * np.sqrt(variance) / before, np.sqrt(max(1.0 + change, 1e-12))
        rows.append((1.0 - ratio, 0.5 * std / ratio, risk(-change, std, (1.0 + LOSS) ** 2 - 1.0)))
    gain, std, probability = np.mean(rows, axis=0).tolist()
    return gain, std, probability
