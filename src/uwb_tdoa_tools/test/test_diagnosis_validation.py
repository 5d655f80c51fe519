# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import fields, replace
import pickle
from types import SimpleNamespace

from known_effects import effect_of, sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.corrector import Corrector, FixedPoseCorrector, FixedPoses
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, EffectSet, SmoothTerm, TagLeverArm
from uwb_tdoa_bias.effects.samples import Track
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import poses_of
from uwb_tdoa_tools.diagnosis import validation
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.comparison import (
    Baseline,
    ValidationCase,
    _gain_interval,
    compare,
    score,
    why_not,
)
from uwb_tdoa_tools.diagnosis.detectors import Detection
from uwb_tdoa_tools.diagnosis.over_flights import Share
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.validation import (
    LEAST_WORTH,
    Displacements,
    _dropped,
    _Trials,
    _worse_in_one,
    cross_fitted,
    select_by_error,
    validation_cases,
)
from uwb_tdoa_tools.scoring.metrics import NO_DIFFERENCE

TRUTH = GroundTruth()
NONE = EffectSet()


@pytest.fixture(scope="module")
def flights():
    return [
        effect_of("anchor_delay", True, 1).inject(sparse_flight(seed, 30.0)) for seed in (100, 101)
    ]


@pytest.fixture(scope="module")
def attribution(flights):
    return attribute(flights, TRUTH, undeclared=False)


@pytest.fixture(scope="module")
def single(flights):
    """Return the Attribution of the first flight."""
    return attribute(flights[:1], TRUTH, undeclared=False)


@pytest.mark.slow
def test_every_flight_is_judged_with_effects_that_it_took_no_part_in(flights, attribution):
    cases = cross_fitted(attribution, flights, NONE, attribution.selection.chosen, ())
    assert [case.flight.name for case in cases] == [flight.name for flight in flights]
    values = [list(case.effects.effects[0].values.values()) for case in cases]
    assert values[0] != values[1]
    assert attribution.selection.table.flights == 2


@pytest.mark.slow
def test_each_of_six_flights_is_tried(flights):
    """Three of them left out that a function does harm to a flight of the fit."""
    six = [replace(flight, name=str(k)) for k, flight in enumerate(3 * flights)]
    attribution = attribute(six, TRUTH, undeclared=False)
    trials = _Trials(attribution, six, Baseline(NONE), lambda: None, map)
    cases = trials._cases(attribution.selection.chosen, ())
    assert [case.flight.name for case in cases] == list("012345")


@pytest.mark.slow
def test_an_effect_that_does_harm_to_flights_without_it_is_dropped(attribution):
    clean = [sparse_flight(seed, 30.0) for seed in (100, 101)]
    chosen = attribution.selection.chosen
    dropped = select_by_error(attribution, clean, Baseline(NONE))
    assert dropped.selection.chosen == () and dropped.worth.keys() == set(chosen)
    assert dropped.misleading == {"anchor_delay"}
    assert "the filter does better without it" in dropped.refused[0].why


@pytest.mark.slow
def test_a_displacement_is_used_again_where_corrections_have_not_changed(monkeypatch):
    """Without an accelerometer bias, the correction by the delay of an anchor stays the same."""
    flights = [
        effect_of("accel_bias", True, 1).inject(AnchorDelay({"2": 0.3}).inject(flight))
        for flight in (sparse_flight(100, 30.0), sparse_flight(101, 30.0))
    ]
    found = attribute(flights, TRUTH, undeclared=False)
    several = list(found.selection.chosen)
    assert {one.name for one in several} == {"accel_bias", "anchor_delay"}
    fewer = [one for one in several if one.name == "anchor_delay"]
    runs = []
    judged = validation._judged
    monkeypatch.setattr(validation, "_judged", lambda *args: runs.append(1) or judged(*args))

    def trials():
        return _Trials(found, flights, Baseline(NONE), lambda: None, map)

    again = trials()
    again.start(several, [])
    again.displacements(several, several)
    again.start(fewer, [])
    before = len(runs)
    used = again.displacements(fewer, fewer)
    assert len(runs) == before
    fresh = trials()
    fresh.start(fewer, [])
    computed = fresh.displacements(fewer, fewer)
    assert used.error(fewer) == pytest.approx(computed.error(fewer), rel=0.03)


