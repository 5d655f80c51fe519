# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A diagnosis as a whole: of one flight, over flights, and with repaired ids and signs."""

from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
import json
from types import SimpleNamespace

from known_effects import clean_flight, effect_of, sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.height import Height
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.sensor import shifted
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import diagnosis, parallel
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.diagnose import main
from uwb_tdoa_tools.diagnosis import comparison, diagnose, output, repairing, with_noise
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.findings import Refused
from uwb_tdoa_tools.diagnosis.over_flights import (
    ALL,
    ALONE,
    DIFFERS,
    Share,
    course,
    harm,
    in_words,
    shares,
)
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import OF_ONE
from uwb_tdoa_tools.diagnosis.regression.confounding import Unobservable
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term
from uwb_tdoa_tools.diagnosis.report.page import html
from uwb_tdoa_tools.diagnosis.report.verdict import verdict
from uwb_tdoa_tools.diagnosis.validation import ValidatedSelection
from uwb_tdoa_tools.flying import demo

# --- diagnose ---


@pytest.fixture(scope="module")
def flight():
    return sparse_flight(100, 40.0)


def test_anchors_of_two_installations_are_refused(flight):
    other = replace(
        flight,
        name="elsewhere",
        anchors=Anchors(
            flight.anchors.ids, flight.anchors.positions + 1.0, flight.anchors.orientations
        ),
    )
    with pytest.raises(InputError, match="elsewhere: its anchors are not those"):
        diagnose([flight, other])


def test_streams_that_the_filter_does_not_use_are_left_out_of_everything(flight, monkeypatch):
    seen = []

    def stop(flights, *_, **__):
        seen.extend(flights)
        raise InputError("seen")

    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    monkeypatch.setattr(module, "EffectSearch", stop)
    height = Height(flight.truth.t, flight.truth.p[:, 2])
    config = FilterConfig(use_height=False, use_imu=False)
    with pytest.raises(InputError, match="seen"):
        diagnose([flight.replaced(height=height)], config=config)
    assert seen[0].height is None and seen[0].imu is None and len(seen[0].tdoa)
    unused = module.unused_streams(config)
    assert unused == ("imu", "height") and module.unused_streams(FilterConfig()) == ()
    assert module._only_of(unused, "gyro_bias") and not module._only_of(unused, "anchor_delay")


@dataclass(frozen=True)
class Found:
    """The result of a search without the effects that are left out."""

    left_out: frozenset
    selection: SimpleNamespace
    candidates: tuple = ()


@dataclass(frozen=True)
class ScriptedSearch:
    """A search that finds an error of the ground truth, if it may."""

    left_out: frozenset = frozenset()

    def without(self, names):
        return ScriptedSearch(self.left_out | names)

    def found(self, start=None, own=()):
        assert (start is None) == (not self.left_out), "a repeated search goes on from the last"
        frame = Candidate((Term(EFFECTS["truth_frame"](), ()),))
        chosen = (frame,) * ("truth_frame" not in self.left_out)
        return Found(self.left_out, SimpleNamespace(chosen=chosen))

    def reported(self, found):
        assert found.left_out == self.left_out
        return found


