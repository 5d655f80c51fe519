# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find which anchor positions and delays have changed since the last calibration, by evidence.

A calibration holds until an anchor is moved or a module is replaced. The search adds one change at
a time. It stops when no further change raises the evidence by a given factor (MacKay, Bayesian
interpolation, Neural Computation 1992).

`survey` runs the search once, on whole flights. The monitor of ekf_node runs it in flight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from uwb_tdoa_bias.effects.effect_set import Covariance

ChangeKey = tuple[str, int]  # effect, number of an anchor
Change = tuple[np.ndarray, float]  # places (m,) among the unknowns, m, standard deviation

# m, standard deviation of the drift that every coordinate and delay may have without a change
DRIFT = 0.005
MOVED, LATER = 0.3, 0.2  # m, standard deviation of a change: of each coordinate, of a delay
# m, length scale of the error of an anchor as a smooth function of the place
FUNCTION_LENGTH = 1.2
# m, candidate standard deviations of unknown delays
DELAY_STDS = (0.02, 0.05, 0.1, 0.2, 0.4)
ODDS = 100.0  # factor by which a change must raise the probability of the data
OF_ANCHORS = POSITION, DELAY = "anchor_position", "anchor_delay"


class Part(NamedTuple):
    """Store normal equations about the mean of a prior.

    Attributes
    ----------
    gram : (n, n) array
        Information matrix, in 1/m^2.
    vector : (n,) array
        Right-hand side, in 1/m.
    rest : float
        Logarithm of the evidence of the unknowns that were marginalized.
    std : float
        Standard deviation of these unknowns, in m.
    """

    gram: np.ndarray
    vector: np.ndarray
    rest: float
    std: float


class Changes(NamedTuple):
    """Store the changes that the evidence supports.

    Attributes
    ----------
    found : dict
        {key: (log odds of the change, rivals)}. Rivals are keys of other changes that the data do
        not distinguish from it, the most probable first. They belong to the same anchor, or to
        anchors without a change in `found`.
    covariance : (n, n) array
        Covariance of the prior with these changes, in m^2.
    number : int
        Number of the Part with the largest evidence.
    """

    found: dict[ChangeKey, tuple[float, list[ChangeKey]]]
    covariance: np.ndarray
    number: int


def keys_of(ids: Iterable[Any]) -> tuple[tuple[str, str], ...]:
    """Return ((effect, parameter), ...) of all anchor coordinates, then of all anchor delays."""
    return (
        *((POSITION, f"{i}.{axis}") for i in ids for axis in "xyz"),
        *((DELAY, str(i)) for i in ids),
    )


