"""What is undone, and whether that explains more."""

from dataclasses import replace
from types import SimpleNamespace

from checking_flights import recording
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.checking import tdoa_rules
from uwb_tdoa_tools.checking.ordered import LONG, SPREAD, OrderedRecording, spread
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.readers.inputs import Reading


@pytest.fixture(scope="module")
def healthy():
    return OrderedRecording.of(recording())


@pytest.mark.slow
def test_a_healthy_recording_has_no_finding(healthy):
    shifted = Anchors(
        healthy.anchors.ids, healthy.anchors.positions * 1.3, healthy.anchors.orientations
    )
    finding, same = tdoa_rules.best_trial(healthy, [("other.yaml", shifted)])
    assert finding is None and same is healthy


@pytest.mark.parametrize(
    "scale, unit",
    [
        (1e3, "millimetres"),
        (1.0 / 0.0046917639, "ticks"),
        (1.0 / 0.299792458, "nanoseconds"),
        (1e-6 / 299.792458, "seconds"),
    ],
)
def test_a_unit_is_found_and_undone(healthy, scale, unit):
    finding, undone = tdoa_rules.best_trial(healthy.with_tdoa(d=scale * healthy.tdoa.d))
    assert finding.rule == "tdoa_unit" and unit in finding.cause
    assert np.allclose(undone.tdoa.d, healthy.tdoa.d)


@pytest.mark.slow
def test_swapped_ids_are_found_and_undone(healthy):
    one, two = healthy.anchors.ids[[2, 5]].tolist()
    swapped = tdoa_rules.relabelled(healthy, {one: two, two: one})
    finding, undone = tdoa_rules.best_trial(swapped)
    assert finding.rule == "ids_swapped" and finding.severity == "error"
    assert np.array_equal(undone.tdoa.a, healthy.tdoa.a) and np.array_equal(
        undone.tdoa.b, healthy.tdoa.b
    )
    assert str({one: two, two: one}) in finding.remedy


def test_surveys_of_one_room_are_named_together(healthy):
    wrong = replace(
        healthy,
        anchors=Anchors(
            healthy.anchors.ids, healthy.anchors.positions[::-1], healthy.anchors.orientations
        ),
    )
    by_millimetres = Anchors(
        healthy.anchors.ids, healthy.anchors.positions + 0.004, healthy.anchors.orientations
    )
    trials = list(
        tdoa_rules.other_survey(
            wrong, [("monday.yaml", healthy.anchors), ("tuesday.yaml", by_millimetres)]
        )
    )
    assert len(trials) == 1 and "monday.yaml or tuesday.yaml" in trials[0].finding(0.5, 9.0).cause
    assert list(tdoa_rules.other_survey(healthy, [("monday.yaml", by_millimetres)])) == []


@pytest.mark.parametrize("table", [{1: 2, 2: 1}, {0: 3, 3: 5, 5: 0}])
def test_ids_are_replaced_all_at_once(healthy, table):
    back = {new: old for old, new in table.items()}
    there = tdoa_rules.relabelled(healthy, table)
    again = tdoa_rules.relabelled(there, back)
    assert np.array_equal(again.tdoa.a, healthy.tdoa.a) and not np.array_equal(
        there.tdoa.a, healthy.tdoa.a
    )


def test_trials_use_the_part_with_the_most_motion():
    t = np.arange(0.0, 100.0, 0.01)
    d = np.where((t > 60.0) & (t < 80.0), np.sin(t), 0.0)
    zeros = np.zeros(len(t), dtype=int)
    ordered = OrderedRecording.of(recording())
    still = replace(ordered, tdoa=replace(ordered.tdoa, t=t, a=zeros, b=zeros + 1, d=d), imu=None)
    part = still.part(14.0)
    assert (
        58.0 < part.tdoa.t[0]
        and part.tdoa.t[-1] < 82.0
        and part.tdoa.t[-1] - part.tdoa.t[0] == pytest.approx(14.0, abs=0.1)
    )
    assert still.part(200.0) is still


def test_ids_are_not_tried_without_motion():
    hovering = OrderedRecording.of(recording(10, trajectory="hover"))
    assert spread(hovering.survey_fit.places) < SPREAD
    assert list(tdoa_rules.swapped_ids(hovering)) == []


@pytest.mark.parametrize("gain, believed", [(0.5, True), (2.0, False)])
def test_a_gain_within_systematic_errors_is_no_evidence(healthy, monkeypatch, gain, believed):
    """The same trial, judged where systematic errors are said to be small, and where they are said
    to be large.
    """
    flipped = tdoa_rules._flipped(healthy, np.ones(len(healthy.tdoa), dtype=bool))
    least = gain * (flipped.part(LONG).unexplained().mean - healthy.part(LONG).unexplained().mean)
    monkeypatch.setattr(tdoa_rules, "BY_ERRORS", least)
    for rule in ("swapped_ids", "inverted_pairs", "moved_anchor", "units"):
        monkeypatch.setattr(tdoa_rules, rule, lambda *_: iter(()))
    finding, _ = tdoa_rules.best_trial(flipped)
    assert (finding is not None and finding.rule == "tdoa_sign") == believed


class _Fit(SimpleNamespace):
    """A SurveyFit of enough windows."""

    def __len__(self):
        return tdoa_rules.FEWEST


@pytest.mark.parametrize(
    "seconds, gain, held, believed",
    [(16.0, 0.098, 0.083, False), (45.0, 0.098, 0.083, True), (16.0, 0.11, 0.1, True)],
)
def test_a_piece_of_the_room_needs_more_evidence(seconds, gain, held, believed):
    """In 16 s the tag sees a part of the room: other anchors describe the systematic errors there."""
    fit = _Fit(before=0.2, all_moved=(0.2 - gain, None), held_out_gain=held, seconds=seconds)
    assert (tdoa_rules.gained(fit) is not None) == believed


@pytest.mark.parametrize(
    "name, begin, seconds",
    [
        ("0422/0422-log02", 0.0, 16.0),
        ("0425/TDOA2/0425-traj1", 0.0, 12.0),
        ("0426/0426-traj1", 25.0, 25.0),
        ("0426/0426-traj7", 32.0, 16.0),
        ("0426/0426-traj11", 25.0, 25.0),
    ],
)
def test_no_piece_of_a_measured_flight_has_the_survey_of_another_room(
    shared_data, name, begin, seconds
):
    (found,) = Reading(shared_data / "surveys").find([shared_data / "flights" / name])
    whole = OrderedRecording.of(read_recording(Reading(), *found))
    start = whole.tdoa.t[0] + begin
    rows = slice(*np.searchsorted(whole.tdoa.t, [start, start + seconds]))
    piece = replace(whole, tdoa=rows_of(whole.tdoa, rows), imu=None)
    assert tdoa_rules.apparent_gain(piece.survey_fit) > 0.065  # the limit before
    assert tdoa_rules.gained(piece.survey_fit) is None