@pytest.mark.parametrize(
    ("errors", "without"),
    [
        ([0.30, 0.20, 0.15, 0.10], {"truth_frame", "anchor_delay", "nlos"}),
        ([0.30, 0.20, 0.195], {"truth_frame"}),
        ([0.30, 0.295, 0.20, 0.195, 0.15], {"anchor_delay", "nlos"}),
        ([0.30, 0.295, 0.295], set()),
    ],
)
def test_the_search_is_repeated_without_what_misleads_the_filter(errors, without, monkeypatch):
    """The frame of the ground truth is left out first. Other refused effects are tried again."""
    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    several = iter(errors)

    def validated(found, *_, poses):
        assert poses == ((None,) if not found.left_out else "of the run before")
        error = next(several)
        worst = next(one for one in ("anchor_delay", "nlos", "") if one not in found.left_out)
        refused = (Refused(worst, "misleads"), Refused("other", str(error)))
        misleading = frozenset((worst,)) - {""}
        selection = SimpleNamespace(own=())
        return ValidatedSelection(
            selection, (), refused, {}, error, misleading=misleading, poses="of the run before"
        )

    monkeypatch.setattr(module, "EffectSearch", lambda *_, **__: ScriptedSearch())
    monkeypatch.setattr(module, "written", lambda selection, _: selection)
    monkeypatch.setattr(module.validation, "select_by_error", validated)
    work = module._Work(None, EffectSet(), None, print, map)
    found, selected = module._searched(work, (), EffectSet())
    assert found.left_out == without
    names = [one.what for one in selected.refused]
    assert without <= set(names) and names.count("other") == 1


def test_an_effect_that_a_repeated_search_leaves_out_is_not_called_unobservable(monkeypatch):
    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    partly = Unobservable("anchor_position", {"0.x": 1.0})
    lacking = [Unobservable(name, None) for name in ("truth_frame", "range_offset", "gyro_bias")]
    monkeypatch.setattr(module, "unobservable", lambda *_: [partly, *lacking])
    found = SimpleNamespace(selection=None, candidates=())
    refused = [Refused("truth_frame", ""), Refused("anchor_position", "")]
    assert module._unobservable(found, ("imu",), refused) == [partly, lacking[1]]


@pytest.mark.slow
def test_what_is_found_is_written_and_takes_the_error_out(diagnosed, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: diagnosed)
    for name in ("late", "other"):
        write_bag(replace(diagnosed.flights[0], name=name), tmp_path / name)
    out = tmp_path / "out"
    assert (
        main([str(tmp_path / "late"), "--holdout", str(tmp_path / "other"), "--out", str(out)]) == 0
    )
    assert "(anchor_delay" in capsys.readouterr().out
    content = json.loads((out / "diagnosis.json").read_text())
    assert {finding["effect"] for finding in content["findings"] if finding["added"]} == {
        "anchor_delay",
        "anchor_position",
    }
    for finding in content["findings"]:
        assert finding["channel"] == "tdoa"
        assert {"parameters", "std", "evidence", "variance_explained", "confounded_with"} <= set(
            finding
        )
    before, after = content["before"]["pooled"]["rmse_3d"], content["after"]["pooled"]["rmse_3d"]
    assert after < 0.3 * before and content["unattributed"] == []
    assert EffectSet.from_yaml(out / "effects.yaml").effects == diagnosed.effects.effects
    page = (out / "report.html").read_text()
    assert "anchor_delay" in page and "data:image/" in page and "http" not in page


@pytest.mark.slow
def test_what_is_late_on_the_floor_goes_to_the_file_whatever_the_air_says(flight):
    result = diagnose([effect_of("floor_multipath", True, 0).inject(flight)])
    assert result.effects.name == "floor_multipath" and not result.refused
    assert result.after["pooled"]["rmse_3d"] == result.before["pooled"]["rmse_3d"]


@pytest.mark.slow
def test_the_floor_is_judged_without_the_effects_that_were_refused(flight, monkeypatch):
    """The report once showed the errors before for both sides, and hid a gain from 40 to 23 cm."""
    on_floor = effect_of("floor_multipath", True, 0).inject(flight)
    late = effect_of("anchor_delay", True, 0).inject(on_floor)
    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    monkeypatch.setattr(module.comparison, "why_not", lambda *sides: "no gain")
    result = diagnose([late])
    assert result.effects.name == "floor_multipath" and result.refused[-1].what == "all"
    baseline = comparison.Baseline(EffectSet())
    before, after = comparison.compare(result.cases, baseline)
    for made, expected in ((result.before, before), (result.after, after)):
        assert made["pooled"]["phases"] == expected["pooled"]["phases"]
    assert after["pooled"]["phases"] != before["pooled"]["phases"]