@pytest.mark.slow
def test_halves_of_a_single_flight_judge_each_other(flights, single):
    first, second = cross_fitted(single, flights[:1], NONE, single.selection.chosen, ())
    together = sorted([*first.spans, *second.spans])
    assert together[::2] == list(first.spans) and together[1::2] == list(second.spans)
    assert all(one[1] == other[0] for one, other in zip(together, together[1:]))
    assert first.effects.effects[0].values != second.effects.effects[0].values


def test_what_helps_is_kept_and_said_what_it_is_worth(flights, attribution):
    kept = select_by_error(attribution, flights, Baseline(NONE))
    assert kept.selection.chosen == attribution.selection.chosen and not kept.refused
    assert kept.worth[kept.selection.chosen[0]] > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect, recurs",
    [
        (EFFECTS["nlos"]({"1.delay": 0.8, "1.start": 8.0, "1.end": 14.0}), False),
        (
            SmoothTerm(
                {"3.c0": 0.0, "3.c1": 0.7},
                covariate="time",
                form="anchor",
                knots=(0.0, 17.0, 32.0),
                shape="step",
            ),
            False,
        ),
        (
            SmoothTerm(
                {"3.c0": 0.0, "3.c1": 0.9},
                covariate="time",
                form="anchor",
                knots=(0.0, 32.0),
                shape="line",
            ),
            True,
        ),
    ],
)
def test_what_happened_at_a_time_of_one_flight_is_said_and_not_kept(effect, recurs):
    flight = effect.inject(sparse_flight(100, 30.0))
    found = attribute([flight], TRUTH)
    kept = select_by_error(found, [flight], Baseline(NONE))
    assert found.selection.chosen and bool(kept.selection.chosen) == recurs
    assert all(kept.worth[candidate] > 0.02 for candidate in found.selection.chosen[:1])
    if not recurs:
        assert any(
            "it happened at a time of this flight" in refused.why for refused in kept.refused
        )


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("rate, worth_it", [(0.006, False), (0.06, True)])
def test_what_is_worth_half_a_millimetre_is_kept_of_any_number_of_flights(
    flights, count, rate, worth_it
):
    several = [EFFECTS["gyro_bias"]({"z": rate}).inject(flight) for flight in flights[:count]]
    found = attribute(several, TRUTH, undeclared=False)
    kept = select_by_error(found, several, Baseline(NONE))
    worth = {candidate.name: of_one for candidate, of_one in kept.worth.items()}
    assert sorted(worth) == ["anchor_delay", "gyro_bias"]
    assert (worth["gyro_bias"] > LEAST_WORTH) == worth_it
    assert ("gyro_bias" in [one.name for one in kept.selection.chosen]) == worth_it
    if worth_it:  # it is applied as tried
        assert np.array_equal(kept.selection.fit.weight, found.selection.fit.weight)
    else:
        assert "it is worth nothing for the position" in kept.refused[-1].why


@pytest.mark.slow
def test_what_no_node_can_take_out_is_not_tried():
    flight = sparse_flight(100, 30.0)
    acceleration = np.linalg.norm(Track(flight.truth).motion(flight.imu.t).acceleration, axis=1)
    turned = np.outer(np.nan_to_num(0.15 * np.minimum(acceleration - 1.0, 1.5)), [1.0, 0.0, 0.0])
    flight = replace(flight, imu=replace(flight.imu, gyro=flight.imu.gyro + turned))
    found = attribute([flight], TRUTH)
    kept = select_by_error(found, [flight], Baseline(NONE))
    assert [candidate.label for candidate in kept.selection.chosen] == ["gyro.x over acceleration"]
    assert not kept.worth and not kept.refused


def test_noise_that_the_filter_should_know_of_is_kept_and_noise_that_it_should_not_is_not(
    flights, attribution
):
    def judged(std):
        noise = Detection(EFFECTS["noise_level"]({"0-1": std, "1-2": std}), "tdoa", {})
        return select_by_error(
            replace(attribution, detections=(noise,)), noisy, Baseline(NONE)
        ), noise

    rng = np.random.default_rng(0)
    noisy = [
        EFFECTS["noise_level"]({"0-1": 0.3, "1-2": 0.3}).inject(flight, rng) for flight in flights
    ]  # the gate does not reject these errors
    kept, noise = judged(0.3)
    assert kept.detections == (noise,) and kept.worth[noise] > 0.0
    noisy = flights
    kept, noise = judged(3.0)
    assert kept.detections == () and "the filter does better without it" in kept.refused[-1].why


