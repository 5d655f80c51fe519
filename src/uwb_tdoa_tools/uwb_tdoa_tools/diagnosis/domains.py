"""Where effects were seen: the ranges of their covariates in the flights that they were fitted to."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects.covariates import OF_ARRIVAL, OF_TDOA, sensor_covariate


class Seen:
    """Ranges of covariates in the residuals of some flights, each found once."""

    def __init__(self, residuals):
        """residuals : [{channel: ChannelResidual}], one for each flight."""
        self._residuals, self._ranges = residuals, {}

    def limited(self, effects, flights=None):
        """Effects with the domain in which some flights, by their numbers, saw them; default: all. What is not a function of
        anything, and what has a domain already, stays as it is: list."""
        numbers = range(len(self._residuals)) if flights is None else flights
        return [effect if effect.domain else replace(effect, domain=self._domain(effect, numbers)) for effect in effects]

    def _domain(self, effect, numbers):
        out = {}
        for covariate in effect.covariates:
            ranges = [self._range(number, channel, covariate) for number in numbers for channel in effect.channels]
            ranges = [one for one in ranges if one is not None]
            if ranges:
                out[covariate] = min(low for low, _ in ranges), max(high for _, high in ranges)
        return out

    def _range(self, number, channel, covariate):
        """(least, largest) of a covariate in a channel of a flight; None where it is not known."""
        key = number, channel, covariate
        if key not in self._ranges:
            part = self._residuals[number].get(channel)
            self._ranges[key] = None if part is None else _range(channel, part, covariate)
        return self._ranges[key]


def _range(channel, part, covariate):
    samples = part.samples
    if not hasattr(samples, "a"):  # of a sensor of the vehicle, and of no pair of anchors
        values = sensor_covariate(covariate, samples)
    elif covariate in OF_ARRIVAL:
        values = OF_ARRIVAL[covariate](samples, np.concatenate([samples.a, samples.b]))[np.tile(part.fitted, 2)]
    else:
        values = OF_TDOA[covariate](samples)
        values = None if values is None else values[part.fitted]
    values = values[np.isfinite(values)] if values is not None else ()
    return (float(f"{values.min():.6g}"), float(f"{values.max():.6g}")) if len(values) else None
