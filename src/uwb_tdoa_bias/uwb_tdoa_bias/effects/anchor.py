# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of anchors: delays, clocks, surveyed positions and their frame, obstacles and ids."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
import math

import numpy as np

from ..common.anchors import Anchors
from ..common.arrays import rotations
from ..common.geometry import ranges
from .base import (
    ANCHOR,
    OF_ANCHOR,
    UNLIMITED,
    ArrivalEffect,
    DetectedEffect,
    Effect,
    GeometryEffect,
    LabelEffect,
    Region,
    Row,
    Shift,
    cached_by_anchors,
    central_differences,
    counted,
    id_texts,
    interval_words,
    is_within,
    listed,
    measured,
    with_each,
)
from .samples import RADIO, Samples, tile

AXES_AND_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")  # of a frame
FRAME_STEP = 1e-5  # m and rad, of central differences
ANGLE_BOUND, ANGLE_PRIOR_STD = 0.5, 0.03  # rad


class AnchorEffect(Effect):
    """An effect with one parameter per anchor, delay_i = values[i] * delay_per_unit."""

    channels = tuple(RADIO)
    key_form = OF_ANCHOR

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return with_each(id_texts(anchors))

    def delay_per_unit(self, samples: Samples) -> np.ndarray | float:
        """Return the delay of an anchor per unit of its parameter, (n,) or a scalar, m."""
        return 1.0

    def bias(self, samples: Samples) -> np.ndarray:
        values = self._of_each(samples.anchors)
        return samples.difference(values[samples.rows]) * self.delay_per_unit(samples)

    @cached_by_anchors
    def _of_each(self, anchors: Anchors) -> np.ndarray:
        return np.array([self.values.get(key, 0.0) for key in id_texts(anchors)])

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        ids, wanted = samples.anchors.ids, np.array([int(key) for key in keys])
        sign = samples.difference((ids[samples.rows][:, None] == wanted).astype(float))
        return sign * np.reshape(self.delay_per_unit(samples), (-1, 1))

    def where(self) -> str:
        return counted(sorted(self.significant(), key=int), "anchor")


class AnchorDelay(AnchorEffect):
    """All signals of anchor i arrive `values[i]` metres late.

    Bias of d_ab = delay_b - delay_a, of a range to b delay_b. TDOAs show differences of delays
    only: they do not determine the sum over all anchors.
    """

    row = Row(
        name="anchor_delay",
        unit="m",
        bound=5.0,
        negligible=0.01,
        prior_std=0.3,
        example="0",
        physics=(
            "the antenna delay of an anchor is not calibrated: it always seems farther away by the "
            "same distance"
        ),
        reference="DW1000 user manual, antenna delay calibration: 10 - 50 cm from module to module",
        confounded_with=("anchor_position", "pair_offset", "range_offset"),
        distinguished_by={
            "pair_offset": "TDoA3, where each anchor is heard in many pairs",
            "anchor_position": "a flight that passes the anchor on several sides, near and far",
        },
        remedy=(
            "Calibrate the antenna delay of {where}: the tag hears {found}, against the other "
            "anchors."
        ),
        phrase="anchor {key} {size} {way}",
        ways=("late", "early"),
    )
    uses_pose = False

    def found(self) -> str:
        found = super().found()
        return found if len(self.significant()) > 1 else f"it {found.split(' ', 2)[2]}"


class RangeOffset(AnchorEffect):
    """Ranges to anchor i are `values[i]` metres too long, TDOAs are not affected.

    If TDOAs are affected too, the effect is an anchor_delay.
    """

    row = Row(
        name="range_offset",
        unit="m",
        bound=5.0,
        negligible=0.01,
        prior_std=0.3,
        example="0",
        physics=(
            "two-way ranging has a delay that TDOAs do not have: of the tag's antenna, or of a "
            "calibration of its own"
        ),
        reference=(
            "DW1000 user manual, antenna delay calibration: a two-way range has the delays of both "
            "antennas"
        ),
        confounded_with=("anchor_delay", "anchor_position"),
        remedy=(
            "Calibrate the antenna delay of two-way ranging with {where}: ranges are {found}, "
            "and TDOAs are not."
        ),
        phrase="to anchor {key} {size} too {way}",
        ways=("long", "short"),
    )
    channels = ("range",)
    corroborating_channels = ("tdoa",)  # without TDOAs it is an anchor_delay