def test_a_run_corrected_at_the_poses_of_the_run_itself_is_that_run(flights):
    effects = EffectSet((AnchorDelay({"1": 0.3}), TagLeverArm({"x": 0.1, "z": 0.1})))
    run = run_offline(flights[0], None, Corrector(flights[0].anchors, effects))
    again = run_offline(
        flights[0],
        None,
        FixedPoseCorrector(flights[0].anchors, effects, FixedPoses(poses_of(run.odometry))),
    )
    np.testing.assert_allclose(again.odometry.p, run.odometry.p, atol=1e-9)


def with_functions(size, start):
    """Return an EffectSet: functions of several forms, and effects by velocity, time and position."""
    function = {"knots": (1.0, 2.0, 3.0), "shape": "beyond"}
    return EffectSet(
        (
            AnchorDelay({"1": size}),
            TagLeverArm({"x": 0.1}),
            SmoothTerm(
                {"3.c0": 0.0, "3.c1": size},
                covariate="range",
                form="anchor",
                domain={"height": (0.5, 1.0)},
                **function,
            ),
            SmoothTerm({"c0": 0.1, "c1": -size}, covariate="speed", **function),
            SmoothTerm(
                {"0-1.c0": size, "0-1.c1": 0.1},
                covariate="height",
                form="pair",
                factor="x",
                factor_shape="beyond",
                factor_knots=(0.5, 1.0, 1.5),
                **function,
            ),
            EFFECTS["nlos"]({"2.start": start, "2.end": 20.0, "2.delay": size}),
        )
    )


def test_models_that_share_poses_correct_as_alone(flights):
    """Trials share covariates, domains and basis functions, not values."""
    flight = flights[0]
    odometry = run_offline(flight, None, Corrector(flight.anchors)).odometry
    shared = FixedPoses(poses_of(odometry))
    models = [with_functions(0.2, 0.0), with_functions(-0.3, 5.0), with_functions(0.2, 0.0)]
    models.insert(1, models[0].where(lambda effect: not effect.needs_motion))
    for effects in models:
        alone = FixedPoses(poses_of(odometry))
        expected, found = (
            run_offline(flight, None, FixedPoseCorrector(flight.anchors, effects, fixed))
            for fixed in (alone, shared)
        )
        np.testing.assert_array_equal(found.bias, expected.bias)
        np.testing.assert_array_equal(found.bias_std, expected.bias_std)
        np.testing.assert_array_equal(found.odometry.p, expected.odometry.p)
    assert len(pickle.dumps(shared)) < 1.1 * len(pickle.dumps(poses_of(odometry)))


def test_before_and_after_with_intervals(flights):
    told = EffectSet((effect_of("anchor_delay", True, 1),))
    before, after = compare([ValidationCase(flight, told) for flight in flights], Baseline(NONE))
    assert after["pooled"]["rmse_3d"] < 0.5 * before["pooled"]["rmse_3d"]
    low, high = after["pooled"]["rmse_3d_ci"]
    assert low < after["pooled"]["rmse_3d"] < high
    low, high = after["pooled"]["rmse_3d_gain_ci"]
    assert 0.4 < low < high < 1.0
    wider = after["pooled"]["rmse_3d_gain_elsewhere"]
    assert wider[0] < low and high < wider[1] < 1.0
    cases = [ValidationCase(flight, told, untold=0.01) for flight in flights]
    untold = compare(cases, Baseline(NONE))[1]
    worst = np.mean(
        [np.log(np.hypot(row["rmse_3d"], 0.1) / row["rmse_3d"]) for row in after["runs"]]
    )
    expected = 1.0 - (1.0 - wider[0]) * np.exp(worst)
    elsewhere = untold["pooled"]["rmse_3d_gain_elsewhere"]
    assert elsewhere == pytest.approx([expected, wider[1]])
    assert untold["runs"][0]["rmse_3d_elsewhere"] > untold["runs"][0]["rmse_3d"]
    assert [row["flight"] for row in after["runs"]] == [flight.name for flight in flights]
    for side in (before, after):
        for row in side["runs"]:
            assert row["phases"]["in_the_air"]["rmse_3d"] == pytest.approx(row["rmse_3d"])
            assert {"first_3_s", "last_3_s", "whole"} <= set(row["phases"])
        assert side["pooled"]["phases"]["whole"]["runs"] == len(flights)
    first, second = (side["pooled"]["phases"]["first_3_s"]["rmse_3d"] for side in (before, after))
    assert second < first