@pytest.fixture(scope="module")
def late(flight):
    """Return the Diagnosis of the flight with a late anchor."""
    return diagnose([effect_of("anchor_delay", True, 0).inject(flight)])


@pytest.mark.slow
@pytest.mark.parametrize("times, written", [(1.0, True), (200.0, False)])
def test_noise_that_raises_the_error_is_not_written(late, monkeypatch, times, written):
    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    measured = module.measured_noise
    monkeypatch.setattr(module, "measured_noise", lambda *some: times * measured(*some))
    result = with_noise(late)
    assert (result.tdoa_std is not None) == written == (result.written is not None)
    said = " ".join(verdict(result).details)
    assert ("is not written to ekf_node.yaml: the filter does better without it" in said) != written
    if not written:
        assert result.refused[-1].what.startswith("tdoa_std")


@pytest.mark.parametrize(
    "nees, better",
    [((1.0, 2.6), True), ((1.2, 4.0), True), ((3.2, 1.0), False), ((3.0, 5.0), False)],
)
def test_refused_noise_that_makes_deviations_honest_is_named(nees, better):
    without, written = (
        {"rmse_3d": error, "nees_mean": value} for error, value in zip((0.1, 0.12), nees)
    )
    why = import_module("uwb_tdoa_tools.diagnosis.diagnose")._why_not_noise(without, written)
    assert "the filter does better without it" in why
    assert ("the stated deviations fit better" in why) == better


@pytest.mark.slow
def test_of_what_flights_explain_alike_the_mean_is_applied():
    """On a circle along the track, x follows the yaw. In the third flight it does not."""
    heading = SmoothTerm(
        {"4.c1": 0.3}, covariate="yaw", form="anchor", knots=(-np.pi, np.pi), shape="wave"
    )
    *fitted, third = (heading.inject(sparse_flight(seed, 40.0)) for seed in (104, 114, 109))
    found = diagnose(fitted)
    alike = {effect.arguments for effect in found.effects if isinstance(effect, SmoothTerm)}
    assert {("x",), ("yaw",)} <= alike
    error, corrected = (
        comparison.score(case, comparison.run_of(None, case)).rmse_3d
        for case in (
            comparison.ValidationCase(third, effects) for effects in (EffectSet(), found.effects)
        )
    )
    low, high = found.after["pooled"]["rmse_3d_gain_elsewhere"]
    assert corrected < error
    assert low < 1.0 - corrected / error < high
    assert "their mean is applied" in str(verdict(found))
    assert "held already" not in str(verdict(found))
    # the finding is the function itself, the file has its share
    functions = (one.effect for one in found.findings if one.added and one.function)
    (whole,) = (one for one in functions if one.arguments == ("x",))
    (share,) = (one for one in found.effects if one.merge_key == whole.merge_key)
    assert whole.values == pytest.approx({key: 2.0 * value for key, value in share.values.items()})


@pytest.mark.slow
def test_two_processes_give_the_same_to_the_bit():
    flights = [
        effect_of("anchor_delay", True, 4).inject(clean_flight(seed, 18.0))
        for seed in (100, 101, 102)
    ]
    flights[1] = EFFECTS["pair_offset"]({"0-1": 0.3}).inject(flights[1])  # in one flight only
    told = []
    for jobs in (1, 2):
        over = partial(parallel.over, jobs=jobs, unit=None)
        result = with_noise(diagnose(flights, map_function=over), None, over)
        values = [
            (effect.name, effect.values, effect.std, effect.domain)
            for effect in result.effects.effects
        ]
        told.append({**output.as_json(result), "std": result.tdoa_std, "values": values})
    assert json.dumps(told[0]) == json.dumps(told[1])
    assert told[0]["findings"][0]["added"]
    (alone,) = (finding for finding in result.findings if finding.flight)
    assert alone.flight == told[0]["unattributed"][0]["flight"] == flights[1].name
    assert not alone.added
    assert f"belongs to {flights[1].name} alone" in html(result)