class AnchorClockDrift(AnchorEffect):
    """The delay of anchor i grows by `values[i]` metres per second from the first TDOA on."""

    row = Row(
        name="anchor_clock_drift",
        unit="m/s",
        bound=1.0,
        negligible=5e-4,
        prior_std=0.01,
        example="0",
        physics=(
            "the correction of an anchor's clock lags behind its crystal, which warms up: its "
            "delay grows with time"
        ),
        reference=(
            "Sidorenko et al., Sensors 2019, 19, 2942; DW1000 user manual: 2.15 mm per degree"
        ),
        confounded_with=("anchor_delay", "nlos"),
        distinguished_by={
            "nlos": "a longer flight: a drift goes on, an obstacle ends",
            "anchor_delay": "a longer flight",
        },
        remedy="Let {where} warm up before flights, or check the clock: heard {found}.",
        phrase="anchor {key} by {size} a second {way}",
        ways=("later", "earlier"),
        shown=("m", 1.0),
    )
    portable = False
    covariates = ("time",)

    def delay_per_unit(self, samples: Samples) -> np.ndarray:
        return samples.t - samples.start


class AnchorPosition(GeometryEffect):
    """Anchor i is `values["i.x"]`, ... metres from its surveyed position, world axes."""

    row = Row(
        name="anchor_position",
        unit="m",
        bound=5.0,
        negligible=0.01,
        prior_std=0.15,
        example="0.x",
        physics=(
            "the antenna of an anchor is not where the survey has it: the range is wrong by the "
            "shift along the line of sight"
        ),
        reference=(
            "geometry; survey repeatability of a total station is millimetres, of a tape some "
            "centimetres"
        ),
        confounded_with=("anchor_delay", "truth_frame", "tag_lever_arm"),
        distinguished_by={
            "tag_lever_arm": (
                "a flight that turns through all headings and passes on all sides of the anchor"
            ),
            "truth_frame": (
                "a flight through the whole room; several anchors that moved alike are a frame"
            ),
        },
    )
    portable = False
    key_form = rf"{ANCHOR}\.[xyz]", "an anchor and an axis; write '3.x: 0.05'"
    if_undetermined = "no anchor has to be moved"

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        each = [tuple(f"{i}.{axis}" for axis in "xyz") for i in id_texts(anchors)]
        return [sum(each, ()), *each, *((key,) for keys in each for key in keys)]

    @cached_by_anchors
    def positions(self, anchors: Anchors) -> np.ndarray:
        positions = anchors.positions.copy()
        rows = {i: row for row, i in enumerate(id_texts(anchors))}
        for key, value in self.values.items():
            anchor, axis = key.split(".")
            if anchor in rows:
                positions[rows[anchor], "xyz".index(axis)] += value
        return positions

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        ids, rows = samples.anchors.ids[samples.rows], samples.rows
        to_tag = ranges(tile(samples, samples.p), self.positions(samples.anchors)[rows])[1]
        out = np.empty((len(samples), len(keys)))
        for column, key in enumerate(keys):
            anchor, axis = key.split(".")
            out[:, column] = samples.difference(
                (ids == int(anchor)) * -to_tag[:, "xyz".index(axis)]
            )
        return out

    def advice(self) -> tuple[str, ...]:
        shifts: dict[str, dict[str, str]] = {}
        for key, value in self.significant().items():
            anchor, axis = key.split(".")
            sign = "+" if value > 0.0 else "-"
            shifts.setdefault(anchor, {})[axis] = f"{self.size(key)} towards {sign}{axis}"
        if not shifts:
            return ()
        many = len(shifts) > 1
        each = [
            f"{f'anchor {anchor}' if many else 'it'} seems to be "
            f"{listed(by[axis] for axis in sorted(by))} from its surveyed position"
            for anchor, by in shifts.items()
        ]
        return (
            f"Measure {counted(sorted(shifts, key=int), 'anchor')} again before you move "
            f"{'them' if many else 'it'}: {'; '.join(each)}. "
            f"If the survey proves right, the errors of ranges to {'them' if many else 'it'} depend on "
            "the direction, as those of an antenna do.",
        )

    def marks(self, anchors: Anchors) -> tuple[Shift, ...]:
        each: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for key, value in self.values.items():
            anchor, axis = key.split(".")
            by, std = each.setdefault(int(anchor), (np.zeros(3), np.full(3, np.nan)))
            by["xyz".index(axis)], std["xyz".index(axis)] = value, self.std.get(key, np.nan)
        return tuple(Shift(anchor, *shift) for anchor, shift in each.items())


