# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measurement noise of each anchor, and the covariance of persisting errors.

The filter learns the noise of each anchor from its innovations.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .ground import inverse

# Noise of each anchor.
LARGEST_OUTLIER = 5.0  # standard deviations; limits the effect of an outlier
# largest share of a new innovation in the variance of an anchor: ten innovations show more than a
# single one
LARGEST_STEP = 0.1

# Persisting errors.
# share of the variance of a TDOA that persists where its errors are correlated: delays and antennas
# cause errors as large as the noise
SHARE = 0.5
MEMORY = 1.0  # s of TDOAs that count; an anchor that was silent for longer counts as absent
# s; limits the decay, because silence does not remove the information from anchors
LONGEST_STEP = 0.1
# largest ratio of the added covariance to the covariance of the filter, because anchors are not the
# only source of position
MOST = 400.0


@compiled
def learn(a: Record, b: Record, t: float, innovation: Record, parameters: Record) -> None:
    """Update the excess variance of two anchors with an innovation.

    An anchor that is received late, e.g. around an obstacle, disturbs every pair that contains it.
    So the filter averages per anchor, exponentially over noise_memory. The excess of a pair is
    divided between its anchors in proportion to the noise learned so far.

    Parameters
    ----------
    a, b : ANCHOR
        Anchors of the TDOA, updated in place.
    t : float
        Stamp of the TDOA, s.
    innovation : INNOVATION
        Innovation of the TDOA. It shows by how much noise_variance is too small or too large.
    parameters : PARAMETERS
        Tuning of the filter.
    """
    noise = innovation.noise_variance
    squared = min(innovation.value**2, LARGEST_OUTLIER**2 * noise)
    excess = squared - innovation.prior_variance - noise
    base = 0.5 * parameters.tdoa_std**2
    whole = a.excess_variance + b.excess_variance + 2.0 * base
    _learn_one(a, t, (a.excess_variance + base) / whole * excess, parameters.noise_memory)
    _learn_one(b, t, (b.excess_variance + base) / whole * excess, parameters.noise_memory)


# Update the excess variance of an ANCHOR by its share of the excess, m^2. memory is in s.
@compiled
def _learn_one(anchor: Record, t: float, excess: float, memory: float) -> None:
    step = (
        min(LARGEST_STEP, max(0.0, t - anchor.learned) / memory)
        if anchor.learned > -np.inf
        else 1.0
    )
    anchor.excess_variance = max(0.0, anchor.excess_variance + step * excess)
    anchor.learned = t


@compiled
def begin(information: np.ndarray, P: np.ndarray) -> None:
    """Initialize the information matrix of `observe` at the start of the filter.

    Parameters
    ----------
    information : (3, 3) array
        Information of the position, 1/m^2. Filled.
    P : (15, 15) array
        Covariance of the error state. The start has counted each anchor once.
    """
    information[:, :] = SHARE * inverse(P[:3, :3])


@compiled
def observe(
    information: np.ndarray, a: Record, b: Record, innovation: Record, t: float, previous: float
) -> None:
    """Update the information that one arrival from each heard anchor gives about the position.

    The information is forgotten over MEMORY. However often an anchor is heard in this time, it counts
    once. A TDOA has two arrivals, and counts with its own measurement noise.

    Parameters
    ----------
    information : (3, 3) array
        Information of the position, 1/m^2, updated in place.
    a, b : ANCHOR
        Anchors of the TDOA; `heard` is updated. For a range both are the same anchor.
    innovation : INNOVATION
        Innovation after the update.
    t : float
        Stamp of the TDOA, s.
    previous : float
        Stamp of the TDOA before, s.
    """
    forgotten = min(t - previous, LONGEST_STEP) / MEMORY
    # The silence of an anchor before each arrival, as a share of MEMORY, sums to 1 over MEMORY.
    share = 0.5 * (min(t - a.heard, MEMORY) + min(t - b.heard, MEMORY)) / MEMORY
    a.heard = b.heard = t
    gain = share * innovation.weight / (innovation.noise_variance + innovation.curvature / SHARE)
    for i in range(3):
        for j in range(3):
            information[i, j] += (
                gain * innovation.row[i] * innovation.row[j] - forgotten * information[i, j]
            )


@compiled
def fill(
    information: np.ndarray,
    P: np.ndarray,
    correlation_length: float,
    height_std: float,
    covariance: np.ndarray,
) -> None:
    """Compute the covariance of the position caused by persisting errors (consider covariance).

    White noise (correlation_length 1) leaves no persisting error. A held height does not follow
    these errors, so it reduces them.

    Parameters
    ----------
    information : (3, 3) array
        From `observe`, 1/m^2.
    P : (15, 15) array
        Covariance of the error state.
    correlation_length : float
        Number of successive TDOAs that count as a single independent one.
    height_std : float
        Standard deviation of a held height, m; 0 if no height is held.
    covariance : (3, 3) array
        Consider covariance, m^2. Filled.
    """
    covariance[:, :] = 0.0
    share = SHARE * (1.0 - 1.0 / max(correlation_length, 1.0))
    if share == 0.0:
        return
    total = information / share + inverse(P[:3, :3]) / MOST
    if height_std > 0.0:
        total[2, 2] += 1.0 / height_std**2
    of_total = inverse(total)
    if not of_total[0, 0] > 0.0:
        return
    covariance[:, :] = of_total
    if height_std > 0.0:  # a held height adds information but no persisting error
        covariance -= np.outer(of_total[:, 2] * (1.0 / height_std**2), of_total[2])
