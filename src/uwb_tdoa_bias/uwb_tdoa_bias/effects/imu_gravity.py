"""Gravity is not what the filter takes it for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..foundation.later import rotations
from .affine import Affine
from .base import need_truth
from .imu_error import BESIDE_BIAS, ImuEffect, need_imu
from .samples import Track

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight
    from .samples import ImuSamples


class ImuGravity(ImuEffect):
    """Gravity is 9.81 m/s^2 + `excess`, along the world's z. Corrected along the body's z: at the
    tilt of a flight that is right to a few percent of the excess, and needs no attitude.
    """

    name = "imu_gravity"
    unit = "m/s^2"
    bound = 1.0
    negligible = 0.03
    typical = 0.1
    example = "excess"
    physics = (
        "local gravity, or the factor from g to m/s^2, differs from the 9.81 m/s^2 of the filter"
    )
    confounded_with = ("accel_bias", "accel_scale")
    distinguished_by = {
        "accel_bias": "a flight that tilts, or the vehicle at rest on its sides",
        "accel_scale": "hard manoeuvres up and down: a scale grows with them, gravity does not",
    }
    reference = "gravity is 9.780 to 9.832 m/s^2 between equator and pole"
    channels = ("accel",)
    price = BESIDE_BIAS

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("excess",)]

    @property
    def excess(self) -> float:
        """m/s^2"""
        return self.values.get("excess", 0.0)

    def regressors(self, samples: ImuSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(
            samples.up[:, :, None], len(keys), axis=2
        )  # the true vertical, not the body's z

    def uncorrected(self, samples: ImuSamples) -> np.ndarray:
        return self.excess * (samples.up - [0.0, 0.0, 1.0])

    def accel(self) -> Affine:
        return Affine(np.eye(3), np.array([0.0, 0.0, self.excess]))

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        truth, imu = need_truth(self, flight), need_imu(self, flight)
        q = Track(truth).attitudes(imu.t)
        up = (
            rotations.Rotation.from_quat(q).inv().apply([0.0, 0.0, self.excess])
            if np.isfinite(q).all()
            else [0.0, 0.0, self.excess]
        )
        return replace(flight, imu=replace(imu, accel=imu.accel + up))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("excess", "too much", "too little")
        return (
            (
                (
                    "Check the accelerometer's factor from g to m/s^2, and local gravity: it "
                    f"reads {off} upwards."
                ),
            )
            if off
            else ()
        )
