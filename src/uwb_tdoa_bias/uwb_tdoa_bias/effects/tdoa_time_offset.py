"""The stamps of the TDOAs are off."""

from __future__ import annotations

from .stamp_error import StampEffect


class TdoaTimeOffset(StampEffect):
    """TDOAs are stamped `offset` seconds after the instant they were taken at.

    Corrected by moving the stamps.
    """

    name = "tdoa_time_offset"
    stream = "tdoa"
    physics = (
        "the radio's stamps lag behind the IMU's: by buffers, or because they are taken on "
        "arrival at the host"
    )
    remedy = "Stamp TDOAs at the instant they are taken: their stamps are {}."
    confounded_with = ("truth_time_offset",)
    distinguished_by = {
        "truth_time_offset": "a flight with IMU: its stamps belong to neither",
    }
    witnesses = ("gyro", "accel")  # without an inertial sensor the ground truth may as well be late
    reference = "UTIL web page: about 10 ms of radio latency"
    needs_reference = True