@pytest.mark.slow
def test_halves_of_a_flight_count_what_is_before_and_after_the_fit_once(flights, single):
    cases, run = cross_fitted(single, flights[:1], NONE, (), ()), Baseline(NONE).run(flights[0])
    parts, whole = (
        [score(case, run).phases() for case in cases],
        score(ValidationCase(flights[0], NONE), run).phases(),
    )
    for name, figures in whole.items():
        assert sum(part[name]["duration"] for part in parts) == pytest.approx(
            figures["duration"]
        ), name
        assert (
            figures["count"] <= sum(part[name]["count"] for part in parts) <= figures["count"] + 10
        ), name  # on an edge, in both


def test_without_flights_held_out_it_is_said_that_the_choice_was_made_on_the_same(
    flights, attribution
):
    chosen_on = "chosen on all of them"
    assert chosen_on in validation_cases(attribution, flights, (), NONE, NONE)[1]
    assert chosen_on not in validation_cases(attribution, flights[:1], flights[1:], NONE, NONE)[1]


def test_a_flight_that_the_filter_gives_no_estimate_of_ends_in_a_sentence(flights):
    tdoa = flights[0].tdoa
    few = replace(
        flights[0],
        imu=None,
        tdoa=replace(tdoa, **{f.name: getattr(tdoa, f.name)[:3] for f in fields(tdoa)}),
    )
    with pytest.raises(InputError, match=f"{few.name}: the filter gives no estimate"):
        compare([ValidationCase(few, NONE)], Baseline(NONE))


def test_a_gain_that_a_shift_of_the_reference_can_feign_is_none():
    rng = np.random.default_rng(0)
    sides = []
    for off in (0.15, 0.02):
        error = np.repeat(rng.normal(size=(12, 3)) * 0.02 + [0.0, 0.0, off], 100, axis=0)
        score = SimpleNamespace(name="a", t=0.05 * np.arange(len(error)), error=error)
        sides.append({"scores": [score]})
    sure, unsure = (
        _gain_interval(*sides, lambda name, std=std: np.full(3, std)) for std in (0.0, 0.1)
    )
    assert sure[0] > 0.5 and unsure[0] < 0.0 < unsure[1]
    sides = [{"pooled": {"rmse_3d": 0.15}}, {"pooled": {"rmse_3d": 0.04, "rmse_3d_gain_ci": sure}}]
    assert why_not(*sides, 0.0) is None and why_not(*sides, 0.1) is None
    # above zero by 2.3 standard deviations only
    sides[1]["pooled"]["rmse_3d_gain_ci"] = [0.02, 0.28]
    assert "may be 10 cm from where" in why_not(*sides, 0.1)
    sides[1]["pooled"]["rmse_3d_gain_ci"] = unsure
    assert "may be 10 cm from where" in why_not(*sides, 0.1)


@pytest.mark.parametrize(
    "after, interval, sentence",
    [
        (0.148, [-0.05, 0.08], f"together they make {NO_DIFFERENCE} (15.0 -> 14.8 cm"),
        (0.152, [-0.08, 0.05], f"together they make {NO_DIFFERENCE} (15.0 -> 15.2 cm"),
        (0.15, None, f"together they make {NO_DIFFERENCE} (15.0 -> 15.0 cm"),
        (0.18, [-0.3, -0.1], "together they make the error larger on held-out data (15.0 -> 18.0"),
    ],
)
def test_noise_is_described_alike_in_both_directions(after, interval, sentence):
    sides = [{"pooled": {"rmse_3d": 0.15}}, {"pooled": {"rmse_3d": after}}]
    sides[1]["pooled"]["rmse_3d_gain_ci"] = interval
    assert why_not(*sides, 0.0).startswith(sentence)


def test_a_flight_that_gets_worse_refuses_all():
    def side(*errors):
        runs = [{"flight": f"flight-{k}", "rmse_3d": error} for k, error in enumerate(errors)]
        pooled = {"rmse_3d": float(np.mean(errors)), "rmse_3d_gain_ci": [0.2, 0.5]}
        return {"runs": runs, "pooled": pooled}

    assert why_not(side(0.3, 0.1), side(0.1, 0.102), 0.0) is None
    why = why_not(side(0.3, 0.1), side(0.1, 0.104), 0.0)
    assert why == "together they make the error larger on a part of flight-1 (10.0 -> 10.4 cm)"


