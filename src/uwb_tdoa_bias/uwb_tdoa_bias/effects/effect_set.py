"""`effects.yaml`: which effects are in the model, with which values."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from ..foundation.errors import InputError
from ..foundation.files import write_text
from ..foundation.safe_yaml import read_yaml
from ..foundation.version import written_by
from .base import Effect
from .catalogue import EFFECTS
from .covariance import Covariance
from .fading import LITTLE, faded, in_words
from .samples import RADIO
from .smooth_term import SmoothTerm
from .stream_corrector import STREAMS, StreamCorrector

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight
    from .samples import AidSamples, ImuSamples, Samples
    from .sensor_function import SensorFunction

ENTRY = ("values", "std", "source", "domain")


@dataclass(frozen=True)
class EffectSet:
    """The effects that are in the model, in the order in which they are listed. covariance : of
    some of their values together, or None; corrections do not need it.
    """

    effects: tuple[Effect, ...] = ()
    covariance: Covariance | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        """Names joined by '+', or "none"."""
        return "+".join(effect.name for effect in self.effects) or "none"

    def __len__(self) -> int:
        return len(self.effects)

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def bias(self, samples: Samples) -> np.ndarray:
        """Sum of all contributions to what `samples.channel` measures, (n,) metres, faded where
        they were not seen. An effect whose size is not known there (unknown attitude) adds nothing.
        """
        total = np.zeros(len(samples))
        for effect in (effect for effect in self.effects if samples.channel in effect.channels):
            part = faded(effect, samples)[0]
            total += np.where(np.isfinite(part), part, 0.0)
        return total

    @cached_property
    def parted(self) -> tuple[EffectSet, EffectSet]:
        """(EffectSet of those whose part of a TDOA changes steeply with the state of the filter,
        EffectSet of the others).
        """
        steep = tuple(effect for effect in self.effects if effect.states)
        return EffectSet(steep), EffectSet(
            tuple(effect for effect in self.effects if not effect.states)
        )

    def uncorrected(self, samples: ImuSamples | AidSamples) -> np.ndarray:
        """What taking the effects out of a stream leaves of them in ImuSamples, (n, 3), or
        AidSamples, (n, k).
        """
        mine = (effect for effect in self.effects if samples.channel in effect.channels)
        parts: Iterator[Any] = (effect.uncorrected(samples) for effect in mine)
        return sum(parts, np.zeros(samples.reading.shape))

    def noise_std(self, samples: Samples) -> np.ndarray:
        """Standard deviation that the effects add to what `samples.channel` measures, (n,) metres,
        with what of them is not taken out because they were not seen there.
        """
        total = np.zeros(len(samples))
        for effect in self._noisy:
            if samples.channel in effect.channels:
                total += effect.noise_std(samples) ** 2
        for effect in self._limited:
            if samples.channel in effect.channels:
                total += faded(effect, samples)[1] ** 2
        return np.sqrt(total)

    def outside(self, samples: Samples) -> list[str]:
        """Of Samples: phrases on those effects of which less than half is taken out of some,
        because they were not seen there.
        """
        mine = (effect for effect in self._limited if samples.channel in effect.channels)
        return [
            in_words(effect)
            for effect in mine
            if np.min(faded(effect, samples)[2], initial=1.0) < LITTLE
        ]

    @cached_property
    def _limited(self) -> list[Effect]:
        return [
            effect
            for effect in self.effects
            if effect.domain and RADIO.keys() & set(effect.channels)
        ]

    @cached_property
    def _noisy(self) -> list[Effect]:
        return [effect for effect in self.effects if type(effect).noise_std is not Effect.noise_std]

    @cached_property
    def of_attitude(self) -> EffectSet:
        """EffectSet of those whose part of a TDOA changes with the attitude of the tag."""
        return EffectSet(tuple(effect for effect in self.effects if effect.uses_attitude))

    def acting_on(self, channel: str) -> EffectSet:
        """EffectSet of those that add something to what a channel of RADIO measures."""
        return EffectSet(
            tuple(
                effect
                for effect in self.effects
                if channel in effect.channels and type(effect).bias is not Effect.bias
            )
        )

    @cached_property
    def needs_motion(self) -> bool:
        """True if an effect looks at more than poses."""
        return any(effect.needs_motion for effect in self.effects)

    @cached_property
    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        """All SensorFunctions: what the filter itself takes out of inertial samples."""
        return tuple(function for effect in self.effects for function in effect.sensor_functions())

    def on_floor(self, anchors: Anchors) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """What is given to the filter of some Anchors at a tag on the floor, as of
        `FloorMultipath.on_floor`; None if no effect knows.
        """
        return next((effect.on_floor(anchors) for effect in self.effects if effect.weighed), None)

    def stamp_offset(self, stream: str) -> float:
        """Seconds by which the stamps of a stream of a Flight are late, by its name."""
        return sum(effect.stamp_offset(stream) for effect in self.effects)

    def correct_streams(self, flight: Flight) -> Flight:
        """The Flight without the effects' part in its streams, see StreamCorrector."""
        corrector = StreamCorrector(self.effects)
        parts = {name: part for name in STREAMS if (part := getattr(flight, name)) is not None}
        return flight.replaced(
            **{name: corrector.correct(name, part) for name, part in parts.items()}
        )

    @classmethod
    def from_yaml(cls, path: str | Path) -> EffectSet:
        """Read effects.yaml; raises InputError."""
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
            unknown = (
                set(map(str, entry)) - set(allowed)
                if isinstance(entry, dict)
                else {"(not a mapping)"}
            )
            if unknown:
                raise InputError(
                    f"{path}: {name}: {sorted(unknown)[0]!r} is not one of {', '.join(allowed)}."
                )
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
        """Write what `from_yaml` reads."""
        entries: dict[str, dict[str, Any]] = {}
        for effect in self.effects:
            entry = {name: _plain(getattr(effect, name)) for name in (*effect.settings, *ENTRY)}
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
    """A value of a field of an Effect as YAML has it: lists for tuples."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _kind(name: str) -> type[Effect] | None:
    """Class of an entry: a declared effect or smooth_term, with an optional _NUMBER; None if there
    is none.
    """
    head, _, number = name.rpartition("_")
    kinds: dict[str, type[Effect]] = {**EFFECTS, SmoothTerm.name: SmoothTerm}
    return kinds.get(name) or (kinds.get(head) if number.isdigit() else None)