@pytest.mark.slow
@pytest.mark.parametrize("inertial", [False, True])
def test_a_late_ground_truth_is_no_fault_of_the_robot(inertial):
    """`diagnose` reported "87 % gone".

    Its tdoa_time_offset of -0.41 s made another flight worse.
    """
    fitted, other = (sparse_flight(seed, 40.0) for seed in (100, 101))
    if not inertial:
        fitted, other = fitted.without("imu"), other.without("imu")
    result = diagnose([shifted(fitted, "truth", 0.4)], [other])
    assert not {"tdoa_time_offset", "truth_frame"} & {effect.name for effect in result.effects}
    assert result.after["pooled"]["rmse_3d"] <= 1.05 * result.before["pooled"]["rmse_3d"]
    (said,) = result.judge_truth[fitted.name]
    assert ("gyroscope" in said) == inertial and said in output.as_text(result).replace(
        "\n          ", " "
    )
    assert list(output.as_json(result)["ground_truth"]) == [fitted.name]


@pytest.mark.slow
def test_without_inertial_sensor_the_clock_of_the_tdoas_is_left_alone():
    # too small for the checks that come first
    late = shifted(sparse_flight(100, 40.0).without("imu"), "tdoa", 0.06)
    result = diagnose([late])
    assert "tdoa_time_offset" not in {effect.name for effect in result.effects}
    assert "tdoa_time_offset" in {item.effect for item in result.unobservable}


@pytest.mark.slow
def test_ground_truth_of_another_epoch_is_one_sentence(flight, tmp_path, capsys):
    write_bag(shifted(flight, "truth", 1.7e9), tmp_path / "epoch")
    assert main([str(tmp_path / "epoch"), "--out", str(tmp_path / "out")]) == 2
    assert "the ground truth is on another clock than the TDOAs" in capsys.readouterr().err


# --- over flights ---


def several(*values, std=0.05):
    return tuple(Share(f"flight-{k}", value, std) for k, value in enumerate(values))


@pytest.mark.parametrize(
    "values, kind",
    [
        ((1.0, 0.9, 1.1), ALL),
        ((0.02, 2.9, 0.1), ALONE),
        ((0.2, 0.7, 1.3, 1.9), DIFFERS),
        ((0.2, 1.9, 0.3, 1.6), DIFFERS),
        ((1.0,), None),
    ],
)
def test_what_several_flights_say(values, kind):
    assert course(several(*values)) == kind


def test_flights_that_tell_nothing_do_not_count():
    assert course((*several(1.0, 1.1), Share("other", 7.0, 3.0))) == ALL
    assert course((*several(1.0), Share("other", 7.0, 3.0))) is None
    assert in_words((*several(1.0), Share("other", 7.0, 3.0))) == ""


def test_words_name_the_flights():
    assert "flight-1 alone" in in_words(several(0.0, 1.0, 0.0))
    assert "0.2 in flight-0" in in_words(several(0.2, 1.9, 0.3, 1.6))
    assert "all 2 flights" in in_words(several(1.0, 1.0))


def test_shares_are_those_that_were_put_in():
    flights = [
        replace(effect_of("anchor_delay", True, 1), values={"2": delay}).inject(
            sparse_flight(100 + k, 30.0)
        )
        for k, delay in enumerate((0.1, 0.2, 0.3))
    ]
    attribution = attribute(flights, GroundTruth(), kinds=("anchor_delay",), undeclared=False)
    (candidate,) = attribution.selection.chosen
    found = shares(attribution.selection, candidate, attribution.names)
    assert [share.share / found[1].share for share in found] == pytest.approx(
        [0.5, 1.0, 1.5], abs=0.05
    )
    assert course(found) == DIFFERS