def displacements(**moved):
    """Return the Displacements of one case with an error of 1 m along x.

    moved : growth of the error along x without each effect, m
    """
    error = np.tile([1.0, 0.0, 0.0], (4, 1))
    changes = {name: [np.tile([by, 0.0, 0.0], (4, 1))] for name, by in moved.items()}
    return Displacements([error], changes)


@pytest.mark.parametrize(
    "moved, gone",
    [
        ({"a": 0.05, "b": -0.0001, "c": 0.0004}, "bc"),
        ({"a": 0.05, "b": 0.0006}, ""),
        ({"a": 0.0}, "a"),
        ({"a": -0.3, "b": 0.2}, "a"),
        # one may be dropped, but not both: each replaces the other
        ({"a": 0.0003, "b": 0.0003}, "a"),
        ({"a": -0.1, "b": -0.1}, "ab"),
    ],
)
def test_what_makes_the_error_larger_or_is_worth_nothing_is_dropped(moved, gone):
    dropped = _dropped(displacements(**moved), list(moved))
    assert sorted(dropped) == list(gone)
    assert all(
        after - before == pytest.approx(moved[one]) for one, (before, after) in dropped.items()
    )


@pytest.mark.parametrize(
    "changes, worst", [((0.5, -0.04), "a"), ((0.5, -0.02), None), ((-0.1, 0.5), "a")]
)
def test_what_makes_one_flight_worse_is_not_applied(changes, worst):
    """changes : change of the error of 1 m without "a", in each of two flights, m."""
    along = [np.tile([by, 0.0, 0.0], (4, 1)) for by in (1.0, *changes)]
    of_both = Displacements([along[0], along[0]], {"a": along[1:], "b": [along[0], along[0]]})
    found = _worse_in_one(of_both, ["a", "b"])
    assert list(found) == ([worst] if worst else [])
    if worst:
        figures = f"{100.0 + 100.0 * min(changes):.1f} cm without, 100.0 cm with"
        assert f"decides: {figures}" in found[worst]


class Some(str):
    """The label of a declared candidate that the nodes can correct."""

    label = name = property(str)
    declared = True
    terms = (SimpleNamespace(effect=SimpleNamespace(usable=True, values={}), function=None),)


class Worth:
    """Trials of effects with known worth. Without both "a" and "b", the error is 0.5 m larger."""

    poses = (None,)

    def __init__(self, worth):
        self.worth = worth

    def set_apart(self, candidates):
        assert not candidates

    def start(self, candidates, detections):
        lost = sum(by for name, by in self.worth.items() if name not in candidates)
        return 1.0 + lost + 0.5 * (not {"a", "b"} & set(candidates))

    error = start

    def displacements(self, candidates, each):
        without = {one: self.start(set(candidates) - {one}, ()) for one in each}
        now = self.start(candidates, ())
        off = {one: [np.array([[error - now, 0.0, 0.0]])] for one, error in without.items()}
        return Displacements([np.array([[now, 0.0, 0.0]])], off)


def selected(monkeypatch, worth, shares=((1.0, 1.0),), flights=2, detections=()):
    """Return the ValidatedSelection of effects by their worth. shares : of each in two flights."""
    trials = Worth(worth)
    of_each = dict(zip(worth, [*shares, *[(1.0, 1.0)] * len(worth)]))
    monkeypatch.setattr(validation, "_Trials", lambda *_: trials)
    monkeypatch.setattr(
        validation,
        "shares",
        lambda _, one, names: [Share(*of) for of in zip("fg", of_each[one], (0.05, 0.05))],
    )
    selection = SimpleNamespace(
        chosen=tuple(map(Some, worth)), kept=lambda candidates, share=None: tuple(candidates)
    )
    trials.selection = selection
    attribution = SimpleNamespace(selection=selection, detections=detections, names=("f", "g"))
    return select_by_error(attribution, [None] * flights, Baseline(NONE))


def test_fewer_are_dropped_where_displacements_do_not_add_up(monkeypatch):
    """Without both, the error is larger than the displacements predict. Without one, it is not."""
    found = selected(monkeypatch, {"a": -0.1, "b": -0.05, "c": 0.2})
    assert found.selection == ("b", "c")
    assert found.worth == {
        "a": pytest.approx(-0.1),
        "b": pytest.approx(0.45),
        "c": pytest.approx(0.2),
    }
    assert "the filter does better without it" in found.refused[0].why
    assert found.misleading == {"a"}


