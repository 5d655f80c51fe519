# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measurement noise, how alike successive errors are, and the covariance of persisting errors.

The filter learns the noise of each anchor, and of a motion without inertial sensor, from its
innovations. Ranges alone keep the prior. The error of a TDOA is white noise plus an error that changes as the tag moves on: a
reflection, a delay. The filter learns the sum of both variances, and the share of the second.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .ground import inverse

# Noise of each anchor.
LARGEST_OUTLIER = 5.0  # standard deviations; limits the effect of an outlier
# largest share of a new innovation in the variance of an anchor: ten innovations show more than a
# single one
LARGEST_STEP = 0.1

# Persisting errors.
SHARE = 0.5  # prior share of the variance of a TDOA that persists, by delays and antennas
# s over which variance and persisting share are learned, least number of TDOAs, least variance over
# the stated one
LEARNED_OVER, FEWEST, LEAST_RATIO = (5.0, 20.0, 0.05)
SLOWER = 2.0  # factor on the first two for the persisting share, which scatters more
# a position follows the errors of so many anchors, so that innovations do not show them
FREE = 4
LIMIT = 3.0  # standard deviations to which an innovation is limited for the share

# Motion without inertial samples: step of the logarithm of its power for a TDOA, weight of the
# likelihood, s over which corrections of the velocity are compared.
STEP, OF_LIKELIHOOD, COMPARED = (0.1, 0.5, 0.5)
# Bounds of the power, relative to motion_noise squared: least at rest, least in motion, largest.
LEAST_AT_REST, LEAST_POWER, MOST_POWER = (1e-5, 0.01, 100.0)
# Rest. The normalized square of the velocity is below SIGNIFICANT, the speed below SLOW, m/s, and the
# standard deviation of the position below PLACED, m.
SIGNIFICANT, SLOW, PLACED = (9.0, 0.2, 1.0)
# Begin of a motion. At least COUNTED corrections of the velocity count, each limited to
# LARGEST_CORRECTION standard deviations. The square of their sum exceeds MOVED times its variance. The
# tag has then moved for BEGUN, s.
COUNTED, LARGEST_CORRECTION, MOVED, BEGUN = (5.0, 4.0, 7.0, 0.6)
LARGEST_NIS = 6.0  # normalized innovation squared; limits the effect of an outlier
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
def learn_persistence(ekf: Record, last: float, t: float, innovation: Record) -> float:
    """Update noise_ratio, squared and persistent of the EKF, and return the limited innovation, m.

    An error that persists in an anchor makes its successive innovations alike: the mean product of
    two is its variance. An innovation tells the less, the more uncertain its prediction is.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    last : float
        Sum of the last innovations of the anchors, each with its sign in this measurement, m.
    t : float
        Stamp, s.
    innovation : INNOVATION
        Innovation of the TDOA.
    """
    noise, prior, dt = innovation.noise_variance, innovation.prior_variance, t - ekf.last_tdoa
    trust = (noise / (noise + prior)) ** 2
    squared = min(innovation.value**2, LARGEST_OUTLIER**2 * noise)
    step = min(1.0 / FEWEST, dt / LEARNED_OVER)
    ekf.noise_ratio += step * trust * ((squared - prior) / noise - ekf.noise_ratio)
    ekf.noise_ratio = min(max(ekf.noise_ratio, LEAST_RATIO), 1.0)
    most = LIMIT * math.sqrt(noise + prior)
    value = min(max(innovation.value, -most), most)
    ekf.squared += step / SLOWER * (trust * value * value / noise - ekf.squared)
    ekf.persistent += step / SLOWER * (trust * value * last / noise - ekf.persistent)
    return value


@compiled
def persisting_share(ekf: Record, parameters: Record) -> float:
    """Return the share of the stated variance of a TDOA that persists, 0 to 1."""
    if not parameters.adapt_noise:
        return 0.0
    return min(1.0, max(0.0, ekf.persistent) / max(ekf.squared, 1e-6)) * ekf.noise_ratio


@compiled
def variance_inflation(ekf: Record, parameters: Record) -> float:
    """Return the factor on the stated variance of a TDOA or range in an update.

    It is noise_ratio, plus the persisting share times a number of TDOAs with the same error. Errors
    of every duration occur, up to tdoa_correlation_time and tdoa_correlation_distance. So it is the
    square root of the number of TDOAs within both. This power was set on measured flights, at 5 to
    400 TDOAs a second. What persists is in the consider covariance: a tag at rest averages.
    """
    if not parameters.adapt_noise:
        return 1.0
    x = ekf.hypotheses[ekf.best].x
    speed = math.sqrt(x[3] ** 2 + x[4] ** 2 + x[5] ** 2)
    alike = parameters.tdoa_correlation_time
    if alike * speed > parameters.tdoa_correlation_distance:
        alike = parameters.tdoa_correlation_distance / speed
    count = math.sqrt(ekf.tdoa_rate * alike)
    return ekf.noise_ratio + persisting_share(ekf, parameters) * count