@pytest.mark.slow
def test_a_function_that_one_flight_alone_can_show_is_not_applied():
    """Anchor 3 is late from 26 to 34 s. The other flight ends before."""
    late = SmoothTerm(
        {"3.c0": 0.0, "3.c1": 0.5},
        covariate="time",
        form="anchor",
        knots=(0.0, 26.0, 34.0, 40.0),
        shape="interval",
    )
    attribution = attribute(
        [late.inject(sparse_flight(100, 40.0)), sparse_flight(101, 24.0)], GroundTruth()
    )
    assert not any(effect.name == late.name for effect in attribution.effects)
    ((name, alone),) = attribution.alone
    assert name == attribution.names[0]
    assert {candidate.terms[0].effect.covariate for candidate in alone.chosen} == {"time"}
    assert OF_ONE in {refused.why for refused in attribution.refused}


def test_what_flights_show_alike_does_no_harm_and_what_one_of_three_lacks_may():
    assert harm(several(1.0, 1.0)) < 0.06
    assert harm(several(1.0, 1.1, 0.9)) < 0.03
    assert harm(several(1.0, 0.2, 1.0)) > 0.25
    assert harm(several(1.5, 0.0)) > 0.2
    # with equal spread, more flights reduce the risk
    assert harm(several(*[1.2, 0.8] * 3)) < harm(several(1.2, 0.8))


def test_flights_that_do_not_determine_a_share_tell_nothing_of_harm():
    assert harm(()) == harm(several(0.0)) == harm(several(0.0, 0.0, std=0.5)) == 0.0
    undetermined = Share("unknown", -3.0, 0.9)
    assert harm([*several(1.0, 1.1, 0.9), undetermined]) == harm(several(1.0, 1.1, 0.9))


# --- repairing ---

IDS, SIGN = (
    EFFECTS["anchor_ids"]({"1": 4, "4": 1}),
    EFFECTS["pair_sign"]({"2-3": -1.0, "5-6": -1.0}),
)
DELAY = EFFECTS["anchor_delay"]({"4": 0.1})


@pytest.fixture(scope="module")
def flights():
    return [clean_flight(seed, 20.0) for seed in (100, 105)]


def wrong(flight, *effects):
    for effect in reversed(effects):
        flight = effect.inject(flight)
    return flight


def found_in(flights, base=EffectSet()):
    return [(one.effect.name, one.effect.values) for one in repairing.repaired(flights, base)]


def test_what_all_flights_have_is_found_and_worth_something(flights):
    found = repairing.repaired([wrong(flight, IDS, SIGN) for flight in flights], EffectSet())
    assert [(one.effect.name, one.effect.values) for one in found] == [
        (IDS.name, IDS.values),
        (SIGN.name, SIGN.values),
    ]
    assert min(found.values()) > 0.01
    assert all(
        one.evidence["median_error_without"] < 0.4 * one.evidence["median_error"] for one in found
    )


def test_sound_flights_need_nothing_nor_do_those_whose_effects_are_known(flights):
    assert found_in(flights) == []
    assert (
        found_in([wrong(flight, IDS, SIGN) for flight in flights], EffectSet((IDS, DELAY, SIGN)))
        == []
    )


def test_signs_that_some_flights_have_are_left_and_so_are_other_ids(flights):
    one, two = flights
    half = EFFECTS["pair_sign"]({"2-3": -1.0})
    assert found_in([wrong(one, SIGN), wrong(two, half)]) == [("pair_sign", {"2-3": -1.0})]
    others = EFFECTS["anchor_ids"]({"1": 5, "5": 1})
    assert found_in([wrong(one, IDS), wrong(two, others)]) == [] == found_in([wrong(one, IDS), two])


def test_flights_are_made_sound_and_the_rest_is_left_in_the_base(flights):
    (found,) = repairing.repaired([wrong(flights[0], IDS, SIGN)], EffectSet((IDS, DELAY)))
    (flight,), base = repairing.sound(
        [wrong(flights[0], IDS, SIGN)], EffectSet((IDS, DELAY)), [found]
    )
    assert (flight.tdoa.a == flights[0].tdoa.a).all() and (flight.tdoa.d == flights[0].tdoa.d).all()
    assert base.effects == (DELAY,)


