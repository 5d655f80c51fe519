"""The surroundings of the anchors, where a tag is expected: a box along the axes of the world."""

from uwb_tdoa_bias.foundation.compiled import compiled

from .update import update_state

SMALLEST = 3.0  # m from the middle of the anchors to each bound at least, however flat they lie
STD = 1.0  # m, of what is known before anything is measured: a tag outside is at the bound


@compiled
def set_bounds(anchors, margin, bounds):
    """Write the lower and upper bounds, m, to `bounds` (2, 3): `margin` beyond the anchors (N,) of ANCHOR."""
    for k in range(3):
        low = high = anchors[0].position[k]
        for i in range(1, len(anchors)):
            low, high = min(low, anchors[i].position[k]), max(high, anchors[i].position[k])
        middle, half = 0.5 * (low + high), max(0.5 * (high - low) + margin, SMALLEST)
        bounds[0, k], bounds[1, k] = middle - half, middle + half


@compiled
def contains(bounds, x):
    """True if position x (3,), m, is within `bounds` (2, 3)."""
    for k in range(3):
        if not bounds[0, k] <= x[k] <= bounds[1, k]:
            return False
    return True


@compiled
def is_filled(bounds, P):
    """True if a tag whose error has covariance P may be anywhere in `bounds` (2, 3): its standard deviation exceeds their diagonal."""
    spread = size = 0.0
    for k in range(3):
        spread += P[k, k]
        size += (bounds[1, k] - bounds[0, k]) ** 2
    return spread > size


@compiled
def constrain(hypothesis, innovation, bounds, axis):
    """Soft constraint of one axis: pull a tag that is outside towards its workspace. Returns whether it was.

    Only while less is known of the axis: what is told once is not told better by being repeated, and TDOAs that agree on a place
    outside are right.
    """
    x = hypothesis.x[axis]
    if bounds[0, axis] <= x <= bounds[1, axis] or hypothesis.P[axis, axis] <= STD**2:
        return False
    update_state(hypothesis, innovation, axis, min(max(x, bounds[0, axis]), bounds[1, axis]), STD)
    return True
