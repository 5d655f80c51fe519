"""What is known of positions and delays of anchors, and which of them have changed: by evidence.

The last calibration holds where nothing has changed since. What has, an anchor that was moved, a
module that was replaced, is found by evidence (MacKay, Bayesian interpolation, Neural Computation
1992), one change after the other, as long as each makes the data more probable by a given factor.
`survey` asks once, of whole flights; the monitor of ekf_node asks while it flies.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.effects.effect_set import Covariance

    ChangeKey = tuple[str, int]  # effect, number of an anchor
    Change = tuple[np.ndarray, float]  # places (m,) among the unknowns, m, standard deviation

DRIFT = 0.005  # m, by which anything may be off since the last calibration without having changed
MOVED, LATER = 0.3, 0.2  # m, standard deviations of changes: of each coordinate, of a delay
ODDS = 100.0  # by how much more probable a change must make flights
OF_ANCHORS = POSITION, DELAY = "anchor_position", "anchor_delay"


class Part(NamedTuple):
    """Normal equations about the mean of a prior: gram (n, n), vector (n,); rest : logarithm of the
    evidence of what was integrated out; std : m, of that.
    """

    gram: np.ndarray
    vector: np.ndarray
    rest: float
    std: float


class Changes(NamedTuple):
    """found : {key: (logarithm of the odds of that change, keys of other changes that the data
    cannot tell from it, of its anchor or of others that are not found themselves, the most probable
    first)}; covariance (n, n) m^2 : of the prior with them; number : of the Part with the largest
    evidence.
    """

    found: dict[ChangeKey, tuple[float, list[ChangeKey]]]
    covariance: np.ndarray
    number: int


def keys_of(ids: Iterable[Any]) -> tuple[tuple[str, str], ...]:
    """((effect, parameter), ...) of all coordinates and delays of anchors."""
    return (
        *((POSITION, f"{i}.{axis}") for i in ids for axis in "xyz"),
        *((DELAY, str(i)) for i in ids),
    )


def known_before(
    ids: Iterable[Any], variance: np.ndarray, last: Covariance | None
) -> tuple[np.ndarray, np.ndarray]:
    """(covariance (4N, 4N) m^2 of coordinates, anchor by anchor, and of delays; which of them the
    last calibration states, (4N,) bool).
    variance : (4N,) m^2, of those that it does not; last : Covariance of it, or None.
    """
    covariance, known = np.diag(variance), np.zeros(len(variance), dtype=bool)
    if last is not None:
        places, of_last = last.of(keys_of(ids))
        covariance[np.ix_(places, places)] = of_last + DRIFT**2 * np.eye(len(places))
        known[places] = True
    return covariance, known


def changes_of(n: int) -> dict[ChangeKey, Change]:
    """{key: Change} of what may have changed of n anchors."""
    out: dict[ChangeKey, Change] = {}
    for k in range(n):
        out[POSITION, k] = np.arange(3 * k, 3 * k + 3), MOVED
        out[DELAY, k] = np.array([3 * n + k]), LATER
    return out


def eliminated(
    gram: np.ndarray, vector: np.ndarray, n: int, sizes: ArrayLike
) -> tuple[np.ndarray, np.ndarray, float]:
    """(gram (n, n), vector (n,), logarithm of the evidence of the rest): normal equations with what
    comes after the first n unknowns integrated out, whose standard deviations are `sizes`, a number
    or one for each.
    """
    informed = n + np.flatnonzero(np.diagonal(gram)[n:] > 0.0)  # the others add nothing
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


def log_evidence(part: Part, prior: np.ndarray, size: float, offset: np.ndarray) -> float:
    """Logarithm of the evidence of a Part whose prior has the inverse covariance `prior` (n, n) and
    the logarithm of its determinant `size`; offset (n,) m : where the equations were made, from the
    mean of the prior.
    """
    right, root = part.vector - prior @ offset, np.linalg.cholesky(part.gram + prior)
    solved = solve_triangular(root, right, lower=True, check_finite=False)
    return part.rest + 0.5 * float(
        solved @ solved - 2.0 * np.sum(np.log(np.diagonal(root))) - size - offset @ prior @ offset
    )


def most_probable(
    parts: Sequence[Part], covariance: np.ndarray, offset: np.ndarray
) -> tuple[float, int]:
    """(logarithm of the evidence, number) of the Part with the largest, with a prior of some
    covariance (n, n) m^2.
    """
    known = np.linalg.inv(covariance), float(np.linalg.slogdet(covariance)[1])
    return max((log_evidence(part, *known, offset), k) for k, part in enumerate(parts))


def with_each_change(
    parts: Sequence[Part],
    covariance: np.ndarray,
    offset: np.ndarray,
    changes: Mapping[ChangeKey, Change],
) -> dict[ChangeKey, float]:
    """{key: the largest evidence with that change of `changes` more}: in closed form, by what the
    data say of a shift of the prior's mean.
    """
    prior, size, out = (
        np.linalg.inv(covariance),
        float(np.linalg.slogdet(covariance)[1]),
        dict.fromkeys(changes, -np.inf),
    )
    for part in parts:
        evidence, inverse = (
            log_evidence(part, prior, size, offset),
            np.linalg.inv(part.gram + prior),
        )
        slope = prior @ (offset + inverse @ (part.vector - prior @ offset))
        information = prior - prior @ inverse @ prior
        for key, (places, std) in changes.items():
            some = information[np.ix_(places, places)]
            more = slope[places] @ np.linalg.solve(
                some + np.eye(len(places)) / std**2, slope[places]
            )
            more -= np.linalg.slogdet(np.eye(len(places)) + std**2 * some)[1]
            out[key] = max(out[key], evidence + 0.5 * float(more))
    return out


def most_likely_changes(
    parts: Sequence[Part],
    unchanged: np.ndarray,
    offset: np.ndarray,
    possible: Mapping[ChangeKey, Change],
    odds: float = ODDS,
) -> Changes:
    """Changes, one after the other, as long as each makes the data `odds` times as probable.
    unchanged (n, n) m^2 : covariance without any;
    possible : {key: Change}.
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
    """Return Changes.found without rivals of other anchors that are found themselves."""
    rows = {row for _, row in found}
    return {
        key: (odds, [one for one in rivals if one[1] == key[1] or one[1] not in rows])
        for key, (odds, rivals) in found.items()
    }
