import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.flight import AIDS, Flight, Tdoas
from uwb_tdoa_bias.foundation.sensors import Height, Pressure, Velocity

NONE = np.zeros(0)


def test_without_some_streams_the_others_stay():
    anchors, tdoa = Anchors.from_positions(np.eye(3)), Tdoas(NONE, NONE, NONE, NONE)
    height, pressure, velocity = (
        Height(NONE, NONE),
        Pressure(NONE, NONE),
        Velocity(NONE, NONE, NONE),
    )
    flight = Flight("f", anchors, tdoa, height=height, pressure=pressure, velocity=velocity)
    left = flight.without("height", "velocity")
    assert (
        left.height is None
        and left.velocity is None
        and left.pressure is pressure
        and left.tdoa is tdoa
    )
    assert (
        all(getattr(flight.without(*AIDS), name) is None for name in AIDS)
        and flight.height is height
    )
