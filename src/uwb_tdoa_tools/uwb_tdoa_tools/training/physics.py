"""Physical effects: what `diagnose` finds among the declared ones in the flights to train on."""

from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import EffectSet

from ..diagnosis import closing
from ..diagnosis.attribute import attribute, effects_of, restricted
from ..diagnosis.findings import Attribution
from ..diagnosis.fit import refit
from ..diagnosis.select import columns_of
from .labels import constellations, level

# What belongs to the tag, to the vehicle and to the modules of the anchors, and goes with them to another place. Where
# the anchors stand, what blocks them there and the anchor-to-anchor links of TDoA2 (pair_offset) belong to one
# installation.
CARRIED = (
    "anchor_delay", "tag_lever_arm", "tdoa_time_offset", "range_scale", "range_bias", "received_power_bias",
    "antenna_pattern", "gyro_bias", "gyro_scale", "accel_bias", "accel_scale", "imu_misalignment", "imu_gravity",
)  # fmt: skip


@dataclass(frozen=True)
class Physics:
    """effects : EffectSet, fitted to all flights; attribution : where they come from."""

    effects: EffectSet
    attribution: Attribution

    def fitted_to(self, flights):
        """EffectSet of the same effects, fitted to the flights with these numbers alone."""
        table, selection = self.attribution.table, self.attribution.selection
        rows = [number in flights for number in table.flight]
        fewer = replace(selection, fit=refit(table, columns_of(selection.chosen), selection.fit, rows))
        return EffectSet(effects_of(fewer))


def separate(effects):
    """(EffectSet of those with parameters in which the error of a TDOA is linear, EffectSet of the others)."""
    linear = [bool(effect.fitted and effect.channels == ("tdoa",) and effect.values) for effect in effects.effects]
    parts = [tuple(e for e, mine in zip(effects.effects, linear) if mine is kind) for kind in (True, False)]
    return tuple(map(EffectSet, parts))


def regressors(effects, samples):
    """Derivatives of the error of Samples by all parameters of linear effects, at zero: (n, k)."""
    parts = [type(effect)().regressors(samples, list(effect.values)) for effect in effects.effects]
    return np.concatenate([np.zeros((len(samples), 0)), *parts], axis=1)


def sizes(effects):
    """Plausible sizes of all parameters, (k,), each in its unit: standard deviations of their priors."""
    return np.array([effect.typical_of(key) for effect in effects.effects for key in effect.values])


def with_values(effects, values, covariance):
    """The same effects with values (k,) of all parameters in turn, and their covariance (k, k)."""
    std, out, first = np.sqrt(np.diag(covariance)), [], 0
    for effect in effects.effects:
        rows = slice(first, first + len(effect.values))
        named = [dict(zip(effect.values, numbers[rows].tolist())) for numbers in (values, std)]
        out.append(type(effect)(*named, "train"))
        first = rows.stop
    return EffectSet(tuple(out))


def find(flights, progress=lambda: None):
    """Physics of Flights with ground truth. progress() is called now and then.

    Of flights in one constellation, all that `diagnose` can name; of several, what goes from one to the other
    (CARRIED). An effect stays if it helps the likelihood of flights that it was not fitted to, and the filter's error
    on them."""
    flights = [level(flight) for flight in flights]
    kinds = CARRIED if len(constellations(flights)) > 1 else None
    attribution = attribute(flights, progress=progress, undeclared=False, kinds=kinds)
    kept, noise, _ = closing.useful(attribution, flights, EffectSet(), None, progress)
    kept = restricted(attribution, kept, noise)
    return Physics(EffectSet(kept.effects), kept)