@pytest.mark.parametrize(
    ("worth", "flights", "share"),
    [
        (1.0, 1, 1.0 - 0.5 * (1.0 / 2.5) ** 2),
        (0.5, 1, 1.0 - 0.5 * (1.0 / 2.0) ** 2),
        (1.0, 2, 1.0 - 0.25 * (1.0 / 2.5) ** 2),
        (-1.0, 1, 1.0),
    ],
)
def test_values_shrink_by_the_power_of_the_error_that_remains(monkeypatch, worth, flights, share):
    """Without "a", the error is its worth and 0.5 m larger than 1 m. It is not applied at -1 m."""
    assert selected(monkeypatch, {"a": worth}, flights=flights).share == pytest.approx(share)


@pytest.mark.parametrize(("beside", "kept"), [(0.06, ("c",)), (0.02, ())])
def test_effects_must_gain_beside_the_noise_too(monkeypatch, beside, kept):
    """Without the noise, the effect is worth 0.2 m of 1.2 m. Beside it, it is worth `beside`."""

    def start(self, candidates, detections):
        lost = (beside if detections else 0.2) * ("c" not in candidates)
        return 1.0 + lost - 0.1 * len(detections)

    monkeypatch.setattr(Worth, "start", start)
    monkeypatch.setattr(Worth, "error", start)
    noise = Detection(EFFECTS["noise_level"]({"0-1": 0.3}), "tdoa", {})
    found = selected(monkeypatch, {"c": 0.0}, flights=1, detections=(noise,))
    assert found.selection == kept and found.detections == (noise,)
    why = f"beside the noise that was found, {90 + 100 * beside:.1f} cm without, 90.0 cm with"
    assert [one.why for one in found.refused] == [why] * (not kept)


def test_effects_beside_an_event_of_one_flight_are_judged_again_without_it(monkeypatch):
    """The event is "c". Effect "d" helps beside it, and does harm without it."""

    def start(self, candidates, detections):
        here = set(candidates)
        return 1.0 + 0.4 * ("c" not in here) + 0.2 * (("d" in here) != ("c" in here))

    monkeypatch.setattr(Worth, "start", start)
    monkeypatch.setattr(Worth, "error", start)
    reason = "it happened at a time of this flight"
    monkeypatch.setattr(
        validation, "_why_of_this_flight", lambda _, one: reason if one == "c" else None
    )
    apart = []
    monkeypatch.setattr(Worth, "set_apart", lambda _, candidates: apart.extend(candidates))
    found = selected(monkeypatch, {"c": 0.0, "d": 0.0}, flights=1)
    assert apart == ["c"]
    assert found.selection == () and found.error == pytest.approx(1.4)
    assert found.worth == {"c": pytest.approx(0.6), "d": pytest.approx(-0.2)}
    event, harmful = found.refused
    assert event.what == "c" and event.why.startswith(f"{reason}, and another one may not have it")
    assert harmful.what == "d" and "the filter does better without it: 140.0 cm" in harmful.why


@pytest.mark.parametrize(
    ("name", "size", "why"),
    [
        ("nlos", 2.3, "an error above 2 m is an obstruction of this flight"),
        (None, -2.3, "an error above 2 m is an obstruction of this flight"),
        (None, 1.4, None),
        ("anchor_delay", 2.3, None),
    ],
)
def test_a_large_error_at_a_place_of_a_single_flight_is_an_obstruction(name, size, why):
    table = SimpleNamespace(matrix=lambda _: np.eye(3)[:, :1], radio_rows=np.array([0, 1]))
    fitted = SimpleNamespace(values=lambda _: np.array([size]))
    selection = SimpleNamespace(table=table, fit=fitted)
    effect = (
        EFFECTS[name]({"3.x": 1.0, "3.radius": 0.6} if name == "nlos" else {}) if name else None
    )
    term = SimpleNamespace(effect=effect or SimpleNamespace(values={}), function=None)
    one = SimpleNamespace(name=name, declared=name is not None, terms=(term,), columns=("c",))
    assert validation._why_of_this_flight(selection, one) == why


def test_what_another_flight_may_not_have_is_said_and_not_kept(monkeypatch):
    found = selected(monkeypatch, {"c": 0.2, "d": 0.1}, [(1.6, 0.0)])
    assert found.selection == ("d",)
    assert found.worth == {"c": pytest.approx(0.2), "d": pytest.approx(0.1)}
    (why,) = [refused.why for refused in found.refused]
    assert why.startswith("another flight may not have it (probability 37%). Belongs to")
