# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of the tag and its radio, the same for all anchors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import filled, floats
from ..common.geometry import rotate_each
from ..common.radio import (
    FLAT_MOUNT,
    NOMINAL_GAIN,
    Antenna,
    RadioLink,
    into_frame,
    power_bias,
    received_power_dbm,
)
from .base import ArrivalEffect, Effect, GeometryEffect, Row, measured
from .samples import RADIO, Samples, tile

EXAMPLES = 4.0, 8.0  # m, distances in the advice of range_bias
LINK = RadioLink()
UNIT_ANTENNA = Antenna(delay_span=1.0)


class TagLeverArm(GeometryEffect):
    """The antenna of the tag is at p + R(q) l, with the lever arm l = (x, y, z), m, body."""

    row = Row(
        name="tag_lever_arm",
        unit="m",
        bound=2.0,
        negligible=0.01,
        prior_std=0.15,
        example="z",
        physics=(
            "the tag's antenna is off the origin of the body frame, by an arm that turns with the "
            "body"
        ),
        reference="any text on strapdown navigation: lever arm compensation",
        confounded_with=("truth_frame", "anchor_position"),
        distinguished_by={
            "truth_frame": (
                "a flight that turns through all headings: the arm turns with the body, the frame "
                "does not"
            ),
        },
        remedy=(
            "Measure where the tag's antenna sits on the vehicle: it is {found} from the "
            "origin of the body frame."
        ),
        phrase="{size} towards {way}{key}",
        ways=("+", "-"),
    )
    parameters = ("x", "y", "z")
    uses_attitude = True

    def antennas(self, samples: Samples) -> dict[str, np.ndarray]:
        arm = np.array([self.values.get(key, 0.0) for key in "xyz"])
        return {"p": samples.p + _rotate(samples.q, arm)}

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        jacobian = samples.position_jacobian(self.antennas(samples)["p"])
        axes = np.eye(3)[["xyz".index(key) for key in keys]]
        return np.stack(
            [np.sum(jacobian * _rotate(samples.q, axis), axis=1) for axis in axes], axis=1
        )


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return R(q) v, (n, 3), for quaternions (n, 4) x y z w; NaN where q is NaN."""
    return filled(rotate_each, (len(q), 3), floats(q), v)


class RangeScale(Effect):
    """TDOAs and ranges are (1 + scale) times the true ones."""

    row = Row(
        name="range_scale",
        unit="1",
        bound=0.5,
        negligible=0.002,
        prior_std=0.02,
        example="scale",
        physics=(
            "the tag converts ticks to metres with a wrong length: a wrong clock frequency, speed "
            "of propagation or unit"
        ),
        reference="DW1000 user manual: one tick is 15.65 ps, 4.69 mm",
        confounded_with=("range_bias", "anchor_position", "truth_frame"),
        remedy="Check how the tag turns ticks into metres: everything is {found}.",
        ways=("too large", "too small"),
        shown=("%", 100.0),
    )
    covariates = ("range",)
    channels = tuple(RADIO)

    def bias(self, samples: Samples) -> np.ndarray:
        return self.values.get("scale", 0.0) * samples.predicted()

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(samples.predicted()[:, None], len(keys), axis=1)


class RangeBias(ArrivalEffect):
    """An anchor at range r seems farther by quadratic * r^2.

    A constant cancels in a TDOA, and a slope is range_scale.
    """

    row = Row(
        name="range_bias",
        unit="1/m",
        bound=0.5,
        negligible=5e-4,
        prior_std=0.01,
        example="quadratic",
        physics=(
            "the detector fires later on weak, far signals: a range error that bends over range"
        ),
        reference=(
            "Decawave APS011: the range error is a bent function of received power, hence of range"
        ),
        confounded_with=("received_power_bias", "range_scale"),
        distinguished_by={
            "received_power_bias": (
                "one range at many headings: power changes with the antennas, range does not"
            ),
            "range_scale": "a flight near to and far from the anchors",
        },
    )
    covariates = ("range",)

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        to_anchor = samples.anchors.positions[rows] - tile(samples, samples.p)
        return np.repeat(np.sum(to_anchor**2, axis=1)[:, None], len(keys), axis=1)

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        sign = "far" if self.values["quadratic"] > 0.0 else "near"
        near, far = (f"{self._size_at(r)} at {r:g} m" for r in EXAMPLES)
        return (
            f"Calibrate ranges over distance: an anchor seems too {sign} by {near} and by {far}.",
        )

    def _size_at(self, r: float) -> str:
        """Return the magnitude of the delay at range r, m, with its standard deviation."""
        value, std = self.values["quadratic"], self.std.get("quadratic", 0.0)
        return measured(abs(value) * (r * r), std * (r * r), "m")


class ReceivedPowerBias(ArrivalEffect):
    """The delay is `scale` times the table of APS011 at the predicted received power.

    The power follows from Friis' equation and the patterns of the antennas. An anchor or tag of
    unknown attitude has the mean gain of its antenna.
    """

    row = Row(
        name="received_power_bias",
        unit="1",
        bound=10.0,
        negligible=0.1,
        prior_std=1,
        example="scale",
        physics="the leading edge is detected earlier in a strong signal and later in a weak one",
        reference="Decawave APS011, table 2 (500 MHz, 64 MHz PRF)",
        confounded_with=("range_bias", "antenna_pattern"),
        remedy=(
            "Correct ranges for received power in the tag: they err by {found} times the "
            "table of Decawave APS011."
        ),
        phrase="{value}",
        shown=("", 1.0),
    )
    uses_attitude = True
    uses_orientations = True

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        p, positions = tile(samples, samples.p), samples.anchors.positions[rows]
        orientations = samples.anchors.orientations[rows]
        power: np.ndarray = np.full(len(rows), np.nan)
        if np.isfinite(orientations).any():
            q = tile(samples, samples.q)
            power = received_power_dbm(p, q, positions, orientations, LINK)
        unknown = ~np.isfinite(power)
        if unknown.any():
            loss = LINK.path_loss_db(np.linalg.norm(p - positions, axis=1))
            power = np.where(unknown, LINK.tx_power_dbm + 2.0 * NOMINAL_GAIN - loss, power)
        delay = np.where(np.isfinite(power), power_bias(power), np.nan)
        return np.repeat(delay[:, None], len(keys), axis=1)


class AntennaPattern(ArrivalEffect):
    """The delay is `tag` and `anchor`, m, times the group delay of an antenna over direction.

    The shape, 0 to 1, belongs to a DWM1000-like module.
    """

    row = Row(
        name="antenna_pattern",
        unit="m",
        bound=3.0,
        negligible=0.02,
        prior_std=0.2,
        example="tag",
        physics=(
            "off its best direction an antenna radiates over longer ways: the group delay grows "
            "towards its nulls"
        ),
        reference=(
            "Qorvo support: 10 - 15 cm over direction for a module; the shape is that of "
            "uwb_tdoa_bias.common.radio"
        ),
        confounded_with=("received_power_bias", "tag_lever_arm"),
        distinguished_by={
            "received_power_bias": "one place at many headings, then one heading at many ranges",
        },
        remedy=(
            "Turn antennas so that their nulls point at nothing that is heard: arrivals are "
            "{found}."
        ),
        phrase="{size} {way} in the nulls of the {key}'s antenna",
        ways=("later", "earlier"),
    )
    parameters = ("tag", "anchor")
    uses_attitude = True

    @property
    def uses_orientations(self) -> bool:  # type: ignore[override]  # of its values
        return self.values.get("anchor", 0.0) != 0.0

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        to_anchor = samples.anchors.positions[rows] - tile(samples, samples.p)
        out: list[np.ndarray] = [np.zeros((len(rows), 0))]
        for key in keys:
            if key == "tag":
                seen = into_frame(FLAT_MOUNT, into_frame(tile(samples, samples.q), to_anchor))
                delay = UNIT_ANTENNA.group_delay(seen)
            else:  # an anchor of unknown orientation has no delay
                orientations = samples.anchors.orientations[rows]
                delay = UNIT_ANTENNA.group_delay(into_frame(orientations, -to_anchor))
                delay = np.where(np.isfinite(orientations).all(axis=1), delay, 0.0)
            out.append(delay[:, None])
        return np.concatenate(out, axis=1)
