# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""EffectSet and effects.yaml: the effects of a model with their values and covariance.

EFFECTS lists all declared effects. Correctors of streams undo those on ids, signs, stamps and values of sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..common.anchors import Anchors
from ..common.errors import InputError, refuse_others, written_by
from ..common.files import write_text
from ..common.flight import SENSOR_NAMES, STREAMS, Flight
from ..common.safe_yaml import read_yaml
from ..common.sensors import STREAM_OF
from ..common.sensors.sensor import UNKNOWN_STD, UNKNOWN_VARIANCE, Stream
from .anchor import (
    AnchorClockDrift,
    AnchorDelay,
    AnchorIds,
    AnchorPosition,
    Nlos,
    RangeOffset,
    TruthFrame,
)
from .base import FADED_BELOW, IDENTITY, Effect, LabelEffect, SensorFunction, relabelled, undoing
from .floor import FloorMultipath
from .pair import NoiseCorrelation, NoiseLevel, OutlierRate, PairOffset, PairSign
from .samples import N_STATES, OF_IMU, ImuFeatures, ImuSamples, Samples, SensorSamples, fade_weight
from .sensor import (
    INERTIAL,
    AccelBias,
    AccelScale,
    BarometerDrift,
    FloorStep,
    GyroBias,
    GyroScale,
    HeightOffset,
    HeightScale,
    ImuGravity,
    ImuMisalignment,
    RangeDelay,
    TdoaTimeOffset,
    TruthTimeOffset,
    VelocityDelay,
    VelocityMisalignment,
    VelocityScale,
    VelocitySlip,
    YawRateScale,
)
from .smooth_term import SmoothTerm
from .tag import AntennaPattern, RangeBias, RangeScale, ReceivedPowerBias, TagLeverArm

