from dataclasses import replace

from driving import assert_equal, cut, drive, state_for
from flights import fly
import numpy as np

from uwb_tdoa_ekf.core.memory import IMU_SAMPLE, new_state, structured


def test_a_copy_of_the_memory_is_a_copy_of_the_filter():
    flight = fly(2, 4.0)
    state = state_for(flight)
    early = replace(flight, imu=cut(flight.imu, 0.0, 2.0), tdoa=cut(flight.tdoa, 0.0, 2.0))
    late = replace(flight, imu=cut(flight.imu, 2.0, 4.0), tdoa=cut(flight.tdoa, 2.0, 4.0))
    drive(early, state=state)
    twin = state.copy()
    assert_equal(drive(late, state=state), drive(late, state=twin))


def test_the_record_is_a_view():
    state = new_state(np.arange(12.0).reshape(4, 3))
    state.record.imu.gyro[1], state.record.hypotheses["x"][2, 0], state.record.best = 3.0, 4.0, 2
    assert state.ekf["imu"]["gyro"][0, 1] == 3.0 and state.ekf["hypotheses"]["x"][0, 2, 0] == 4.0
    assert state.ekf["best"].tolist() == [2]
    np.testing.assert_array_equal(state.anchors["position"][3], [9.0, 10.0, 11.0])


def test_structured_puts_columns_into_fields():
    t, gyro, accel = np.arange(2.0), np.arange(6.0).reshape(2, 3), -np.arange(6.0).reshape(2, 3)
    samples = structured(IMU_SAMPLE, t, gyro, accel)
    for name, column in zip(IMU_SAMPLE.names, (t, gyro, accel)):
        np.testing.assert_array_equal(samples[name], column)
    assert len(structured(IMU_SAMPLE, t[:0], gyro[:0], accel[:0])) == 0
