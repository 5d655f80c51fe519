# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bias models trained on flights drawn at random."""

import argparse

from training_flights import flight

from studies.training import splits
from uwb_tdoa_tools.scoring.gains import SHARES


def errors(*ratios):
    """As of Shrinkage: of flights with an error of 0.5 m, ratios at all SHARES."""
    return {
        str(k): {None: 0.5} | dict(zip(SHARES, (0.5 * ratio for ratio in some)))
        for k, some in enumerate(ratios)
    }


def test_splits_are_done_once_and_summed_up(tmp_path, monkeypatch, capsys):
    made, flights = [], [flight(seed) for seed in range(2)]

    def split(flights, uncorrected_errors, seed, fit, kinds):
        for kind in kinds:
            made.append((kind, seed))
            told = {
                "left_out": splits._text(errors((1, 0.9, 0.8, 0.7))),
                "judged": splits._text(errors((1, 0.9, 0.9, 1.2))),
            }
            yield {"seed": seed, "kind": kind, **told}

    monkeypatch.setattr(splits, "split", split)
    monkeypatch.setattr(splits.inputs.Reading, "flights", lambda *_: flights)
    monkeypatch.setattr(splits.shrinking, "uncorrected", lambda _: {})
    parser = argparse.ArgumentParser()
    splits.add_options(parser.add_argument)
    options = ["--models", "structured", "--splits", "2"]
    splits.run(parser.parse_args(["x", "--out", str(tmp_path / "rows"), *options]))
    assert made == [("structured", 0), ("structured", 1)]
    assert (
        "| structured | 2 | -20.0% | 0.0% | -20.0% | 1.20 | 2 of 2 | 30.0% | 1.00 |"
        in capsys.readouterr().out
    )
