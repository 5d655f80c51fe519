from flights import fly
import numpy as np
import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import TDOA, structured
from uwb_tdoa_ekf.installed import Installed
from uwb_tdoa_ekf.offline import loaded
from uwb_tdoa_ekf.pipeline import Pipeline, odometry_of
from uwb_tdoa_ekf.reorder_buffer import TDOA_STREAM

LATE, SINCE = 0.8, 15.0  # m and s


def delayed(flight, row):
    """(k,) of TDOA of a Flight, from SINCE on with a delay of an anchor."""
    tdoa = flight.tdoa
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    late = np.where(tdoa.t > SINCE, LATE, 0.0) * ((b == row) * 1.0 - (a == row))
    return structured(TDOA, tdoa.t, a, b, tdoa.d + late)


def run(flight, config, row, ends):
    """(Odometry, Residuals, Pipeline) of all TDOAs, used up to each of `ends`, s."""
    buffer, _ = loaded(flight, config)
    buffer.load(TDOA_STREAM, delayed(flight, row))
    pipeline = Pipeline(Installed(flight.anchors), config)
    parts = [part for end in ends for part in pipeline.run(buffer, end)]
    assert len(buffer) == 0
    return odometry_of(parts), pipeline.residuals(parts), pipeline


@pytest.mark.parametrize("compensating", [False, True])
def test_the_same_comes_out_whatever_is_used_at_once(compensating):
    flight, config, row = fly(5, 24.0), FilterConfig(compensate_changes=compensating), 2
    whole, of_whole, pipeline = run(flight, config, row, [np.inf])
    assert any(f"anchor {flight.anchors.ids[row]}:" in alarm for alarm in pipeline.alarms)
    assert (pipeline.state.anchors["delay"][row] > 0.5 * LATE) == compensating
    pieces, of_pieces, _ = run(
        flight, config, row, [*np.sort(np.random.default_rng(0).uniform(0.0, 24.0, 200)), np.inf]
    )
    for one, other in ((whole, pieces), (of_whole, of_pieces)):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(getattr(other, name), values, name)


def test_nobody_watches_unless_that_is_asked_for():
    flight = fly(5, 1.0)
    assert Pipeline(Installed(flight.anchors), FilterConfig(), watched=False).alarms == []
    assert Pipeline(Installed(flight.anchors), FilterConfig(), watched=False).monitor is None
    assert (
        Pipeline(
            Installed(flight.anchors), FilterConfig(compensate_changes=True), watched=False
        ).monitor
        is not None
    )
