"""The surroundings of the anchors, where a tag is expected: a box along the axes of the world."""

from uwb_tdoa_bias.foundation.compiled import compiled

from .update import update_state

SMALLEST = 3.0  # m from the middle of the anchors to each bound at least, however flat they lie
STD = 1.0  # m, of the pseudo-measurement that a tag outside is at the bound, once with each TDOA


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
def constrain(hypothesis, innovation, bounds, axis):
    """Soft constraint of one axis: pull a tag that is outside towards its workspace. Returns whether it was.

    Wrong TDOAs, e.g. late arrivals on a floor, are often explained best by a tag far away.
    """
    x = hypothesis.x[axis]
    if bounds[0, axis] <= x <= bounds[1, axis]:
        return False
    update_state(hypothesis, innovation, axis, min(max(x, bounds[0, axis]), bounds[1, axis]), STD)
    return True