class TruthFrame(GeometryEffect):
    """In the frame of the truth, an anchor surveyed at A is at R A + (x, y, z).

    R turns by the rotation vector (roll, pitch, yaw). The data do not determine which of the two
    frames is right: `diagnose` gives this effect to no node. In an effects.yaml it moves the
    anchors, and estimates are in the frame of the truth.
    """

    row = Row(
        name="truth_frame",
        unit="m, rad",
        bound=5.0,
        negligible=0.01,
        prior_std=0.15,
        example="z",
        physics=(
            "survey and motion capture do not share one frame: all anchors are shifted and turned "
            "together"
        ),
        reference="rigid alignment of two coordinate frames",
        confounded_with=("tag_lever_arm", "anchor_position"),
        remedy=(
            "Align the frames of the survey and of the ground truth anew: seen from the "
            "ground truth, all anchors are shifted and turned together by {found}."
        ),
        phrase="{key} {value}",
    )
    other_units = dict.fromkeys(AXES_AND_ANGLES[3:], "rad")
    needs_reference = True
    portable = False
    usable = False
    why_unusable = (
        "whether the survey or the ground truth is turned or shifted nobody can tell, so that "
        "nothing goes to the nodes"
    )

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [
            AXES_AND_ANGLES,
            AXES_AND_ANGLES[:3],
            AXES_AND_ANGLES[3:],
            *((key,) for key in AXES_AND_ANGLES),
        ]

    @classmethod
    def bound_of(cls, key: str) -> float:
        return cls.row.bound if key in "xyz" else ANGLE_BOUND

    @classmethod
    def prior_std_of(cls, key: str) -> float:
        return cls.row.prior_std if key in "xyz" else ANGLE_PRIOR_STD

    def shown_in(self, key: str) -> tuple[str, float]:
        return ("m", 1.0) if key in "xyz" else ("degrees", math.degrees(1.0))

    def positions(self, anchors: Anchors) -> np.ndarray:
        at = np.array([self.values.get(key, 0.0) for key in AXES_AND_ANGLES])
        return anchors.positions @ rotations.Rotation.from_rotvec(at[3:]).as_matrix().T + at[:3]

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return central_differences(
            lambda values: TruthFrame(values).bias(samples), self.values, keys, FRAME_STEP
        )

    def marks(self, anchors: Anchors) -> tuple[Shift, ...]:
        shifts = self.positions(anchors) - anchors.positions
        unknown = np.full(3, np.nan)
        return tuple(Shift(int(i), by, unknown) for i, by in zip(anchors.ids, shifts))


class SearchedDelay(DetectedEffect, ArrivalEffect):
    """Delays "i.delay" of anchors under conditions, further parameters that a detector searches."""

    channels = ("tdoa",)

    @property
    def merge_key(self) -> tuple[Hashable, ...]:
        conditions = (item for item in self.values.items() if not item[0].endswith(".delay"))
        return (self.name, *sorted(conditions))

    @property
    def delay_keys(self) -> tuple[str, ...]:
        return tuple(key for key in self.values if key.endswith(".delay"))

    def significant_delays(self) -> dict[str, float]:
        """Return {anchor: delay} of the significant delays, m."""
        return {
            key.partition(".")[0]: value
            for key, value in self.significant().items()
            if key.endswith(".delay")
        }