# In the order in which `diagnose` lists them
EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        AnchorDelay,
        PairOffset,
        AnchorPosition,
        TagLeverArm,
        TdoaTimeOffset,
        TruthTimeOffset,
        TruthFrame,
        RangeScale,
        RangeBias,
        ReceivedPowerBias,
        AntennaPattern,
        AnchorClockDrift,
        Nlos,
        FloorMultipath,
        GyroBias,
        GyroScale,
        AccelBias,
        AccelScale,
        ImuMisalignment,
        ImuGravity,
        NoiseLevel,
        NoiseCorrelation,
        OutlierRate,
        HeightOffset,
        HeightScale,
        FloorStep,
        BarometerDrift,
        VelocityScale,
        YawRateScale,
        VelocityMisalignment,
        VelocityDelay,
        VelocitySlip,
        RangeOffset,
        RangeDelay,
        AnchorIds,
        PairSign,
    )
}
ENTRY = ("values", "std", "source", "domain")  # of an effect in effects.yaml
COVARIANCE_ENTRY = ("parameters", "matrix")
REACH = 0.3  # m and m/s, half the step of the statistical linearization: an error of the filter


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the values of effects: the prior of the next calibration.

    keys : ((name of an effect, parameter), ...)
    matrix : (k, k), in the product of their units
    """

    keys: tuple[tuple[str, ...], ...]
    matrix: np.ndarray

    def of(self, keys: Sequence[tuple[str, ...]]) -> tuple[np.ndarray, np.ndarray]:
        """Return (rows (m,) of `keys` that it holds, their matrix (m, m))."""
        known = {key: row for row, key in enumerate(self.keys)}
        held = [row for row, key in enumerate(keys) if key in known]
        own = [known[keys[row]] for row in held]
        return np.array(held, dtype=int), self.matrix[np.ix_(own, own)]

    def block_diagonal_by_anchor(self) -> Covariance:
        """Return the Covariance without correlation between different anchors.

        This limits the size of effects.yaml for many anchors. Parameters of an anchor follow each
        other, in the order of the ids as text. A key without an anchor ("z") has its own block.
        """
        anchors = np.array([key[1].partition(".")[0] for key in self.keys])
        order = np.argsort(np.unique(anchors, return_inverse=True)[1], kind="stable")
        matrix = np.where(anchors[:, None] == anchors, self.matrix, 0.0)[np.ix_(order, order)]
        return Covariance(tuple(self.keys[place] for place in order), matrix)

    def without(self, anchors: Collection[str]) -> Covariance:
        """Return the Covariance without the parameters of anchors with these ids (text)."""
        kept = [key for key in self.keys if key[1].partition(".")[0] not in anchors]
        return Covariance(tuple(kept), self.of(kept)[1])

    def as_dict(self) -> dict[str, list[str] | list[list[float]]]:
        """Return what YAML holds: rows of the lower triangle, without their leading zeros."""
        first = [min(int(np.argmax(row != 0.0)), k) for k, row in enumerate(self.matrix)]
        rows = [
            [float(f"{value:.6g}") for value in row[begin : k + 1]]
            for k, (row, begin) in enumerate(zip(self.matrix, first))
        ]
        return {"parameters": [f"{name} {key}" for name, key in self.keys], "matrix": rows}

    @classmethod
    def from_dict(
        cls, content: Any, values: dict[str, dict[str, float]], where: str | Path
    ) -> Covariance:
        """Return the Covariance of the content that `as_dict` gives; raise InputError.

        values : {name of an effect: {parameter: number}}; where : file, for messages
        """
        if not isinstance(content, dict) or set(content) != set(COVARIANCE_ENTRY):
            raise InputError(
                f"{where}: covariance must hold {' and '.join(COVARIANCE_ENTRY)}, as the tools write it."
            )
        names, rows = content["parameters"], content["matrix"]
        if not isinstance(names, list) or not isinstance(rows, list) or len(rows) != len(names):
            raise InputError(
                f"{where}: covariance: needs a row of the matrix for each of the parameters."
            )
        keys = tuple(tuple(str(name).split(" ", 1)) for name in names)
        for key in keys:
            if len(key) != 2 or key[1] not in values.get(key[0], {}) or keys.count(key) > 1:
                raise InputError(
                    f"{where}: covariance: {' '.join(key)!r} is no parameter above, or there twice."
                )
        matrix = np.zeros((len(keys), len(keys)))
        for k, row in enumerate(rows):
            numeric = isinstance(row, list) and all(
                isinstance(value, (int, float)) for value in row
            )
            if not numeric or not 1 <= len(row) <= k + 1:
                raise InputError(
                    f"{where}: covariance: row {k + 1} must be {k + 1} numbers, or fewer: "
                    "those before it are 0."
                )
            matrix[k, k + 1 - len(row) : k + 1] = matrix[k + 1 - len(row) : k + 1, k] = row
        scale = np.sqrt(np.diag(matrix).clip(min=1e-300))
        if not np.isfinite(matrix).all() or (
            len(keys) and np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] < -1e-3
        ):
            raise InputError(
                f"{where}: covariance: the matrix is none; it must be finite and positive "
                "semidefinite."
            )
        return cls(keys, matrix)


@dataclass(frozen=True)
class EffectSet:
    """The effects of a model, in their order.

    covariance : Covariance of some of their values, or None; no correction needs it
    """

    effects: tuple[Effect, ...] = ()
    covariance: Covariance | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        """Return the names, joined by '+', or "none"."""
        return "+".join(effect.name for effect in self.effects) or "none"

    def __len__(self) -> int:
        return len(self.effects)

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def bias(self, samples: Samples) -> np.ndarray:
        """Return the sum of all biases of `samples.channel`, (n,) m, faded beyond their domains.

        An effect adds nothing if its size is unknown without an attitude.
        """
        total = np.zeros(len(samples))
        for effect in self.effects:
            if samples.channel in effect.channels:
                total += _finite_or_zero(effect.corrected_bias(samples))
        return total

    def bias_jacobian(self, samples: Samples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the state-dependent bias of TDOAs with its derivative by the state of the filter.

        Statistical linearization over the error of the filter: central differences over REACH
        (Sarkka, Bayesian Filtering and Smoothing, 2013, section 5.3; Norgaard, Poulsen and Ravn,
        Automatica 2000).

        Returns bias (n,) m; Jacobian (n, N_STATES), m per m of position and per m/s of velocity;
        standard deviation of the deviation from the line, (n,) m. All are 0 where the state is
        unknown. The deviation has the variance of half the second differences: with the biases b+
        and b- at steps of REACH to both sides, 2 ((b+ + b-) / 2 - b)^2, summed over the states.
        """
        groups: dict[tuple[int, ...], list[Effect]] = {}
        n = len(samples)
        bias, power, jacobian = np.zeros(n), np.zeros(n), [np.zeros(n)] * N_STATES
        for effect in self.effects:
            if effect.jacobian_states:
                groups.setdefault(effect.jacobian_states, []).append(effect)
        for states, group in groups.items():
            moved = samples.kept(("moved", states), partial(_moved, samples, states))
            parts = (_finite_or_zero(effect.corrected_bias(moved)) for effect in group)
            here, *sides = sum(parts, np.zeros(len(moved))).reshape(-1, n)
            bias += here
            for k, (low, high) in zip(states, zip(sides[::2], sides[1::2])):
                jacobian[k] = jacobian[k] + (high - low) / (2.0 * REACH)
                power += 2.0 * (0.5 * (high + low) - here) ** 2
        return bias, np.stack(jacobian, axis=1), np.sqrt(power)

    def where(self, condition: Callable[[Effect], Any]) -> EffectSet:
        """Return the EffectSet of the effects that meet a condition."""
        return EffectSet(tuple(effect for effect in self.effects if condition(effect)))

    def with_anchors(self, found: Sequence[Effect] = ()) -> EffectSet:
        """Return the EffectSet with the positions and delays of anchors in `found`, and the other effects.

        Without such it keeps its own, or gets one without values.
        """
        own = {one.name: one for one in (AnchorPosition(), AnchorDelay(), *self.effects, *found)}
        of_anchors = own[AnchorPosition.name], own[AnchorDelay.name]
        others = self.where(
            lambda effect: effect.name not in (AnchorPosition.name, AnchorDelay.name)
        )
        return EffectSet((*of_anchors, *others), self.covariance)

    @cached_property
    def state_dependent(self) -> EffectSet:
        """Return the effects that `bias_jacobian` differentiates."""
        return self.where(lambda effect: effect.jacobian_states)

    @cached_property
    def state_independent(self) -> EffectSet:
        """Return the other effects."""
        return self.where(lambda effect: not effect.jacobian_states)

    def uncorrected(self, samples: ImuSamples | SensorSamples) -> np.ndarray:
        """Return the error that remains in corrected ImuSamples, (n, 3), or SensorSamples, (n, k)."""
        mine = (effect for effect in self.effects if samples.channel in effect.channels)
        parts: Iterator[Any] = (effect.uncorrected(samples) for effect in mine)
        return sum(parts, np.zeros(samples.reading.shape))

    def noise_std(self, samples: Samples) -> np.ndarray:
        """Return the standard deviation that the effects add to `samples.channel`, (n,) m.

        It includes the part that is not corrected beyond their domains.
        """
        total = np.zeros(len(samples))
        for effect in self._noisy:
            if samples.channel in effect.channels:
                total += effect.noise_std(samples) ** 2
        for effect in self._limited:
            if samples.channel in effect.channels:
                total += effect.uncorrected_std(samples) ** 2
        return np.sqrt(total)

    def outside(self, samples: Samples) -> list[str]:
        """Return phrases on the effects that fade below FADED_BELOW in some of the Samples."""
        return [
            effect.domain_words
            for effect in self._limited
            if samples.channel in effect.channels
            and np.min(effect.domain_weight(samples), initial=1.0) < FADED_BELOW
        ]

    @cached_property
    def _limited(self) -> list[Effect]:
        return [effect for effect in self.effects if effect.domain]

    @cached_property
    def _noisy(self) -> list[Effect]:
        return [effect for effect in self.effects if type(effect).noise_std is not Effect.noise_std]

    @cached_property
    def of_attitude(self) -> EffectSet:
        """Return the effects on TDOAs and ranges that depend on the attitude of the tag."""
        return self.where(lambda effect: effect.uses_attitude)

    def acting_on(self, channel: str) -> EffectSet:
        """Return the effects that bias a channel of RADIO."""
        return self.where(
            lambda effect: channel in effect.channels and type(effect).bias is not Effect.bias
        )

    @cached_property
    def uses_pose(self) -> bool:
        """Return whether the correction of a TDOA depends on the pose of the tag."""
        of_tdoas = (effect for effect in self.effects if "tdoa" in effect.channels)
        return any(effect.uses_pose or effect.domain for effect in of_tdoas)

    @cached_property
    def needs_motion(self) -> bool:
        """Return whether an effect depends on more than poses."""
        return any(effect.needs_motion for effect in self.effects)

    @cached_property
    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        """Return all SensorFunctions: errors of inertial samples that the filter corrects."""
        return tuple(function for effect in self.effects for function in effect.sensor_functions())

    def near_ground_delays(
        self, anchors: Anchors
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return delays of anchors near the ground, as `FloorMultipath.near_ground_delays`, or None."""
        for effect in self.effects:
            if effect.is_hypothesis:
                return effect.near_ground_delays(anchors)
        return None

    def stamp_offset(self, stream: str) -> float:
        """Return by how many seconds the stamps of a stream of a Flight are late."""
        return sum(effect.stamp_offset(stream) for effect in self.effects)

    def correct_streams(self, flight: Flight) -> Flight:
        """Return the Flight with its streams corrected, see StreamCorrector."""
        corrector = StreamCorrector(self.effects)
        return flight.replaced(
            **{name: corrector.correct(name, part) for name, part in flight.streams.items()}
        )

    @classmethod
    def from_yaml(cls, path: str | Path) -> EffectSet:
        """Read effects.yaml; raise InputError."""
        content = read_yaml(path)
        entries = content.get("effects") if isinstance(content, dict) else None
        if not isinstance(entries, dict):
            raise InputError(f"{path}: expected a mapping 'effects' of effect name to values.")
        effects = []
        for name, entry in entries.items():
            kind = _kind(str(name))
            if kind is None:
                known = ", ".join([*EFFECTS, "smooth_term_1, ..."])
                raise InputError(f"{path}: effect {name!r} is not known; known are {known}.")
            allowed = (*ENTRY, *kind.settings)
            entry = entry or {}
            given = map(str, entry) if isinstance(entry, dict) else ["(not a mapping)"]
            refuse_others(f"{path}: {name}", given, allowed)
            try:
                effects.append(kind(**entry))
            except (TypeError, AttributeError) as error:
                raise InputError(
                    f"{path}: {name}: values and std must be mappings of parameter to number."
                ) from error
        if content.get("covariance") is None:
            return cls(tuple(effects))
        values = {name: effect.values for name, effect in zip(map(str, entries), effects)}
        return cls(tuple(effects), Covariance.from_dict(content["covariance"], values, path))

    def to_yaml(self, path: str | Path) -> None:
        """Write the file that `from_yaml` reads."""
        entries: dict[str, dict[str, Any]] = {}
        for effect in self.effects:
            entry = {name: _plain(getattr(effect, name)) for name in (*effect.settings, *ENTRY)}
            # several effects of one kind are numbered; smooth terms always are
            number = 1 + sum(other.name == effect.name for other in self.effects[: len(entries)])
            name = effect.name if number == 1 and not effect.settings else f"{effect.name}_{number}"
            entries[name] = {key: value for key, value in entry.items() if value}
        text = yaml.safe_dump({"effects": entries}, sort_keys=False)
        if self.covariance is not None:
            text += yaml.safe_dump(
                {"covariance": self.covariance.as_dict()},
                sort_keys=False,
                default_flow_style=None,
                width=1000,
            )
        write_text(path, f"# {written_by()}\n{text}")


def _plain(value: Any) -> Any:
    """Return a field of an Effect with lists for tuples, as YAML has them."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _kind(name: str) -> type[Effect] | None:
    """Return the class of an entry, "NAME" or "NAME_NUMBER", or None."""
    head, _, number = name.rpartition("_")
    kinds: dict[str, type[Effect]] = {**EFFECTS, SmoothTerm.name: SmoothTerm}
    return kinds.get(name) or (kinds.get(head) if number.isdigit() else None)


def _finite_or_zero(bias: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(bias), bias, 0.0)


def _moved(samples: Samples, states: tuple[int, ...]) -> Samples:
    """Return the Samples, followed by copies with each state lowered and raised by REACH."""
    n, out = len(samples), samples.repeated(1 + 2 * len(states))
    by = np.zeros((len(out), N_STATES))
    for number, state in enumerate(states):
        for side, step in enumerate((-REACH, REACH)):
            first = (1 + 2 * number + side) * n
            by[first : first + n, state] = step
    position = out.p + by[:, :3]
    if out.motion is None:
        return replace(out, p=position)
    motion = replace(out.motion, velocity=out.motion.velocity + by[:, 3:])
    return replace(out, p=position, motion=motion)


class ImuCorrector:
    """Corrector of inertial samples, for whole streams or one sample after the other.

    It undoes the effects of a set in its order, those that depend on features last.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on inertial samples among `effects`."""
        self._undo = [undoing(effects, channel) for channel in INERTIAL]
        still = np.zeros((1, len(OF_IMU)))
        self._additive = [
            effect
            for effect in effects
            if any(effect.sensor_bias(channel, still) is not None for channel in INERTIAL)
        ]
        self._features, self._latest = ImuFeatures(), still[:0]
        self.idle = not self._additive and all(undo is IDENTITY for undo in self._undo)

    @property
    def outside(self) -> list[str]:
        """Return phrases on the effects that faded below FADED_BELOW in the latest samples."""
        return [
            effect.domain_words
            for effect in self._additive
            if any(self._is_faded(*limits) for limits in effect.domain.items())
        ]

    def _is_faded(self, covariate: str, limits: tuple[float, float]) -> bool:
        if covariate not in OF_IMU:
            return False
        weights = fade_weight(self._latest[:, OF_IMU.index(covariate)], limits)
        return bool(np.min(weights, initial=1.0) < FADED_BELOW)

    def correct(
        self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return corrected (gyro (n, 3) rad/s, accel (n, 3) m/s^2) of samples at t (n,), s."""
        sensed = [undo(samples) for undo, samples in zip(self._undo, (gyro, accel))]
        if self._additive:
            self._latest = features = self._features(t, *sensed)
            for effect in self._additive:
                for channel, samples in zip(INERTIAL, sensed):
                    part = effect.sensor_bias(channel, features)
                    if part is not None:
                        samples -= np.where(np.isfinite(part), part, 0.0)
        return sensed[0], sensed[1]


class StreamCorrector:
    """Corrector of the streams of a recording, whole or one measurement after the other.

    It corrects ids, signs, stamps and values of all sensors. The biases of TDOAs and ranges are
    corrected by Corrector.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on streams among `effects`; they are undone in their order."""
        self._late = {
            stream: sum(effect.stamp_offset(stream) for effect in effects) for stream in STREAMS
        }
        self._labels = [effect for effect in effects if isinstance(effect, LabelEffect)]
        self._imu = ImuCorrector(effects)
        self._undo = {channel: undoing(effects, channel) for channel in STREAM_OF}

    def correct(self, name: str, stream: Any) -> Any:
        """Return the corrected stream `name` of a Flight, or its next part."""
        if self._late[name]:
            stream = replace(stream, t=stream.t - self._late[name])
        if name == "tdoa" and self._labels:
            a, b, d = relabelled(self._labels, stream.a, stream.b, stream.d)
            return replace(stream, a=a, b=b, d=d)
        if name == "imu" and not self._imu.idle:
            gyro, accel = self._imu.correct(stream.t, stream.gyro, stream.accel)
            return replace(stream, gyro=gyro, accel=accel)
        if name not in SENSOR_NAMES:
            return stream
        for channel, part in stream.parts.items():
            stream = stream.with_part(channel, self._undone(channel, part))
        return self._undone(name, stream)

    def _undone(self, channel: str, stream: Stream) -> Stream:
        undo = self._undo[channel]
        if undo is IDENTITY:
            return stream
        std = getattr(stream, "std", None)
        if std is None:
            return stream.with_values(undo(stream.values))
        known = np.isfinite(std)  # an axis that was not measured may hold any value
        variance = np.where(known, std, UNKNOWN_STD) ** 2 @ undo.matrix.T**2
        std = np.where(variance < UNKNOWN_VARIANCE, np.sqrt(variance), np.inf)
        values = undo(np.where(known, stream.values, 0.0))
        corrected: Any = stream.with_values(values)  # has a std, as `stream` has
        return replace(corrected, std=std)
