"""The stamps of ranges are late."""

from __future__ import annotations

from .stamp_error import StampEffect


class RangeDelay(StampEffect):
    """Ranges are stamped `offset` seconds after the instant they were taken at.

    Corrected by moving the stamps.
    """

    name = "range_delay"
    stream = "range"
    physics = (
        "a two-way exchange takes milliseconds, one anchor after the other, and the host stamps "
        "what it receives"
    )
    remedy = "Stamp ranges at the instant they are taken: their stamps are {}."
    confounded_with = ("truth_time_offset",)
    distinguished_by = {"truth_time_offset": "a flight with IMU: its stamps belong to neither"}
    witnesses = (
        "tdoa",
        "gyro",
        "accel",
    )  # without any of these the ground truth may as well be late
    reference = "DW1000 user manual: a two-way exchange takes two or three messages and a report"
    needs_reference = True
    channels = ("range",)