class Nlos(SearchedDelay):
    """Anchor i is "i.delay" metres late during an interval, within a sphere, or both.

    The interval is "i.start" to "i.end", s after the first TDOA. The sphere has the centre
    ("i.x", "i.y", "i.z") and the radius "i.radius", m. A limit that is not given does not apply.
    """

    row = Row(
        name="nlos",
        unit="m, s",
        bound=100.0,
        negligible=0.02,
        prior_std=0.5,
        example="0.delay",
        physics=(
            "something between tag and anchor: the direct path is slowed or lost, and a later one "
            "is taken for it"
        ),
        reference=(
            "UTIL identification data: metal 0.2 - 0.6 m, wood 0.03 - 0.24 m, people up to 2 m"
        ),
        confounded_with=("anchor_delay", "anchor_clock_drift", "anchor_position"),
        distinguished_by={
            "anchor_delay": "the same path again without the obstacle, or from another side",
        },
    )
    key_form = (
        rf"{ANCHOR}\.(delay|start|end|x|y|z|radius)",
        "an anchor and one of delay, start, end, x, y, z, radius",
    )
    conditions = ("start", "end", "x", "y", "z", "radius")
    other_units = {"start": "s", "end": "s"}

    @classmethod
    def bound_of(cls, key: str) -> float:
        return UNLIMITED if key.endswith(("start", "end", ".x", ".y", ".z")) else cls.row.bound

    @classmethod
    def within_bounds(cls, values: dict[str, float]) -> bool:
        delays = (value for key, value in values.items() if key.endswith(".delay"))
        return super().within_bounds(values) and all(delay >= 0.0 for delay in delays)

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        columns = [self._blocked(samples, rows, key.partition(".")[0])[:, None] for key in keys]
        return 1.0 * np.concatenate([np.zeros((len(rows), 0)), *columns], axis=1)

    def _blocked(self, samples: Samples, rows: np.ndarray, anchor: str) -> np.ndarray:
        """Return whether arrivals are of the anchor and within its limits, (k * n,) bool."""
        blocked = samples.anchors.ids[rows] == int(anchor)
        blocked &= is_within(self, anchor, tile(samples, samples.t) - samples.start)
        radius = self.values.get(f"{anchor}.radius")
        if radius is not None:
            distance = np.linalg.norm(samples.p - self._centre(anchor), axis=1)
            blocked &= tile(samples, distance <= radius)  # False where the position is unknown
        return blocked

    def _centre(self, anchor: str) -> np.ndarray:
        """Return the centre of the sphere, (3,) m."""
        return np.array([self.values.get(f"{anchor}.{axis}", 0.0) for axis in "xyz"])

    def advice(self) -> tuple[str, ...]:
        out = []
        delays = self.significant_delays()
        for anchor, delay in sorted(delays.items(), key=lambda item: -item[1]):
            late = measured(delay, self.std.get(f"{anchor}.delay"), "m")
            radius, when = self.values.get(f"{anchor}.radius"), interval_words(self, anchor)
            when = f", {when}" if when else ""
            if radius is None:
                out.append(
                    f"Look what stood between anchor {anchor} and the tag{when}: it was heard "
                    f"{late} late."
                )
            else:
                place = "({:.1f}, {:.1f}, {:.1f}) m".format(*self._centre(anchor))
                out.append(
                    f"Look what stands between anchor {anchor} and {place}: the anchor is heard "
                    f"{late} late while the tag is within {radius:.1f} m of there{when}."
                )
        return tuple(out)

    def marks(self, anchors: Anchors) -> tuple[Region, ...]:
        return tuple(
            Region(int(anchor), self._centre(anchor), self.values[f"{anchor}.radius"])
            for anchor in self.significant_delays()
            if f"{anchor}.radius" in self.values
        )


class AnchorIds(LabelEffect):
    """The id of a parameter belongs to the anchor that has its value as id in the survey."""

    row = Row(
        name="anchor_ids",
        unit="id",
        bound=65535.0,
        negligible=0.5,
        prior_std=1.0,
        example="1",
        physics=(
            "modules were configured with, or put up by, the number of another anchor, or the "
            "survey lists them in another order"
        ),
        reference=(
            "Bitcraze documentation of the loco positioning system: every anchor is given its id "
            "by hand"
        ),
        confounded_with=("anchor_position",),
    )
    separable = False
    key_form = OF_ANCHOR
    expected = "the id of an anchor, a whole number"

    @staticmethod
    def possible(value: float) -> bool:
        return value >= 0.0 and value == round(value)

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        table = {int(key): int(value) for key, value in self.values.items()}
        return replaced(a, table), replaced(b, table), d

    def mislabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        back = AnchorIds({f"{value:.0f}": float(key) for key, value in self.values.items()})
        return back.relabelled(a, b, d)

    def advice(self) -> tuple[str, ...]:
        if not self.values:
            return ()
        wrong = listed(
            f"what is called {key} is anchor {value:.0f} of the survey"
            for key, value in self.values.items()
        )
        return (f"Give the anchors their ids again, or list them so in the survey: {wrong}.",)


def replaced(ids: np.ndarray, table: dict[int, int]) -> np.ndarray:
    """Return ids (n,), each replaced by its entry in the table, all at once."""
    ids = np.asarray(ids)
    return np.array([table.get(one, one) for one in ids.tolist()], dtype=ids.dtype)
