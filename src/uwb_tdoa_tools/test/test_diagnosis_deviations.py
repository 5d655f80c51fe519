"""Deviations of positions of anchors that are found beside ground truth: whether errors are as large as they say."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.deviations import with_deviations
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.readers import inputs
from known_effects import clean_flight

MEASURED = {  # recordings on which nothing was chosen, and how far off their surveys are put, m
    "util/const1-trial2-tdoa2.csv.gz": 0.1,
    "util/const3-trial1-tdoa2.csv.gz": 0.05,
    "util/const4-trial1-tdoa2-traj3.csv.gz": 0.1,
    "flights/0425/TDOA2/0425-traj2": 0.1,
    "flights/0426/0426-traj5": 0.05,
}


def normalised(flight, std, seed):
    """(errors of found coordinates over their deviations, over those of the fit alone) of a Flight whose anchors are put off by std, m."""
    off = std * np.random.default_rng(seed).standard_normal((len(flight.anchors), 3))
    shaken = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    found = attribute([shaken], GroundTruth(), undeclared=False)
    bare = found.selection.only(found.selection.chosen).fit  # fitted anew: without the deviations that hold
    places = {f"{i}.{axis}": -off[row, k] for row, i in enumerate(flight.anchors.ids) for k, axis in enumerate("xyz")}
    out = []
    for model in (found.selection.fit, bare):
        rows = [k for k, column in enumerate(model.columns) if column.effect == ("anchor_position",)]
        true = np.array([places[model.columns[k].key] for k in rows])
        out.append((model.beta[rows] - true) / np.sqrt(np.diag(model.cov))[rows])
    return out


def root(several):
    return float(np.sqrt(np.mean(np.concatenate(several) ** 2)))


@pytest.mark.slow
def test_deviations_hold_on_simulated_flights():
    told = [normalised(clean_flight(seed, 60.0), 0.1, seed)[0] for seed in (502, 503, 504, 505)]
    assert 0.7 < root(told) < 1.5 and all(len(one) == 24 for one in told)


@pytest.mark.slow
def test_deviations_hold_on_measured_flights(shared_data):
    """Those of the fit alone are two to four times too small: what is wrong beside the anchors is wrong all of the flight."""
    reading, told, fitted = inputs.Reading(str(shared_data / "surveys")), [], []
    for path, std in MEASURED.items():
        (flight,) = reading.flights([str(shared_data / path)])
        holds, alone = normalised(flight, std, 12)
        told.append(holds)
        fitted.append(alone)
        assert root([holds]) < 1.8, path
    assert 0.7 < root(told) < 1.5 < root(fitted)


def test_what_is_no_anchor_keeps_its_deviation():
    found = attribute([clean_flight(300, 30.0)], GroundTruth(), undeclared=False)
    assert with_deviations(found.selection) is found.selection
