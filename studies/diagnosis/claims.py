# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Describe findings and effects of the grammar in the same terms: stream, subset, covariate, shape.

Some effects of the grammar have a name in the catalogue. For example, an anchor that is late from
one time to another is nlos.
"""

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import true_samples

from .grammar import NAMES

CONSTANT = "nothing"  # that a function depends on
# {declared effect: (subset, covariates, shapes)}; "key": an anchor, a pair or an axis for each
# parameter.
CATALOGUE = {
    "anchor_delay": ("anchor", (), ()),
    "pair_offset": ("pair", (CONSTANT,), ("step",)),
    "anchor_position": ("anchor", ("bearing", "elevation"), ("periodic",)),
    "anchor_clock_drift": ("anchor", ("time",), ("trend",)),
    "range_scale": ("arrivals", ("range",), ("trend",)),
    "range_bias": ("arrivals", ("range",), ("bend", "ramp")),
    "received_power_bias": ("arrivals", ("range",), ("bend", "trend")),
    "antenna_pattern": ("arrivals", ("elevation_in_tag",), ("bend",)),
    # a shift is a function of the direction to each anchor,
    "truth_frame": ("arrivals", ("elevation", "bearing"), ("periodic",)),
    # and so is an arm, in the tag
    "tag_lever_arm": ("arrivals", ("elevation_in_tag", "bearing_in_tag"), ("periodic",)),
    "floor_multipath": ("arrivals", ("height",), ("step", "transient")),
    "gyro_scale": ("axis", ("rate",), ("trend",)),
    "accel_scale": ("axis", ("accel",), ("trend",)),
    "gyro_bias": ("axis", (), ()),
    "accel_bias": ("axis", (), ()),
}
# {shape of a function without a name: shape in the grammar}
SHAPES = {
    "line": "trend",
    "beyond": "ramp",
    "below": "ramp",
    "step": "step",
    "interval": "transient",
    "wave": "periodic",
    "parabola": "bend",
}
NEARLY_ALL = 0.9  # of the TDOAs of a pair, as packets get lost
STREAM = {"imu_gravity": "accel", "imu_misalignment": "gyro"}


@dataclass(frozen=True)
class Claim:
    """A statement about an error.

    stream : as in the grammar
    subset : kind of the subset
    who : frozenset of the anchors, or of the axis
    covariates : the named covariate, then those that are equivalent to it in that flight
    shape, text
    """

    stream: str
    subset: str
    who: frozenset
    covariates: tuple
    shape: str
    text: str

    def names(self, true):
        """Whether another Claim has the same stream and subset."""
        return (self.stream, self.subset, self.who) == (true.stream, true.subset, true.who)

    def depends_as(self, true):
        """Whether another Claim shares a covariate."""
        return bool(set(self.covariates) & set(true.covariates))


def truth_of(effect, flight):
    """Claim of an Undeclared in a Flight.

    A direction counts as a pair if there are hardly any TDOAs in the other direction. The effect of
    a previous anchor counts as a pair if only one pair follows that anchor.
    """
    subset = effect.subset
    if effect.covariate == NAMES and (pair := _only_pair(effect, flight)):
        return Claim(
            effect.stream,
            "pair",
            frozenset(map(str, pair)),
            (effect.covariate, CONSTANT),
            effect.shape,
            effect.name,
        )
    if subset == "direction":
        a, b = effect.who
        back = np.sum((flight.tdoa.a == b) & (flight.tdoa.b == a))
        subset = (
            "direction"
            if back > 0.1 * np.sum((flight.tdoa.a == a) & (flight.tdoa.b == b))
            else "pair"
        )
    who = frozenset(("xyz"[effect.who[0]],) if subset == "axis" else map(str, effect.who))
    return Claim(effect.stream, subset, who, effect.covariates, effect.shape, effect.name)


def _only_pair(effect, flight):
    """Ids of the only pair whose TDOAs the effect changes; None if there is no such pair."""
    samples, _ = true_samples(flight)
    pairs, changed = (
        np.sort(samples.anchors.ids[np.column_stack([samples.a, samples.b])], axis=1),
        effect.bias(samples) != 0.0,
    )
    several, count = np.unique(pairs[changed], axis=0, return_counts=True)
    if not len(several):
        return None
    pair = several[np.argmax(count)]
    of_it = (pairs == pair).all(axis=1)
    return pair.tolist() if min(of_it[changed].mean(), changed[of_it].mean()) > NEARLY_ALL else None


def claims(findings):
    """[Claim] of Findings in the order of the report.

    Applied findings come first, by their worth. The others follow by their prominence. Parts of a
    map come last.
    """

    def place(finding):
        worth = finding.worth or 0.0 if finding.added else 0.0
        return bool(finding.together_with), not finding.added, -worth, -finding.prominence

    out = []
    for finding in sorted(findings, key=place):
        out += _undeclared(finding) if finding.effect.settings else _declared(finding.effect)
    return out


def _undeclared(finding):
    """A Claim for every anchor or pair, or one for all anchors together."""
    effect = finding.effect
    stream, _, axis = effect.channel.partition(".")
    shape, covariates = SHAPES.get(effect.shape, ""), _covariates(finding)
    shape = "step" if effect.covariate == NAMES else shape
    if stream != "tdoa":
        return [Claim(stream, "axis", frozenset((axis,)), covariates, shape, effect.label)]
    parts = dict.fromkeys(key.rpartition(".")[0] for key in effect.values)
    if effect.form in ("common", "arrival") or finding.together_with:
        subset = {"common": "all", "arrival": "arrivals", "anchor": "anchors"}[effect.form]
        return [Claim(stream, subset, frozenset(), covariates, shape, effect.label)]
    return [
        Claim(
            stream,
            effect.form,
            frozenset(part.split("-")),
            covariates,
            shape,
            f"{effect.label} {part} {shape}",
        )
        for part in parts
    ]


def _covariates(finding):
    """Covariates of the function, then of its equivalent alternatives for the same part."""
    own, _, name = finding.effect.label.rpartition(" over ")
    others = (other.effect.rpartition(" over ") for other in finding.alternatives)
    names = (name, *(other for part, _, other in others if part == own))
    # a function of two covariates names both
    return tuple(dict.fromkeys(one for each in names for one in each.split(" and ")))


def _declared(effect):
    """A Claim for every anchor, pair or axis."""
    stream = STREAM.get(effect.name, effect.channels[0])
    if effect.name == "nlos":
        return [
            _nlos(effect, who)
            for who in dict.fromkeys(key.partition(".")[0] for key in effect.values)
        ]
    # no function of the direction alone
    turned = effect.name == "truth_frame" and not set("xyz") & set(effect.values)
    subset, covariates, shapes = (
        ("all", (), ()) if turned else CATALOGUE.get(effect.name, ("all", (), ()))
    )
    if subset in ("arrivals", "all"):
        return [Claim(stream, subset, frozenset(), covariates, (*shapes, "")[0], effect.name)]
    out = {}
    for key in effect.values:
        who = frozenset(key.split("-")) if subset == "pair" else frozenset((key.partition(".")[0],))
        names = tuple(f"{name}_{key}" if subset == "axis" else name for name in covariates)
        out.setdefault(
            who, Claim(stream, subset, who, names, (*shapes, "")[0], f"{effect.name} {key}")
        )
    return list(out.values())


def _nlos(effect, anchor):
    timed = f"{anchor}.start" in effect.values
    covariates = ("time",) if timed else ("x", "y", "height", "range")
    return Claim(
        "tdoa", "anchor", frozenset((anchor,)), covariates, "transient", f"nlos of {anchor}"
    )
