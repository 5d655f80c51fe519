"""default-model: models/default.onnx of uwb_tdoa_bias, the model that bias_node corrects with if it
is given no other.

The structured model, trained on simulated flights: antennas and received power of DW1000 modules,
nothing of any hall. How much of its prediction measured flights bear out, and how much remains that
it does not know, is then taken from those: its mean is scaled by the one, its standard deviation is
the other. Prints what the model does on each day's flights when that day took no part.
"""

import copy
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.foundation.files import write_bytes
from uwb_tdoa_bias.foundation.flight import AIDS
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.training import labels as labelling
from uwb_tdoa_tools.training import models, structured

from . import simulated

FLIGHTS, SEED, SPACING = 20, 100, 0.02  # in each constellation; first seed; s between samples
OPTIONS = structured.StructuredPriors(centres=10, link_centres=100)
PLACES = simulated.TRAINING + simulated.UNSEEN


def add_options(add):
    """The options of the study."""
    add("flights", nargs="+", metavar="FLIGHT", help=inputs.HELP)
    add("--survey", metavar="S", help=inputs.SURVEY_HELP)
    add("--out", metavar="FILE", type=OutputFile, required=True, help="where to write the model")


def run(args):
    """Make, judge and write the model."""
    days = {}
    reading = inputs.Reading(args.survey)
    for path, survey in reading.find(args.flights):
        days.setdefault(Path(survey).stem, []).append(reading.read((path, survey)).without(*AIDS))
    model, meta = learn(FLIGHTS)
    known = {day: [labelling.labels(flight) for flight in flights] for day, flights in days.items()}
    for day, flights in days.items():
        others = [one for other, some in known.items() if other != day for one in some]
        with TemporaryDirectory() as folder:
            network = write(scaled(model, others), meta, Path(folder) / "model.onnx")
            errors = [
                [evaluate(f, None, None, n)[0].row()["rmse_3d"] for n in (None, network)]
                for f in tqdm(flights)
            ]
        before, after = np.mean(errors, axis=0)
        print(f"{day}: {len(flights)} flights, 3D RMSE {before:.3f} m without, {after:.3f} m with")
    final = scaled(model, [one for some in known.values() for one in some])
    network = write(final, meta, args.out)
    print(
        f"wrote {args.out}: {network.name}, {args.out.stat().st_size / 1e3:.0f} kB, floor "
        f"{final.floor:.3f} m"
    )


def learn(count, options=OPTIONS):
    """(Structured, metadata) from `count` simulated flights in each of PLACES, of which it forgets
    the places.
    """
    flights = simulated.flights(PLACES, count, SEED, tqdm)
    known = [labelling.labels(flight) for some in flights.values() for flight in some]
    thin = labelling.thinned(known, SPACING, np.random.default_rng(0))
    meta = {
        "name": "default",
        "kind": "structured",
        "clip": models.CLIP,
        "seed": SEED,
        "data": labelling.digest(known),
        "trained_on": [f"{count} simulated flights in {place}" for place in PLACES],
        "constellations": labelling.constellations(known),
        "largest_yaw_std": LARGEST_YAW_STD,
    }
    model = models.fit_structured(thin, 0, options)[0]
    # what holds for all anchors is kept; each is then at a site of which nothing is known
    model.site_ids, model.site_positions, model.weights = (
        model.site_ids[:0],
        model.site_positions[:0],
        model.weights[:0],
    )
    return model, meta


def scaled(model, measured):
    """The Structured model scaled to what Labels of measured flights bear out; what remains of them
    is its floor.
    """
    error = np.concatenate([one.error for one in measured])
    told = np.concatenate([model.mean(one.samples) for one in measured])
    share = float(np.clip(np.sum(told * error) / np.sum(told**2), 0.0, 1.0))
    out = copy.deepcopy(model)
    for weights in out.link_weights.values():
        weights *= share
    out.floor = float(
        np.sqrt(np.mean((error - share * told) ** 2) - labelling.white_noise(measured) ** 2)
    )
    print(f"{share:.2f} of the prediction is borne out; what remains: {out.floor:.3f} m")
    return out


def write(model, meta, path):
    """Write the model; returns it as a Network."""
    write_bytes(path, model.onnx(meta).SerializeToString(deterministic=True))
    return Network(path)
