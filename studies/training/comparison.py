# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Train every kind of bias model on the same flights, and compare the resulting estimates on other
flights.
"""

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.scoring.metrics import pooled
from uwb_tdoa_tools.training import labels as labelling, models, physics

from . import bounds
from .pictures import plot_bars, plot_histograms

BOUNDS = {"oracle 0.5 s": 0.5, "oracle 1 s": 1.0, "oracle 2 s": 2.0}


def compare(train, tests, kinds, out, seed=0, validation=None, bound=False):
    """Train, run, and draw. Returns a dict of plain values.

    train : list of Flight
    tests : {group: list of Flight}
    kinds : of choices.MODELS
    out : folder, Path
    validation : names or None
    bound : with oracles and repeatability

    Raises InputError.
    """
    out.mkdir(parents=True, exist_ok=True)
    names, correctors, skipped = _trained(train, kinds, out, seed, validation)
    rows, errors, normalised = (
        [],
        {kind: [] for kind in correctors},
        {kind: [] for kind in correctors},
    )
    scores = {group: {kind: [] for kind in correctors} for group in tests}
    for group, flights in tests.items():
        for flight in tqdm(flights, desc=group, unit="flight", disable=None, leave=False):
            labels = labelling.labels(flight)
            row = {"group": group, "flight": flight.name}
            for kind, (effects, network) in correctors.items():
                score = evaluate(flight, None, effects, network)[0]
                scores[group][kind].append(score)
                row[kind] = score.row()["rmse_3d"]
                error, std = remaining(labels, effects, network)
                errors[kind].append(error)
                if network:
                    normalised[kind].append(
                        error**2 / (std**2 + labelling.white_noise([labels]) ** 2)
                    )
            if bound:
                row |= {
                    name: bounds.rmse(flight, bounds.oracle(flight, window))
                    for name, window in BOUNDS.items()
                }
            rows.append(row)
    errors = {kind: np.concatenate(parts) for kind, parts in errors.items()}
    report = {
        "training": names[0],
        "validation": names[1],
        "skipped": skipped,
        "runs": rows,
        "seed": seed,
    }
    report["tdoa_rms"] = {
        kind: float(np.sqrt(np.mean(values**2))) for kind, values in errors.items()
    }
    report["normalised_variance"] = {
        kind: float(np.mean(np.concatenate(parts))) for kind, parts in normalised.items() if parts
    }
    report["consistency"] = {
        group: {kind: _consistency(some) for kind, some in parts.items()}
        for group, parts in scores.items()
    }
    report["groups"] = {
        group: _means([row for row in rows if row["group"] == group]) for group in tests
    }
    if bound:
        report["repeatability"] = _repeatability(
            [labelling.labels(flight) for flight in train], tests
        )
    plot_histograms(errors, out / "histograms.png")
    bars = {
        group: {kind: means[kind] for kind in correctors}
        for group, means in report["groups"].items()
    }
    plot_bars(bars, out / "rmse.png")
    return report


def _trained(train, kinds, out, seed, validation):
    """((names to train on, to validate on), {kind: (EffectSet or None, Network or None)}, {kind
    left out: why}).
    """
    known = {flight.name: flight for flight in train}
    names = labelling.split(list(known), seed, validation)
    correctors, skipped = {"none": (None, None)}, {}
    parts = [[known[name] for name in group] for group in names]
    effects_found = (
        physics.find_effects(sum(parts, []))
        if any(kind.startswith("physics") for kind in kinds)
        else None
    )
    for kind in kinds:

        def say(text, kind=kind):
            tqdm.write(f"{kind}: {text}")

        try:
            trained = models.train(
                models.Recipe(kind, seed), *parts, kind, progress=say, found=effects_found
            )
        except InputError as error:
            skipped[kind] = str(error)
            tqdm.write(f"{kind}: left out: {error}")
            continue
        folder = out / kind.replace("+", "_")
        folder.mkdir(exist_ok=True)
        model, effects = models.save(trained, folder)
        correctors[kind] = (
            EffectSet.from_yaml(effects) if effects else None,
            Network(model) if model else None,
        )
    return names, correctors, skipped


def remaining(labels, effects, network):
    """Errors of the TDOAs of Labels after correction at the true poses, and the deviation
    predicted: (n,), (n,) m.
    """
    samples, left, std = labels.samples, labels.error.copy(), np.zeros(len(labels))
    if effects:
        left -= effects.bias(samples)
    if network:
        bias, std, _ = network.predict(samples)
        left -= np.nan_to_num(bias)
    return left, std


def _repeatability(known, tests):
    """{which pairs: (mean correlation, number of pairs)} of training flights with each other and
    with each group.
    """
    found = {
        "training with training": [
            (one, other) for k, one in enumerate(known) for other in known[:k]
        ]
    }
    for group, flights in tests.items():
        found[f"training with {group}"] = [
            (labelling.labels(flight), one) for flight in flights for one in known
        ]
    out = {}
    for name, pairs in found.items():
        values = np.array([bounds.repeatability(one, other)[0] for one, other in pairs])
        values = values[np.isfinite(values)]
        out[name] = (float(values.mean()) if len(values) else float("nan"), len(values))
    return out


def _consistency(scores):
    """(NEES of the position, share of the time inside three standard deviations on the worst axis),
    runs pooled.
    """
    together = pooled(scores)
    return together["nees_mean"], min(together[f"coverage_3sigma_{axis}"] for axis in "xyz")


def _means(rows):
    return {
        key: float(np.mean([row[key] for row in rows]))
        for key in rows[0]
        if key not in ("group", "flight")
    }