def known_before(
    ids: Iterable[Any], variance: np.ndarray, last: Covariance | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior covariance of coordinates and delays, and which the calibration states.

    Parameters
    ----------
    ids : iterable
        Ids of N anchors.
    variance : (4N,) array
        Variance of each unknown without a calibration, in m^2.
    last : Covariance or None
        Covariance of the last calibration.

    Returns
    -------
    covariance : (4N, 4N) array
        In m^2; coordinates anchor by anchor, then delays.
    known : (4N,) bool array
        True for unknowns that the last calibration states.
    """
    covariance, known = np.diag(variance), np.zeros(len(variance), dtype=bool)
    if last is not None:
        places, of_last = last.of(keys_of(ids))
        covariance[np.ix_(places, places)] = of_last + DRIFT**2 * np.eye(len(places))
        known[places] = True
    return covariance, known


def changes_of(n: int) -> dict[ChangeKey, Change]:
    """Return {key: Change} of every possible change of n anchors."""
    out: dict[ChangeKey, Change] = {}
    for k in range(n):
        out[POSITION, k] = np.arange(3 * k, 3 * k + 3), MOVED
        out[DELAY, k] = np.array([3 * n + k]), LATER
    return out


def eliminated(
    gram: np.ndarray, vector: np.ndarray, n: int, sizes: ArrayLike
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return normal equations of the first n unknowns, with all later unknowns marginalized.

    Parameters
    ----------
    gram : (m, m) array
        Information matrix of all unknowns, m >= n.
    vector : (m,) array
        Right-hand side.
    n : int
        Number of unknowns to keep.
    sizes : float or (m - n,) array
        Prior standard deviation of each marginalized unknown.

    Returns
    -------
    gram : (n, n) array
        Information matrix of the kept unknowns.
    vector : (n,) array
        Right-hand side of the kept unknowns.
    evidence : float
        Logarithm of the evidence of the marginalized unknowns.
    """
    informed = n + np.flatnonzero(np.diagonal(gram)[n:] > 0.0)  # unknowns without data add nothing
    sizes, cross = np.broadcast_to(sizes, len(gram) - n)[informed - n], gram[:n, informed]
    root = np.linalg.cholesky(gram[np.ix_(informed, informed)] + np.diag(sizes**-2.0))
    solved = solve_triangular(
        root, np.column_stack([cross.T, vector[informed]]), lower=True, check_finite=False
    )
    evidence = (
        solved[:, -1] @ solved[:, -1]
        - 2.0 * np.sum(np.log(np.diagonal(root)))
        - 2.0 * np.sum(np.log(sizes))
    )
    less = solved[:, :-1].T @ solved
    return gram[:n, :n] - less[:, :-1], vector[:n] - less[:, -1], 0.5 * evidence


def log_evidence(part: Part, prior: np.ndarray, log_det: float, offset: np.ndarray) -> float:
    """Return the logarithm of the evidence of a Part.

    Parameters
    ----------
    part : Part
        Normal equations.
    prior : (n, n) array
        Inverse covariance of the prior, in 1/m^2.
    log_det : float
        Logarithm of the determinant of the prior covariance.
    offset : (n,) array
        Linearization point minus mean of the prior, in m.
    """
    right, root = part.vector - prior @ offset, np.linalg.cholesky(part.gram + prior)
    solved = solve_triangular(root, right, lower=True, check_finite=False)
    return part.rest + 0.5 * float(
        solved @ solved
        - 2.0 * np.sum(np.log(np.diagonal(root)))
        - log_det
        - offset @ prior @ offset
    )


def most_probable(
    parts: Sequence[Part], covariance: np.ndarray, offset: np.ndarray
) -> tuple[float, int]:
    """Return (log evidence, number) of the Part with the largest evidence.

    Parameters
    ----------
    parts : sequence of Part
        Normal equations to compare.
    covariance : (n, n) array
        Covariance of the prior, in m^2.
    offset : (n,) array
        Linearization point minus mean of the prior, in m.
    """
    known = np.linalg.inv(covariance), float(np.linalg.slogdet(covariance)[1])
    return max((log_evidence(part, *known, offset), k) for k, part in enumerate(parts))


def smallest_delays(
    parts: Sequence[Part], prior: Callable[[float], np.ndarray], offset: np.ndarray
) -> float:
    """Return the smallest of DELAY_STDS with at least 1 / ODDS of the largest probability, in m.

    A small size matters, because delays absorb errors of other causes.

    Parameters
    ----------
    parts : sequence of Part
        Normal equations.
    prior : callable
        prior(std) is the covariance (n, n), in m^2, if unknown delays have this standard deviation.
    offset : (n,) array
        Linearization point minus mean of the prior, in m.
    """
    evidences = [most_probable(parts, prior(std), offset)[0] for std in DELAY_STDS]
    least = max(evidences) - np.log(ODDS)
    return next(std for std, evidence in zip(DELAY_STDS, evidences) if evidence >= least)


def with_each_change(
    parts: Sequence[Part],
    covariance: np.ndarray,
    offset: np.ndarray,
    changes: Mapping[ChangeKey, Change],
) -> dict[ChangeKey, float]:
    """Return {key: largest log evidence over the Parts} with each change added to the prior.

    A change shifts the prior mean of some unknowns, and the data determine the shift. The log
    evidence is quadratic in the shift, so its marginal has a closed form.

    Parameters
    ----------
    parts : sequence of Part
        Normal equations.
    covariance : (n, n) array
        Covariance of the prior without the change, in m^2.
    offset : (n,) array
        Linearization point minus mean of the prior, in m.
    changes : mapping
        {key: Change} to try.
    """
    prior, log_det = np.linalg.inv(covariance), float(np.linalg.slogdet(covariance)[1])
    out = dict.fromkeys(changes, -np.inf)
    for part in parts:
        evidence = log_evidence(part, prior, log_det, offset)
        posterior = np.linalg.inv(part.gram + prior)
        # gradient and negative Hessian of the log evidence by a shift of the prior mean
        gradient = prior @ (offset + posterior @ (part.vector - prior @ offset))
        information = prior - prior @ posterior @ prior
        for key, (places, std) in changes.items():
            of_change = information[np.ix_(places, places)]
            twice_gain = gradient[places] @ np.linalg.solve(
                of_change + np.eye(len(places)) / std**2, gradient[places]
            )
            twice_gain -= np.linalg.slogdet(np.eye(len(places)) + std**2 * of_change)[1]
            out[key] = max(out[key], evidence + 0.5 * float(twice_gain))
    return out


def most_likely_changes(
    parts: Sequence[Part],
    unchanged: np.ndarray,
    offset: np.ndarray,
    possible: Mapping[ChangeKey, Change],
    odds: float = ODDS,
) -> Changes:
    """Return the changes that the data support, found one at a time.

    A change is added while it makes the data `odds` times more probable.

    Parameters
    ----------
    parts : sequence of Part
        Normal equations.
    unchanged : (n, n) array
        Covariance of the prior without any change, in m^2.
    offset : (n,) array
        Linearization point minus mean of the prior, in m.
    possible : mapping
        {key: Change} of the changes to consider.
    odds : float
        Factor that a change must reach.

    Returns
    -------
    changes : Changes
        Changes found, and the prior that includes them.
    """
    covariance = unchanged
    found: dict[ChangeKey, tuple[float, list[ChangeKey]]] = {}
    evidence, number = most_probable(parts, covariance, offset)
    while len(found) < len(possible):
        trials = with_each_change(
            parts, covariance, offset, {key: possible[key] for key in possible if key not in found}
        )
        key = max(trials, key=trials.__getitem__)
        if trials[key] < evidence + np.log(odds):
            break
        doubt = trials[key] - np.log(odds)
        rivals = [other for other in trials if other != key and trials[other] > doubt]
        found[key] = trials[key] - evidence, sorted(rivals, key=trials.__getitem__, reverse=True)
        covariance = unchanged.copy()
        for places, std in (possible[one] for one in found):
            covariance[places, places] += std**2
        evidence, number = most_probable(parts, covariance, offset)
    return Changes(_without_named(found), covariance, number)


def _without_named(
    found: Mapping[ChangeKey, tuple[float, list[ChangeKey]]],
) -> dict[ChangeKey, tuple[float, list[ChangeKey]]]:
    """Return Changes.found without rivals on other anchors that have a change of their own."""
    rows = {row for _, row in found}
    return {
        key: (odds, [one for one in rivals if one[1] == key[1] or one[1] not in rows])
        for key, (odds, rivals) in found.items()
    }
