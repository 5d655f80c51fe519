"""What is wrong with the numbers of a flight, before anybody asks which physics explains them."""

import numpy as np

from uwb_tdoa_ekf.streams import NOTE, StreamRules, most_severe_first

from .against_truth import against_truth


def numbers(flight):
    """[Finding] of a Flight, most severe first: of its streams by themselves, and against its ground truth if it has one."""
    streams, imu, of = StreamRules(flight.anchors), flight.imu, flight.tdoa
    if imu is not None:
        streams.feed_imu(imu.t, np.full(len(imu), np.nan), imu.gyro, imu.accel)
    streams.feed_tdoa(of.t, np.full(len(of), np.nan), of.a, of.b, of.d)
    streams.finish()
    found = [finding for finding in streams.findings() if finding.severity != NOTE]
    return most_severe_first(found + against_truth(flight))
