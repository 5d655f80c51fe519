"""What a tag feels beside inertia and radio: height, pressure, velocity. One AID is one measurement of one of them."""

from uwb_tdoa_bias.foundation.compiled import compiled

from . import barometer, height, velocity

STREAMS = "height", "pressure", "velocity"  # by kind
HEIGHT, PRESSURE, VELOCITY = range(3)  # value[0] in m; value[0] in m of standard altitude; value in m/s, with its std


@compiled
def observe(ekf, tuning, aid, residual, records):
    """Take one of AID into a running filter that has been predicted to its stamp; fills one of RESIDUAL."""
    if aid.kind == HEIGHT:
        height.observe(ekf, tuning, aid, residual, records)
    elif aid.kind == PRESSURE:
        barometer.observe(ekf, tuning, aid, residual, records)
    else:
        velocity.observe(ekf, tuning, aid, residual, records)


@compiled
def note(ekf, aid):
    """Take one of AID while the filter does not run."""
    if aid.kind == HEIGHT:
        height.note(ekf, aid)
