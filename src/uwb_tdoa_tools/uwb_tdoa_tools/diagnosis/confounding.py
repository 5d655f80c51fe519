"""What a finding could be mistaken for in these very flights, and what the flights cannot tell at all."""

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .fit import prior_sizes
from .select import columns_of

ALIKE = 0.9  # share of a finding's contribution that another effect would explain as well
DISTINCT = 0.4  # smallest weight that is worth naming in a direction

_FLIGHTS = {
    (
        "tag_lever_arm",
        "truth_frame",
    ): "a flight that turns through all headings: the arm turns with the body, the frame does not",
    (
        "anchor_position",
        "tag_lever_arm",
    ): "a flight that turns through all headings and passes on all sides of the anchor",
    ("anchor_delay", "pair_offset"): "TDoA3, where each anchor is heard in many pairs",
    ("anchor_delay", "anchor_position"): "a flight that passes the anchor on several sides, near and far",
    ("anchor_position", "truth_frame"): "a flight through the whole room; several anchors that moved alike are a frame",
    ("tdoa_time_offset", "truth_time_offset"): "a flight with IMU: its stamps belong to neither",
    ("accel_bias", "imu_gravity"): "a flight that tilts, or the vehicle at rest on its sides",
    ("accel_scale", "imu_gravity"): "hard manoeuvres up and down: a scale grows with them, gravity does not",
    ("accel_bias", "accel_scale"): "hard manoeuvres: a scale grows with them, a bias does not",
    ("accel_bias", "imu_misalignment"): "quick turns: a misalignment also shows on the gyroscope",
    ("anchor_clock_drift", "nlos"): "a longer flight: a drift goes on, an obstacle ends",
    ("anchor_clock_drift", "anchor_delay"): "a longer flight",
    ("anchor_delay", "nlos"): "the same path again without the obstacle, or from another side",
    ("antenna_pattern", "received_power_bias"): "one place at many headings, then one heading at many ranges",
    (
        "range_bias",
        "received_power_bias",
    ): "one range at many headings: power changes with the antennas, range does not",
    ("range_bias", "range_scale"): "a flight near to and far from the anchors",
}


def flight_to_tell(one, other):
    """Which flight would tell two effects apart: a sentence."""
    known = _FLIGHTS.get(tuple(sorted((one, other))))
    return known or "a flight on which the two contributions differ: other places, headings and speeds"


def confounded(attribution, candidate):
    """[{"effect", "share", "tell_apart"}]: other declared effects that would explain at least ALIKE of what a chosen
    Candidate contributes, beyond what the rest of the model explains."""
    table, selection = attribution.table, attribution.selection
    now = selection.fit
    root = np.sqrt(now.weight / now.inflation[table.channel]) / now.scale[table.channel]
    others = columns_of([one for one in selection.chosen if one is not candidate])
    rest = table.matrix(others) * root[:, None]
    basis = np.linalg.qr(np.vstack([rest, np.diag(1.0 / prior_sizes(others))]))[0][: len(root)] if others else None

    def free(x):
        return x if basis is None else x - basis @ (basis.T @ x)

    index = {name: k for k, name in enumerate(now.names)}
    beta = now.beta[[index[name] for name in candidate.columns]]
    part = free((table.matrix(candidate.columns) @ beta) * root)
    power, out = float(part @ part), []
    groups = {}
    for other in attribution.candidates:  # the first group of an effect is all of it
        groups.setdefault(other.effect, other)
    for name, other in groups.items():
        columns = [column for column in other.columns if column not in others]
        if name == candidate.effect or not columns or power == 0.0:
            continue
        x, sizes = free(table.matrix(columns) * root[:, None]), prior_sizes(columns)
        solution = np.linalg.solve(x.T @ x + np.diag(1.0 / sizes**2), x.T @ part)
        share = 1.0 - float(np.sum((part - x @ solution) ** 2)) / power
        if share >= ALIKE:
            out.append({"effect": name, "share": round(share, 3), "tell_apart": flight_to_tell(candidate.effect, name)})
    return sorted(out, key=lambda item: -item["share"])


def unobservable(attribution):
    """[{"effect", "direction": {key: weight}}]: combinations of parameters of a declared effect of which these flights
    tell less than plausibility does, by the eigenvectors of the information of a fit of that effect alone."""
    table, now, out, seen = attribution.table, attribution.selection.fit, [], set()
    root = now.weight / (now.inflation[table.channel] * now.scale[table.channel] ** 2)
    for candidate in attribution.candidates:
        if candidate.effect in seen:
            continue
        seen.add(candidate.effect)
        x, sizes = table.matrix(candidate.columns), prior_sizes(candidate.columns)
        information = (x * root[:, None]).T @ x * np.outer(sizes, sizes)
        values, vectors = np.linalg.eigh(information)
        for value, vector in zip(values, vectors.T):
            if value < 1.0:
                named = {
                    key: round(float(w), 2)
                    for key, w in zip(candidate.keys, vector)
                    if abs(w) >= DISTINCT * np.abs(vector).max()
                }
                out.append({"effect": candidate.effect, "direction": named})
    present = {one.effect for one in attribution.candidates}
    missing = [name for name, effect in EFFECTS.items() if effect.fitted and name not in present]
    return out + [{"effect": name, "direction": "the flights lack the channel that shows it"} for name in missing]
