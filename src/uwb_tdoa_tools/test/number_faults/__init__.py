# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random faults of numbers to put into flights. A rule of `check` must name each."""

from dataclasses import dataclass

from . import inertial, labels, stamps, truth, values


@dataclass(frozen=True)
class Fault:
    """A fault of numbers.

    put_in : callable(flight, rng) -> Flight
    rules : rules that name it
    inertial : it needs a flight with inertial samples
    judge_truth : it corrupts the ground truth instead of the estimate
    """

    put_in: object
    rules: tuple
    inertial: bool = False
    judge_truth: bool = False


def _all_faults():
    of_values = {
        "repeated": values.REPEATED,
        "rounded": values.ROUNDED,
        "clipped": values.CLIPPED,
        "frozen": values.FROZEN,
        "late": values.LATE,
        "interpolated": values.INTERPOLATED,
    }
    for name, change in of_values.items():
        yield f"pair_{name}", Fault(values.of_pairs(change, False), (f"pair_{name}",))
        yield f"tdoa_{name}", Fault(values.of_pairs(change, True), (f"tdoa_{name}",))
    yield "ids_exchanged", Fault(labels.ids, ("ids_exchanged",))
    yield "pair_sign", Fault(labels.sign(False), ("pair_sign",))
    yield "tdoa_sign", Fault(labels.sign(True), ("tdoa_sign",))
    yield "tdoa_twice", Fault(labels.twice, ("tdoa_twice",))
    yield "tdoa_reordered", Fault(labels.reordered, ("tdoa_reordered",))
    yield (
        "anchor_missing",
        Fault(labels.missing, ("anchor_missing", "anchor_silent", "anchor_rare")),
    )
    yield "tdoa_lost", Fault(labels.lost, ("gap",))
    for stream in ("tdoa", "imu"):
        yield (
            f"{stream}_quantised",
            Fault(
                stamps.of_stream(stream, stamps.quantised),
                ("stamps_coarse", "stamps_stand"),
                stream == "imu",
            ),
        )
        yield (
            f"{stream}_drift",
            Fault(stamps.of_stream(stream, stamps.drifting), (f"{stream}_drift",), stream == "imu"),
        )
        yield (
            f"{stream}_jump",
            Fault(stamps.of_stream(stream, stamps.jumping), (f"{stream}_jump",), stream == "imu"),
        )
    yield "imu_repeated", Fault(inertial.repeated, ("imu_repeated",), True)
    for sensor in ("gyro", "accel"):
        yield (
            f"{sensor}_axes",
            Fault(
                inertial.of_sensor(sensor, inertial.turned), (f"{sensor}_axes", "imu_turned"), True
            ),
        )
        yield (
            f"{sensor}_clipped",
            Fault(inertial.of_sensor(sensor, inertial.saturated), ("imu_clipped",), True),
        )
        yield (
            f"{sensor}_filtered",
            Fault(inertial.of_sensor(sensor, inertial.filtered), ("imu_filtered",), True),
        )
    yield (
        "gyro_unit",
        Fault(inertial.of_sensor("gyro", inertial.in_degrees), ("imu_rate_unit",), True),
    )
    yield "accel_unit", Fault(inertial.of_sensor("accel", inertial.in_g), ("imu_force_unit",), True)
    yield "truth_hole", Fault(truth.hole, ("truth_hole",), judge_truth=True)
    yield "truth_leap", Fault(truth.leap, ("truth_leap",), judge_truth=True)
    yield "truth_attitude", Fault(truth.attitude, ("truth_attitude",), True, True)


FAULTS = dict(_all_faults())