@pytest.mark.slow
def test_diagnose_offers_it_beside_physics_and_judges_both():
    late = effect_of("anchor_delay", True, 4)
    flights = [wrong(late.inject(sparse_flight(seed, 30.0)), IDS) for seed in (100, 101)]
    result = diagnose(flights[:1], flights[1:])
    assert {finding.effect.name for finding in result.findings if finding.added} == {
        IDS.name,
        late.name,
    }
    worth = next(finding.worth for finding in result.findings if finding.effect.name == IDS.name)
    before, after = (figures["pooled"]["rmse_3d"] for figures in (result.before, result.after))
    # without the repair, the error is three times as large
    assert worth > 2.0 * after and after < 0.3 * before
    assert "anchors are exchanged, 1 and 4" in output.as_text(result) and "ids_exchanged" in str(
        output.as_json(result)["numbers"]
    )
    assert repairing.repaired(flights[:1], result.effects) == {}


def switching(rng, shape, anchors):
    """Return SmoothTerms of anchors that are 0.5 m late at times of their own, over 40 s."""
    begin = rng.uniform(0.0, 9.0)
    pulse = begin, begin + 2.9, begin + 9.2
    random = 0.0, *np.cumsum(rng.exponential(2.5, 14) + 0.3).tolist(), 100.0
    return [
        SmoothTerm({f"{anchor}.c1": 0.5}, covariate="time", form="anchor", knots=knots, shape=shape)
        for anchor, knots in zip(anchors, {"pulse": [pulse] * 2, "switching": [random]}[shape])
    ]


@pytest.mark.slow
@pytest.mark.parametrize("shape, anchors", [("pulse", "14"), ("switching", "3")])
def test_what_switches_is_taken_out_of_each_flight(shape, anchors):
    """It hides what flights share, in the air; a flight without it stays as it is."""
    rng = np.random.default_rng(7)
    clean = [replace(clean_flight(seed, 40.0), name=f"flight-{seed}") for seed in (31, 32)]
    recorded = []
    for flight in clean:
        for effect in switching(rng, shape, anchors):
            flight = effect.inject(flight)
        recorded.append(flight)
    found, named = repairing.without_switching([*recorded, clean[0]], GroundTruth(), EffectSet())
    assert [name for name, _ in named] == ["flight-31", "flight-32"]
    for before, after, right in zip(recorded, found, clean):
        air = np.abs(right.tdoa.t - 20.0) < 14.0
        errors = [np.abs(one.tdoa.d - right.tdoa.d)[air].mean() for one in (before, after)]
        assert errors[1] < 0.25 * errors[0]
    assert found[2] is clean[0]


@pytest.mark.slow
def test_an_obstacle_at_a_place_does_not_switch():
    """It makes an anchor late at times, too, but other flights have it at the same place."""
    flight = clean_flight(31, 40.0)
    x, y, z = np.median(flight.truth.p, axis=0) + [0.8, 0.0, 0.0]
    place = {"3.x": x, "3.y": y, "3.z": z, "3.radius": 1.2, "3.delay": 0.5}
    blocked = EFFECTS["nlos"](place).inject(flight)
    (found,), named = repairing.without_switching([blocked], GroundTruth(), EffectSet())
    assert found is blocked and not named


@pytest.mark.slow
def test_an_obstacle_that_a_flight_seldom_returns_to_is_told_by_another_flight(tmp_path):
    """The first flight alone takes it for an anchor that switches: then nothing was corrected."""
    flights = demo.read(demo.record(3, tmp_path)[:2])
    (found,), named = repairing.without_switching(flights[:1], GroundTruth(), EffectSet())
    assert found is not flights[0] and named
    found, named = repairing.without_switching(flights, GroundTruth(), EffectSet())
    assert list(found) == list(flights) and not named
