"""Many corrections of one recording at the poses of one run: what a model would change, without finding the poses anew."""

from dataclasses import fields, replace

import numpy as np

from ..effects import EffectSet, Samples
from ..effects.motion import Motion
from .corrector import Correction, Corrector, EFFECTS


class RecordingCorrector(Corrector):
    """A Corrector that keeps the Samples of every batch."""

    idle = False

    def reset(self):
        super().reset()
        self._batches = []

    def samples(self, t, a, b):
        samples = super().samples(t, a, b)
        self._batches.append(samples)
        return samples

    def recorded(self):
        """Samples of the whole run, in the order in which they were corrected."""
        return _joined(self._batches)


class RehearsedCorrector(Corrector):
    """Corrects a whole recording at once, at Samples that a run with another model has recorded."""

    idle = True

    def __init__(self, samples, effects=EffectSet()):
        """samples : Samples of RecordingCorrector; effects : EffectSet."""
        super().__init__(samples.anchors, effects)
        self._recorded = samples

    def correct(self, t, a, b, d):
        samples = replace(self._recorded, t=t)
        bias, noise = self.contribution(samples)
        return Correction(bias, noise, d - bias, np.full(len(t), EFFECTS, dtype=np.uint8))


def _joined(batches):
    first = batches[0]
    names = [field.name for field in fields(Samples) if field.name not in ("anchors", "start", "motion", "extra")]
    parts = {name: [getattr(batch, name) for batch in batches] for name in names}
    joined = {name: np.concatenate(part) for name, part in parts.items() if part[0] is not None}
    if first.motion is not None:
        columns = (np.concatenate([getattr(batch.motion, field.name) for batch in batches]) for field in fields(Motion))
        joined["motion"] = Motion(*columns)
    return replace(first, **joined)