@compiled
def learn_motion(ekf: Record, parameters: Record, t: float, innovation: Record) -> None:
    """Update motion_ratio of the EKF after an update without inertial samples.

    Corrections of the velocity are independent if the power of the random acceleration is right,
    alike if it is too small, and opposite if it is too large (Mehra, IEEE Trans. Automatic Control
    1970). The likelihood of the innovation judges it where the prediction is uncertain. While the
    velocity is zero within its deviation, the power falls, as fast as the filter averages: the
    position of a tag at rest averages. If the recent corrections together are larger than their
    deviation, the tag has begun to move, and the covariance grows as if it had done so BEGUN ago.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    innovation : INNOVATION
        Innovation after the update.
    """
    dt, recent = t - ekf.last_tdoa, ekf.velocity_change
    kept = 1.0 - min(dt / COMPARED, 1.0 / COUNTED)
    prior = innovation.prior_variance
    total = prior + innovation.noise_variance * innovation.variance_inflation
    independent = prior + parameters.tdoa_std**2 * ekf.noise_ratio
    size = min(abs(innovation.value), LARGEST_CORRECTION * math.sqrt(independent))
    product = one = other = 0.0
    for k in range(3):
        change = innovation.cross_covariance[3 + k] / total * math.copysign(size, innovation.value)
        product += change * recent[k]
        one += change * change
        other += recent[k] ** 2
        recent[k] = kept * recent[k] + change
    ekf.change_variance = kept**2 * ekf.change_variance + one / max(size**2, 1e-30) * independent
    alike = product / math.sqrt(one * other + 1e-30)
    slope = 0.5 * prior / total * (min(innovation.value**2 / total, LARGEST_NIS) - 1.0)
    power = ekf.motion_ratio * math.exp(STEP * (alike + OF_LIKELIHOOD * slope))
    x, P = ekf.hypotheses[ekf.best].x, ekf.hypotheses[ekf.best].P
    speed, place = x[3] ** 2 + x[4] ** 2 + x[5] ** 2, P[0, 0] + P[1, 1] + P[2, 2]
    alone = not t - ekf.velocity.heard < COMPARED  # no sensor of velocities shows rest and motion
    if not alone or (x[3] ** 2 / P[3, 3] + x[4] ** 2 / P[4, 4] + x[5] ** 2 / P[5, 5] > SIGNIFICANT):
        power = max(power, LEAST_POWER)
    elif speed < SLOW**2 and place < PLACED**2:
        power *= math.exp(-dt * math.sqrt((P[3, 3] + P[4, 4] + P[5, 5]) / place))
    # left: square of the sum of the corrections
    square = kept**2 * other + 2.0 * kept * product + one
    if alone and power < 1.0 and square > MOVED * ekf.change_variance:
        power, ekf.change_variance, recent[:] = 1.0, 0.0, 0.0
        psd = parameters.motion_noise**2
        widen(ekf, BEGUN**3 / 3.0 * psd, BEGUN * psd)
    ekf.motion_ratio = min(max(power, LEAST_AT_REST), MOST_POWER)


@compiled
def widen(ekf: Record, of_position: float, of_velocity: float) -> None:
    """Add variances to each axis of position, m^2, and velocity, m^2/s^2, of every hypothesis."""
    for h in range(len(ekf.hypotheses)):
        for k in range(3):
            ekf.hypotheses[h].P[k, k] += of_position
            ekf.hypotheses[h].P[3 + k, 3 + k] += of_velocity


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
    share: float,
    height_std: float,
    bounds: np.ndarray,
    covariance: np.ndarray,
) -> None:
    """Compute the covariance of the position caused by persisting errors (consider covariance).

    White noise (share 0) leaves no persisting error. A held height does not follow these errors, so it
    reduces them.

    Parameters
    ----------
    information : (3, 3) array
        From `observe`, 1/m^2.
    P : (15, 15) array
        Covariance of the error state.
    share : float
        Share of the variance of a TDOA that persists, from `persisting_share`.
    height_std : float
        Standard deviation of a held height, m; 0 if no height is held.
    bounds : (2, 3) array
        Workspace, m, world frame: the prior where anchors tell little.
    covariance : (3, 3) array
        Consider covariance, m^2. Filled.
    """
    covariance[:, :] = 0.0
    if share == 0.0:
        return
    total = (
        information / share + inverse(P[:3, :3]) / MOST + np.diag((bounds[1] - bounds[0]) ** -2.0)
    )
    if height_std > 0.0:
        total[2, 2] += 1.0 / height_std**2
    of_total = inverse(total)
    if not of_total[0, 0] > 0.0:
        return
    covariance[:, :] = of_total
    if height_std > 0.0:  # a held height adds information but no persisting error
        covariance -= np.outer(of_total[:, 2] * (1.0 / height_std**2), of_total[2])
