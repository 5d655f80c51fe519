"""Systematic effects, and `effects.yaml`: which of them are in the model, with which values.

The file, written by people and by the tools, read by the nodes:

    effects:
      anchor_delay:
        values: {0: 0.05, 3: -0.02}     # m
        std: {0: 0.004, 3: 0.004}       # optional
        source: "static calibration, 12 points"
      tag_lever_arm:
        values: {x: -0.012, y: 0.001, z: 0.091}
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ..errors import InputError
from .anchor_delay import AnchorDelay
from .base import Effect, Samples
from .tag_lever_arm import TagLeverArm

__all__ = ["EFFECTS", "AnchorDelay", "Effect", "EffectSet", "Samples", "TagLeverArm"]

EFFECTS = {effect.name: effect for effect in (AnchorDelay, TagLeverArm)}


@dataclass(frozen=True)
class EffectSet:
    """The effects that are in the model, in the order in which they are listed."""

    effects: tuple = ()

    @property
    def name(self):
        """Names joined by '+', or "none"."""
        return "+".join(effect.name for effect in self.effects) or "none"

    def __len__(self):
        return len(self.effects)

    def bias(self, samples):
        """Sum of all contributions to d_ab, (n,) metres. An effect that cannot tell (unknown attitude) adds nothing."""
        total = np.zeros(len(samples))
        for effect in self.effects:
            part = effect.bias(samples)
            total += np.where(np.isfinite(part), part, 0.0)
        return total

    @classmethod
    def from_yaml(cls, path):
        """Read effects.yaml; raises InputError."""
        try:
            content = yaml.safe_load(Path(path).read_text())
        except (OSError, yaml.YAMLError) as error:
            raise InputError(f"{path}: cannot be read as YAML ({error}).") from error
        entries = content.get("effects") if isinstance(content, dict) else None
        if not isinstance(entries, dict):
            raise InputError(f"{path}: expected a mapping 'effects' of effect name to values.")
        effects = []
        for name, entry in entries.items():
            if name not in EFFECTS:
                raise InputError(f"{path}: effect {name!r} is not known; known are {', '.join(EFFECTS)}.")
            entry = entry or {}
            unknown = set(entry) - {"values", "std", "source"} if isinstance(entry, dict) else {"(not a mapping)"}
            if unknown:
                raise InputError(f"{path}: {name}: {sorted(unknown)[0]!r} is not one of values, std, source.")
            try:
                effects.append(EFFECTS[name](**entry))
            except (TypeError, AttributeError) as error:
                raise InputError(f"{path}: {name}: values and std must be mappings of parameter to number.") from error
        return cls(tuple(effects))

    def to_yaml(self, path):
        """Write what `from_yaml` reads."""
        entries = {}
        for effect in self.effects:
            entry = {"values": dict(effect.values), "std": dict(effect.std), "source": effect.source}
            entries[effect.name] = {key: value for key, value in entry.items() if value}
        Path(path).write_text(yaml.safe_dump({"effects": entries}, sort_keys=False))
