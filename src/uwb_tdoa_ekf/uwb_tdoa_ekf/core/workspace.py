"""The surroundings of the anchors, where a tag is expected: a box along the axes of the world."""

from uwb_tdoa_bias.foundation.compiled import compiled

from .update import update_state

SMALLEST = 3.0  # m from the middle of the anchors to each bound at least, however flat they lie
STD = 1.0  # m, of the pseudo-measurement that draws a tag back, each time a TDOA says that it is outside


@compiled
def bounds(anchors, margin, out):
    """Write the lower and upper bounds, m, to out (2, 3): `margin` beyond the anchors (N,) of ANCHOR."""
    for k in range(3):
        low = high = anchors[0].position[k]
        for i in range(1, len(anchors)):
            low, high = min(low, anchors[i].position[k]), max(high, anchors[i].position[k])
        middle, half = 0.5 * (low + high), max(0.5 * (high - low) + margin, SMALLEST)
        out[0, k], out[1, k] = middle - half, middle + half


@compiled
def contains(box, x):
    """True if position x (3,), m, is within the bounds `box` (2, 3)."""
    for k in range(3):
        if not box[0, k] <= x[k] <= box[1, k]:
            return False
    return True


@compiled
def nearest(box, x, axis):
    """Coordinate within the bounds that is next to that of x (3,), m."""
    return min(max(x[axis], box[0, axis]), box[1, axis])


@compiled
def draw_back(hypothesis, innovation, box, axis):
    """Pull a tag that has left its workspace towards it along one axis; returns whether it had.

    Wrong TDOAs, e.g. late arrivals on a floor, are often explained best by a tag far away.
    """
    inside = nearest(box, hypothesis.x, axis)
    if inside == hypothesis.x[axis]:
        return False
    update_state(hypothesis, innovation, axis, inside, STD)
    return True
