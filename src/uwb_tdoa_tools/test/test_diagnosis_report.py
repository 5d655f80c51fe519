# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The report of a diagnosis: verdict, entries, pictures, page and JSON."""

from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
import json
from pathlib import Path
import re
from types import SimpleNamespace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.base import measured
from uwb_tdoa_bias.effects.smooth_term import causes
from uwb_tdoa_tools.command_lines import lines_of_use
from uwb_tdoa_tools.diagnosis import output
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.findings import EffectFinding, Refused
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Heights
from uwb_tdoa_tools.diagnosis.regression.confounding import Alternative, Unobservable
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term
from uwb_tdoa_tools.diagnosis.report import curves, maps, pictures
from uwb_tdoa_tools.diagnosis.report.entries import doubt_in_words, entries, worth_in_words
from uwb_tdoa_tools.diagnosis.report.page import TERMS, html
from uwb_tdoa_tools.diagnosis.report.tables import BASIS, anchors, basis, by_reason
from uwb_tdoa_tools.diagnosis.report.unclear import CANCELS, by_remedy, undetermined
from uwb_tdoa_tools.diagnosis.report.verdict import cause, left_over, verdict
from uwb_tdoa_tools.diagnosis.validation import SELECTED_ON
from uwb_tdoa_tools.scoring.metrics import NO_DIFFERENCE

# --- artificial findings and diagnoses, and parsed pages ---

# Keys of diagnosis.json whose content has names as keys: parameters, anchors, lags.
NAMES_BELOW = {"parameters", "std", "direction", "values"}


def said(page):
    """Return the text of a page, without markup."""
    text = unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.S))
    return " ".join(text.replace("m/s²", "m/s^2").split())


def finding(effect, added=True, worth=0.02, alternatives=(), tried=True, channel="tdoa"):
    candidates = (Candidate((Term(effect, tuple(effect.std)),)),) if tried else ()
    return EffectFinding(effect, channel, {}, 0.1, tuple(alternatives), candidates, added, worth)


def delay(value=0.3, std=0.01):
    return EFFECTS["anchor_delay"]({"3": value}, {"3": std})


def run(name, error, diverged=False):
    return {
        "flight": name,
        "rmse_3d": error,
        "diverged": diverged,
        "rmse_3d_ci": [0.9 * error, 1.1 * error],
    }


def judged(result, before, after, gain, **changes):
    """Return the Diagnosis with other errors.

    before, after : {flight: error, m}
    gain : confidence interval of the gain, m
    """
    sides = []
    for errors in (before, after):
        runs = [
            run(name, *(value if isinstance(value, tuple) else (value,)))
            for name, value in errors.items()
        ]
        pooled = {"rmse_3d": float(np.sqrt(np.mean([item["rmse_3d"] ** 2 for item in runs])))}
        pooled["rmse_3d_ci"] = [0.9 * pooled["rmse_3d"], 1.1 * pooled["rmse_3d"]]
        sides.append({"runs": runs, "pooled": pooled, "scores": result.before["scores"]})
    sides[1]["pooled"]["rmse_3d_gain_ci"] = gain
    return replace(result, before=sides[0], after=sides[1], **changes)


def keys_of(content):
    if isinstance(content, list):
        return set().union(*map(keys_of, content))
    if not isinstance(content, dict):
        return set()
    return set(content).union(
        *(keys_of(item) for key, item in content.items() if key not in NAMES_BELOW)
    )


class Tags(HTMLParser):
    """Collect all tags of a page.

    seen : [(tag, attributes, enclosing tags)]
    open : tags that are not closed
    """

    def __init__(self, page):
        super().__init__()
        self.open, self.seen = [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs), list(self.open)))
        if tag not in ("meta", "br", "img", "source"):
            self.open.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag


# --- the report ---

DOCS = Path(__file__).resolve().parents[3] / "docs"
ELSEWHERE = Alternative("pair_offset", 0.95, None, "TDoA3")
AS_WELL = Alternative("anchor_position", 1.0, 2.0, "a flight on several sides")


@pytest.fixture(scope="module")
def result(diagnosed):
    return replace(diagnosed, applying=lines_of_use(Path("out"), ["other.bag"]))


@pytest.fixture(scope="module")
def page(result):
    return html(result)


# ----------------------------------------------------------------------------------------------------------
# verdict


@pytest.mark.slow
def test_the_headline_has_the_error_before_and_after_its_interval_and_the_flights(result):
    found = verdict(
        judged(result, {"one": 0.3, "two": 0.3}, {"one": 0.2, "two": 0.2}, [0.24, 0.44])
    )
    assert found.kind == "better" and found.applies and found.apply == "Apply effects.yaml."
    fitted = result.flights[0].name
    assert found.headline == (
        "The position error (3D RMSE) falls from 30.0 to 20.0 cm, by 33 % (95 % interval 24 to "
        f"44 %), on hold-out flights one and two, fitted to {fitted}."
    )
    own = verdict(judged(result, {fitted: 0.3}, {fitted: 0.2}, [0.24, 0.44])).headline
    assert own.endswith(f", on {fitted}, every other 5 s corrected with values fitted to the rest.")


def test_the_screen_has_the_verdict_in_a_few_lines(result):
    lines = output.as_text(result).splitlines()
    assert [line[:10].strip() for line in lines if line[:10].strip()] == [
        "verdict",
        "cause",
        "do",
        "fly",
        "apply",
    ]
    assert len(lines) <= 12 and len(verdict(result).sentences) <= 8


def test_the_cause_states_how_sure_it_is(result):
    def cause_of(effect, **options):
        sides = {"one": 0.3}, {"one": 0.1}, [0.5, 0.8]
        return verdict(judged(result, *sides, findings=[finding(effect, **options)])).cause

    assert cause_of(delay()).endswith(
        "Sure (30 standard deviations): no other effect explains these flights as well."
    )
    doubtful = cause_of(delay(), alternatives=(AS_WELL, ELSEWHERE))
    assert doubtful.endswith("Not sure: anchor_position explains these flights as well.")
    vague = EFFECTS["range_scale"]({"scale": 0.1}, {"scale": 0.1})
    assert "its value is not twice the standard deviation" in cause_of(vague)
    assert cause_of(vague).endswith("cm. Not sure.")


def test_three_actions_at_most_each_of_more_than_a_centimetre_and_two_deviations(result):
    effects = [
        EFFECTS["range_scale"]({"scale": 0.1}, {"scale": 0.01}),
        EFFECTS["tag_lever_arm"]({"x": 0.2}, {"x": 0.01}),
        EFFECTS["anchor_position"]({"6.x": 0.25}, {"6.x": 0.01}),
        delay(),
    ]
    found = [finding(one, worth=0.05 - 0.01 * k) for k, one in enumerate(effects)]
    actions = verdict(replace(result, findings=found)).actions
    assert len(actions) == 3 and actions[0].endswith("Worth 5.0 cm.")
    small = [finding(delay(), worth=0.009), finding(delay(0.3, 0.2), worth=0.05)]
    for one in small:
        assert verdict(replace(result, findings=[one])).actions == ()


def test_the_common_part_of_delays_is_subtracted_before_anchors_are_named(result):
    """Anchors 3 and 6 are wrong; the fit divides their mean among all."""
    values = {str(k): -0.0125 for k in range(8)} | {"3": 0.286, "6": -0.212}
    values["0"] = 0.012  # 2.5 cm from the others
    effect = EFFECTS["anchor_delay"](values, dict.fromkeys(values, 0.003))
    changed = replace(result, findings=[finding(effect, worth=0.129)])
    assert set(result.flights[0].anchors.ids) == set(range(8))
    (action,) = verdict(changed).actions
    assert "of anchors 3 and 6: " in action
    assert "anchor 3 0.298 ± 0.003 m late" in action and "6 0.199 ± 0.003 m early" in action
    assert [row[0] for row in anchors(changed).rows] == ["3", "6"]
    assert output.as_json(changed)["findings"][0]["parameters"] == values
    common = EFFECTS["anchor_delay"](dict.fromkeys(values, 0.1), dict.fromkeys(values, 0.003))
    nothing = replace(result, findings=[finding(common)])
    assert verdict(nothing).actions == () and "differs" in entries(nothing)[0].values


@pytest.mark.parametrize(
    "before, after, gained, applies",
    [
        (0.3, 0.2, [0.2, 0.4], True),
        (0.3, 0.29, [-0.1, 0.2], False),
        (0.3, 0.32, [-0.1, -0.02], False),
    ],
)
def test_effects_are_applied_only_if_the_judged_flights_become_better(
    result, before, after, gained, applies
):
    changed = judged(result, {"one": before}, {"one": after}, gained)
    found = verdict(changed)
    assert found.applies == applies == output.as_json(changed)["apply"]
    text = said(html(changed, "verdict"))
    assert ("Do not apply effects.yaml" in text) == (not applies)
    assert (result.applying[0][0] in text) == applies


def test_what_to_fly_next_is_one_sentence(result):
    sides = {"one": 0.3}, {"one": 0.3}, [-0.1, 0.1]
    fly = verdict(judged(result, {"one": 0.3}, {"one": 0.1}, [0.5, 0.8])).fly
    assert fly.startswith("Fly once more, where you will fly later, and diagnose both")
    doubtful = [finding(delay(), alternatives=(AS_WELL,))]
    fly = verdict(judged(result, *sides, findings=doubtful)).fly
    assert fly == "A flight on several sides: it distinguishes anchor_delay from anchor_position."
    other = clean_flight(102, 18.0)
    modes = judged(result, *sides, findings=[], flights=(*result.flights, other))
    assert verdict(modes).fly.startswith("Fly again in TDoA2 or TDoA3, and diagnose all flights")
    again = replace(modes, flights=(*result.flights, other, other))
    assert "Fly again in TDoA2" not in verdict(again).fly


def test_the_report_tells_every_phase_of_the_judged_flights(result, page):
    before, after = (
        side["pooled"]["phases"]["first_3_s"]["rmse_3d"] for side in (result.before, result.after)
    )
    assert after < before
    text = said(page)
    assert "From the floor to the floor" in text
    assert f"{100 * before:.1f} → {100 * after:.1f}; NEES" in text


@pytest.mark.parametrize("gain", [[-0.25, 0.4], [-0.02, 0.06], None])
def test_a_gain_that_may_be_chance_is_not_called_one(result, gain):
    found = verdict(judged(result, {"one": 0.3}, {"one": 0.25}, gain))
    assert found.kind == "unsure" and NO_DIFFERENCE in found.headline and not found.applies


def test_a_gain_that_may_be_small_but_hardly_a_loss_is_called_one(result):
    found = verdict(judged(result, {"one": 0.3}, {"one": 0.25}, [-0.01, 0.34]))
    assert found.kind == "better"
    assert "A loss above 3 % has a probability below 2.5 %." in found.details


def test_a_phase_that_becomes_worse_is_in_the_verdict_with_the_flights_by_name(result):
    changed = judged(result, {"one": 0.3, "two": 0.3}, {"one": 0.2, "two": 0.2}, [0.2, 0.4])
    for side, until, first in ((changed.before, 0.339, 0.2), (changed.after, 0.41, 0.1)):
        side["pooled"]["phases"] = {
            "first_3_s": {"rmse_3d": first, "nees_mean": 3.0},
            "to_0.3_m": {"rmse_3d": until, "nees_mean": 4.1},
        }
    written = {**changed.after, "pooled": {**changed.after["pooled"], "rmse_3d": 0.19}}
    found = verdict(replace(changed, written=written, tdoa_std=0.12))
    more = found.details
    worse = "until z > 0.3 m, from 33.9 cm (NEES 4.1) to 41.0 cm (NEES 4.1)"
    assert found.apply == f"Apply effects.yaml. It makes worse: {worse}."
    # the same again is said once, other figures are said
    assert "With tdoa_std 0.120 m of ekf_node.yaml too it is 19.0 cm." in more
    until = {"rmse_3d": 0.45, "nees_mean": 4.1}
    written["pooled"]["phases"] = {**written["pooled"]["phases"], "to_0.3_m": until}
    more = verdict(replace(changed, written=written, tdoa_std=0.12)).details
    worse = "until z > 0.3 m, from 41.0 cm (NEES 4.1) to 45.0 cm (NEES 4.1)"
    assert f"With tdoa_std 0.120 m of ekf_node.yaml too it is 19.0 cm; worse: {worse}." in more


@pytest.mark.parametrize(
    "changes, is_worse",
    [
        ([0.006, 0.006], False),  # below 1 cm
        ([0.03, 0.03], True),
        ([0.08, -0.02], False),  # within two deviations of the mean over runs
        ([0.08], True),
    ],
)
def test_a_small_change_of_a_phase_is_no_change(result, changes, is_worse):
    names = [f"flight-{k}" for k in range(len(changes))]
    changed = judged(result, dict.fromkeys(names, 0.3), dict.fromkeys(names, 0.2), [0.2, 0.4])
    rest = {"rmse_3d": 0.3, "nees_mean": 3.0}
    for side, of_runs in (changed.before, [0.0] * len(changes)), (changed.after, changes):
        for row, change in zip([*side["runs"], side["pooled"]], [*of_runs, np.mean(of_runs)]):
            row["phases"] = {"at_rest_after": {**rest, "rmse_3d": 0.3 + change}}
    found = verdict(changed)
    assert found.applies and ("at rest after" in found.apply) == is_worse
    on_floor = replace(finding(delay()), on_floor=True)
    floor = verdict(
        replace(changed, findings=[on_floor], before=changed.after, after=changed.before)
    )
    assert floor.kind == "same" and floor.applies == is_worse


def test_healthy_flights_are_called_healthy_and_ask_for_nothing(result):
    """What is worth less than 1 cm may be corrected, and is no error in the hall."""
    sides = {"one": 0.019, "two": 0.019}, {"one": 0.016, "two": 0.016}, [0.05, 0.2]
    found = verdict(judged(result, *sides, findings=[finding(delay(), worth=0.003)]))
    assert found.headline.startswith("Nothing is wrong that costs 1 cm. The position error")
    assert found.actions == () and found.fly.startswith("Nothing before a change")
    assert found.applies and found.apply == "Apply effects.yaml, or leave it."
    wrong = verdict(judged(result, *sides, findings=[finding(delay(), worth=0.05)]))
    assert wrong.headline.startswith("The position error") and wrong.actions


def test_the_verdict_says_why_in_words_of_the_field(result):
    """The verdict first gives the improvement, then the causes.

    For a function without a name, it gives the largest part and the causes.
    """
    functions = [
        SmoothTerm(
            {
                f"{anchor}.c{k}": size * k
                for anchor, size in (("3", 0.01), ("4", 0.3))
                for k in (0, 1)
            },
            {},
            covariate=name,
            form="anchor",
            knots=(0.0, 2.0),
            shape="line",
        )
        for name in ("x", "height")
    ]
    together = Candidate(tuple(Term(term, tuple(term.values)) for term in functions))
    maps = [
        EffectFinding(term, "tdoa", {}, 0.2, (), (together,), True, 0.073) for term in functions
    ]
    shift = EFFECTS["anchor_position"]({"6.x": 0.25, "6.z": 0.1}, {"6.x": 0.01, "6.z": 0.01})
    changed = judged(
        result,
        {"one": 0.304},
        {"one": 0.218},
        [0.2, 0.4],
        findings=[finding(shift, worth=0.012), *maps, finding(delay(), worth=0.001)],
    )
    found = verdict(changed)
    assert "falls from 30.4 to 21.8 cm" in found.headline
    assert found.cause.startswith("Errors that depend on x and height, anchor by anchor")
    assert found.cause.endswith(
        "; the largest: anchor 4 seems 0.3 m farther at most, depending on x, worth 7.3 of 8.6 "
        "cm. Likely that it is there, but not why. Also anchor_position (1.2 cm); what they share is not counted."
    )
    assert "anchor 4 seems 0.15 m farther for each m more of x" in found.actions[0]
    assert "Likely causes: an obstacle or" in found.actions[0]
    assert found.actions[1].startswith("Measure anchor 6 again before you move it")
    titles = [entry.title for entry in entries(changed)]
    assert titles == ["tdoa over x and height (by anchor)", "anchor_position", "anchor_delay"]
    more_than_all = replace(changed, findings=[finding(shift, worth=0.2)])
    assert "worth 20.0 cm." in verdict(more_than_all).cause


def test_an_effect_is_no_part_of_a_gain_that_is_none(result):
    changed = judged(
        result,
        {"one": 0.300},
        {"one": 0.304},
        [-0.03, -0.01],
        findings=[finding(delay(), worth=0.012)],
    )
    found = verdict(changed)
    assert "rises from 30.0 to 30.4 cm" in found.headline
    assert "), worth 1.2 cm. " in found.cause


def test_the_verdict_says_where_it_became_worse_and_what_diverged(result):
    before, after = (
        {"one": 0.3, "two": 0.2, "three": (0.9, True)},
        {"one": 0.1, "two": 0.25, "three": 0.3},
    )
    text = " ".join(verdict(judged(result, before, after, [0.1, 0.5])).details)
    assert "On 1 of 3 runs the error grows, most on two, from 20.0 cm to 25.0 cm." in text
    assert "Of 3 runs, 1 diverged before and 0 after." in text


def test_a_single_judged_flight_and_a_judge_that_was_fitted_are_named_as_such(result):
    own = result.flights[0].name
    alone = verdict(judged(result, {"other": 0.3}, {"other": 0.1}, [0.5, 0.8])).details
    halves = verdict(judged(result, {own: 0.3}, {own: 0.1}, [0.5, 0.8])).details
    assert all(
        "One flight does not tell how much flights differ." in more for more in (alone, halves)
    )
    both = "Some of the judged flights are flights of the fit."
    assert both in halves and both not in alone
    usual = replace(judged(result, {own: 0.3}, {own: 0.1}, [0.5, 0.8]), judged_on=SELECTED_ON)
    assert both not in verdict(usual).details


def test_the_verdict_says_which_share_few_flights_support_and_what_others_will_gain(result):
    for share, flights, expected in ((0.79, 1, True), (0.79, 3, True), (1.0, 1, False)):
        several = result.flights[:1] * flights
        own = result.flights[0].name
        for name in (own, "other"):
            sides = {name: 0.3}, {name: 0.1}
            diagnosed = replace(judged(result, *sides, [0.5, 0.8]), flights=several, share=share)
            more = " ".join(verdict(diagnosed).details)
            assert ("79 % of each fitted value is applied" in more) == expected
            few = expected and flights == 1 and name == own
            assert (
                "expect 0.5 to 0.9 of this gain, and one in ten to get worse by 5 %" in more
            ) == few


def test_nothing_found_and_nothing_added_are_told_apart(result):
    nothing = judged(
        result, {"one": 0.1}, {"one": 0.1}, [0.0, 0.0], findings=[], effects=EffectSet()
    )
    assert verdict(nothing).kind == "nothing" and "looks like noise" in verdict(nothing).cause
    assert "stays 10.0 cm" in verdict(nothing).headline
    useless = replace(nothing, findings=[finding(delay(), added=False, worth=None)])
    assert verdict(useless).kind == "same" and "anchor_delay was found" in verdict(useless).cause
    assert not verdict(useless).applies and not verdict(nothing).applies


def test_what_errors_are_against_is_said_where_only_heights_are_known(result):
    by_height = replace(result, reference=Heights())
    for found in (verdict(by_height), verdict(replace(by_height, findings=[]))):
        assert any("x and y are the filter's own" in sentence for sentence in found.details)
    assert not any("Errors are against" in sentence for sentence in verdict(result).details)
    assert curves.residuals_of_pairs(by_height) == []


@pytest.mark.slow
def test_without_ground_truth_anchors_are_found_and_it_is_said_what_is_not(diagnosed_without_truth):
    added = {finding.effect.name for finding in diagnosed_without_truth.findings if finding.added}
    assert added == {"anchor_position", "anchor_delay"}
    hidden = {item.effect for item in diagnosed_without_truth.unobservable}
    assert {"truth_frame", "accel_bias", "truth_time_offset"} <= hidden


@pytest.mark.slow
def test_without_ground_truth_no_error_is_claimed(diagnosed_without_truth):
    found = verdict(diagnosed_without_truth)
    text = " ".join((*found.sentences, *found.details))
    assert (
        found.kind == "unknown"
        and found.applies
        and "Without ground truth" in text
        and diagnosed_without_truth.judged_on in text
    )
    assert "what it leaves is not above 5.5 cm" in text
    assert "RMSE" not in text and "falls" not in text
    assert curves.residuals_of_pairs(diagnosed_without_truth) == []
    calm = replace(diagnosed_without_truth, findings=[])
    assert verdict(calm).kind == "nothing"


@pytest.mark.slow
def test_without_ground_truth_what_is_not_borne_out_is_not_added_with_the_reason_in_one_place(
    diagnosed_without_truth,
):
    findings = [
        replace(item, added=False)
        for item in (finding(delay()), finding(EFFECTS["range_scale"]({"scale": 0.1})))
    ]
    why = Refused("anchor_delay + range_scale", "explain 20 % of what is slow")
    refused = [*diagnosed_without_truth.attribution.refused, why]
    doubted = replace(
        diagnosed_without_truth, findings=findings, refused=refused, effects=EffectSet()
    )
    found = verdict(doubted)
    assert found.kind == "unknown" and not found.applies
    assert "Not added, anchor_delay + range_scale: explain 20 % of what is slow." in found.details
    assert {entry.why_not for entry in entries(doubted)} == {
        "judged together with others: see the verdict"
    }


def remaining(*flights):
    reference = GroundTruth()
    left = [residuals(reference.prepare(flight), reference, EffectSet()) for flight in flights]
    return SimpleNamespace(flights=flights, remaining=left)


def test_the_pair_the_time_and_the_place_of_the_largest_residual_are_named():
    flight = clean_flight(100, 30.0)
    assert left_over(remaining(flight)) == ()
    of, t = flight.tdoa, flight.tdoa.t - flight.tdoa.t[0]
    a, b = int(of.a[0]), int(of.b[0])
    late = (of.a == a) & (of.b == b) & (t > 15.0) & (t < 20.0)
    odd = replace(flight, tdoa=replace(of, d=of.d + 1.3 * late))
    (sentence,) = left_over(remaining(odd))
    assert f"{a}-{b} from 15 to 20 s, around (" in sentence and "130 cm" in sentence
    (sentence,) = left_over(remaining(flight, replace(odd, name="other")))
    assert "from 15 to 20 s of other, around" in sentence
    assert left_over(SimpleNamespace(flights=(flight,), remaining=[{}])) == ()


# ----------------------------------------------------------------------------------------------------------
# entries


def test_what_came_into_the_model_together_is_one_entry_with_one_worth(result):
    terms = [
        SmoothTerm({"3.c0": 0.1}, {"3.c0": 0.01}, "", "tdoa", name, "anchor", (0.0, 1.0))
        for name in ("x", "y")
    ]
    together = Candidate(tuple(Term(term, ("3.c0",)) for term in terms))
    findings = [
        EffectFinding(term, "tdoa", {}, 0.2, (), (together,), True, 0.015) for term in terms
    ]
    (entry,) = entries(replace(result, findings=findings))
    assert entry.title == "tdoa of anchor 3 over x and y" and worth_in_words(entry) == "1.5 cm"


def test_entries_are_ordered_by_worth_those_not_added_last(result):
    findings = [
        finding(delay(), False, None),
        finding(EFFECTS["range_scale"]({"scale": 0.1}, {"scale": 0.01}), worth=0.01),
    ]
    findings.append(finding(EFFECTS["pair_offset"]({"0-1": 0.1}, {"0-1": 0.01}), worth=0.05))
    found = entries(
        replace(
            result,
            findings=findings,
            refused=[Refused("anchor_delay", "the filter does better without it")],
        )
    )
    assert [entry.title for entry in found] == ["pair_offset", "range_scale", "anchor_delay"]
    assert [bool(entry.why_not) for entry in found] == [False, False, True]
    assert found[2].why_not == "the filter does better without it"


@pytest.mark.parametrize(
    "worth, words, matters",
    [
        (0.0151, "1.5 cm", True),
        (0.0099, "1.0 cm", False),
        (0.0001, "less than 0.1 cm", False),
        (-0.002, "nothing (-0.2 cm)", False),
        (None, "not known", True),
    ],
)
def test_worth_in_words(result, worth, words, matters):
    (entry,) = entries(replace(result, findings=[finding(delay(), worth=worth)]))
    assert worth_in_words(entry) == words and entry.matters == matters


def test_what_is_on_the_floor_alone_is_not_judged_by_the_air(result):
    values = {"2.height": 0.1, "2.noise": 0.3, "2.delay": 2.8}
    floor = replace(
        finding(EFFECTS["floor_multipath"](values, {"2.delay": 0.1}), worth=None), on_floor=True
    )
    changed = judged(result, {"one": 0.3}, {"one": 0.3}, [-0.1, 0.1], findings=[floor])
    assert verdict(changed).headline.startswith("The position error (3D RMSE) stays 30.0 cm")
    assert verdict(changed).actions == ()
    floor_only = "it affects the floor only"
    for first, applies in ((0.351, False), (0.1, True)):
        for side, error in ((changed.before, 0.288), (changed.after, first)):
            side["pooled"]["phases"] = {"first_3_s": {"rmse_3d": error, "nees_mean": 3.0}}
        found = verdict(changed)
        assert found.applies == applies and floor_only in found.apply
        assert f"(first 3 s, from 28.8 cm (NEES 3.0) to {100 * first:.1f} cm" in found.apply
    (entry,) = entries(changed)
    assert worth_in_words(entry) == "not told by errors in the air" and entry.values.startswith(
        "2.delay = 2.8 ± 0.1, "
    )
    told = SmoothTerm(
        {"2.c0": 0.0, "2.c1": -1.5},
        {"2.c1": 0.1},
        covariate="height",
        form="anchor",
        knots=(0.0, 0.1, 1.0),
        shape="step",
    )
    (entry,) = entries(
        judged(
            result,
            {"one": 0.3},
            {"one": 0.3},
            None,
            findings=[replace(finding(told, False, None), on_floor=True)],
        )
    )
    assert "near the floor is told, and not taken out" in entry.why_not


def test_what_else_it_could_be_stands_in_one_place(result):
    (entry,) = entries(
        replace(result, findings=[finding(delay(), alternatives=(AS_WELL, ELSEWHERE))])
    )
    assert doubt_in_words(entry) == [
        "Could as well be anchor_position; to tell: a flight on several sides.",
        "Could be imitated by pair_offset, less plausibly; to tell: TDoA3.",
    ]


@pytest.mark.parametrize(
    "name, values, std, words",
    [
        ("anchor_delay", {"3": 0.3}, 0.01, "3 = 0.30 ± 0.01 (m)"),
        ("anchor_delay", {"3": 0.3, "4": 0.01}, 0.02, "3 = 0.30 ± 0.02 (m)"),
        ("anchor_delay", {"3": 0.3}, 0.2, "no anchor differs significantly from the others"),
        (
            "anchor_delay",
            {str(k): 0.3 for k in range(8)},
            0.2,
            "no anchor differs significantly from the others",
        ),
        (
            "anchor_position",
            {f"{anchor}.{axis}": 0.3 for anchor in range(3) for axis in "xyz"},
            0.2,
            "9 values, none twice its standard deviation: a fitted correction, no anchor has to be "
            "moved",
        ),
        (
            "truth_frame",
            {"x": 0.3, "yaw": 0.075},
            0.01,
            "x = 0.30 ± 0.01 m, yaw = 4.3 ± 0.6 degrees",
        ),
        ("imu_misalignment", {"z": 0.075}, 0.01, "z = 4.3 ± 0.6 (degrees)"),
    ],
)
def test_values_are_shown_as_far_as_they_are_significant(result, name, values, std, words):
    effect = EFFECTS[name](values, dict.fromkeys(values, std))
    (entry,) = entries(replace(result, findings=[finding(effect)]))
    assert entry.values == words


def test_figures_of_trials_have_one_order_and_one_unit():
    rows = by_reason(
        [
            ("one", "the filter does better without it: 14.6 cm without, 16.6 cm with"),
            ("two", "does not make the filter better: 14.6 cm without, 16.6 cm with"),
            ("three", "another flight may not have it (probability 30%)"),
        ]
    ).rows
    assert rows == [
        ("the filter does better without it", "one (14.6 cm without, 16.6 cm with)"),
        ("does not make the filter better", "two (14.6 cm without, 16.6 cm with)"),
        ("another flight may not have it", "three (probability 30%)"),
    ]
    assert basis(rows) == BASIS and basis(rows[2:]) == ""


@pytest.mark.parametrize(
    "name, values, std, words",
    [
        (
            "nlos",
            {"7.delay": 0.69, "7.x": 1.2, "7.y": -3.0, "7.z": 1.51, "7.radius": 1.0},
            {"7.delay": 0.02},
            "something between tag and anchor (nlos; 7.delay = 0.69 ± 0.02 m)",
        ),
        (
            "nlos",
            {"7.delay": 0.69, "7.end": 30.0, "2.delay": 0.8, "2.start": 40.0},
            {"7.delay": 0.02, "2.delay": 0.02},
            "something between tag and anchor (nlos; largest of 2: 2.delay = 0.80 ± 0.02 m)",
        ),
        (
            "floor_multipath",
            {"x": -3.1, "y": 2.0, "0.delay": 1.5, "0.height": 0.2, "1.delay": 2.5},
            {"0.delay": 0.1, "1.delay": 0.1},
            "(floor_multipath; largest of 2: 1.delay = 2.5 ± 0.1 m)",
        ),
        (
            "floor_step",
            {"1.height": 0.4, "1.start": 3.0, "1.end": 21.0},
            {"1.height": 0.01},
            "(floor_step; 1.height = 0.40 ± 0.01 m)",
        ),
        (
            "velocity_slip",
            {"1.share": 0.4, "1.start": 3.0, "1.end": 21.0},
            {"1.share": 0.01},
            "(velocity_slip; 1.share = 0.40 ± 0.01)",
        ),
        (
            "noise_correlation",
            {"std": 0.2, "time": 3.0},
            {},
            "(noise_correlation; std = 0.2 m)",
        ),
        (
            "truth_frame",
            {"z": 0.16, "yaw": 0.1},
            {"z": 0.01, "yaw": 0.01},
            "(truth_frame; largest of 2: yaw = 5.7 ± 0.6 degrees)",
        ),
        (
            "anchor_position",
            {"2.y": 0.9, "2.z": 0.3},
            {"2.y": 0.8, "2.z": 0.4},
            "a fitted correction (anchor_position; largest of 2: 2.y = 0.9 ± 0.8 m): none of its 2 values is "
            "twice the standard deviation, no anchor has to be moved",
        ),
    ],
)
def test_the_largest_size_is_no_place_and_no_time_and_has_its_own_unit(
    result, name, values, std, words
):
    (entry,) = entries(replace(result, findings=[finding(EFFECTS[name](values, std))]))
    assert cause(entry).endswith(words)


# ----------------------------------------------------------------------------------------------------
# unclear causes


def test_what_could_not_be_told_comes_with_what_would_tell(result):
    every = {str(i): 0.35 for i in range(8)}
    items = [
        Unobservable("anchor_delay", every),
        Unobservable("gyro_bias", None),
        Unobservable("accel_scale", {"x": 1.0}),
    ]
    items.append(Unobservable("pair_offset", {"0-1": 0.7, "1-2": -0.7}))
    found = {item.effect: item for item in undetermined(replace(result, unobservable=items))}
    assert (
        found["anchor_delay"].remedy == CANCELS
        and found["anchor_delay"].what == "0, 1, 2, 3, 4, 5, 6 and 7 together"
    )
    assert (
        "gyroscope" in found["gyro_bias"].remedy and found["pair_offset"].what == "0-1 against 1-2"
    )
    assert "other places" in found["accel_scale"].remedy
    assert by_remedy(found.values())[found["accel_scale"].remedy] == [
        "accel_scale (x)",
        "pair_offset (0-1 against 1-2)",
    ]
    assert "anchor_delay" not in str(by_remedy(found.values()))


def test_what_the_flights_have_is_not_asked_for(result):
    """The flights have attitudes, but neither an IMU nor wheels."""
    assert all(np.isfinite(flight.truth.q).all() for flight in result.flights)
    items = [Unobservable("gyro_bias", None), Unobservable("velocity_scale", None)]
    flights = tuple(flight.without("imu") for flight in result.flights)
    asked = [
        item.remedy for item in undetermined(replace(result, unobservable=items, flights=flights))
    ]
    assert asked == ["a gyroscope", "a velocity (wheels, optical flow, visual odometry)"]


@pytest.mark.slow
def test_without_truth_ground_truth_would_tell(diagnosed_without_truth):
    remedies = {item.effect: item.remedy for item in undetermined(diagnosed_without_truth)}
    assert "ground truth" in remedies["truth_frame"]
    assert (
        remedies["accel_bias"] == "ground truth of position and attitude"
    )  # the flight has an accelerometer


# ------------------------------------------------------------------------------------------
# the same in all outputs


def test_the_numbers_of_findings_are_those_of_effects_yaml(result, page, tmp_path):
    result.effects.to_yaml(tmp_path / "effects.yaml")
    written = {
        effect.name: effect for effect in EffectSet.from_yaml(tmp_path / "effects.yaml").effects
    }
    content, screen, text = (
        output.as_json(result),
        " ".join(output.as_text(result).split()),
        said(page),
    )
    added = [item for item in content["findings"] if item["added"]]
    assert {item["effect"] for item in added} == set(written) >= {"anchor_delay", "anchor_position"}
    for item in added:
        effect = written[item["effect"]]
        assert item["parameters"] == effect.values and item["std"] == effect.std
        assert tuple(item["advice"]) == effect.advice()
    value = measured(written["anchor_delay"].values["3"], written["anchor_delay"].std["3"])
    assert f"3 = {value}" in screen and value in text


@pytest.fixture
def undrawn(monkeypatch):
    """Leave the pictures of pages empty: to draw them takes seconds."""

    def instead(figure, alt, caption=""):
        pictures.plt.close(figure)
        return pictures.Picture(alt, "", caption)

    for module in (curves, maps):
        monkeypatch.setattr(module, "embedded", instead)


@pytest.mark.usefixtures("undrawn")
def test_causes_that_functions_share_are_said_once(result):
    functions = [
        SmoothTerm(
            {f"{anchor}.c0": 0.0, f"{anchor}.c1": 0.4},
            covariate=covariate,
            form="anchor",
            knots=(0.0, 1.0, 2.0),
            shape="step",
        )
        for anchor, covariate in ((1, "x"), (4, "y"), (2, "time"))
    ]
    diagnosed = replace(result, findings=[finding(one, worth=0.03) for one in functions])
    of_place, of_time = ("an obstacle or a reflector on that side of it", causes(functions[2])[0])
    actions = verdict(diagnosed).actions
    assert len(actions) == 2 and " ".join(actions).count("Look for why") == 2
    assert functions[0].advice()[0] in actions[0] and functions[2].advice()[0] in actions[1]
    assert actions[0].endswith("Then the same for anchor 4.")  # the folded part describes it
    for cause_of_it in (of_place, of_time):
        assert " ".join(actions).count(f"Likely causes: {cause_of_it}") == 1


def test_all_outputs_say_the_same(result, page):
    content, screen, text = (
        output.as_json(result),
        " ".join(output.as_text(result).split()),
        said(page),
    )
    for sentence in content["verdict"]:
        assert sentence in screen and sentence in text
    for sentence in content["details"]:
        assert sentence not in screen and sentence in text
    for entry in entries(result):
        assert worth_in_words(entry) in text
        for sentence in doubt_in_words(entry):
            assert sentence in text
    for command, _ in result.applying:
        assert command in text
    parts = (
        content["verdict"][0],
        "What to do in the hall",
        "What to fly next",
        "Apply effects.yaml",
        "Everything else",
        "What each effect is worth",
        "Where in the room",
        "What could not be told",
        "Details",
    )
    places = [text.index(part) for part in parts]
    assert places == sorted(places)


def test_findings_and_alternatives_in_json(result):
    doubtful = finding(delay(), alternatives=(AS_WELL, ELSEWHERE))
    content = output.as_json(replace(result, findings=[doubtful]))
    (item,) = content["findings"]
    assert item["alternatives"][0] == {
        "effect": "anchor_position",
        "share": 1.0,
        "criterion_gap": 2.0,
        "tell_apart": "a flight on several sides",
    }
    assert [other["effect"] for other in content["ambiguous"][0]["alternatives"]] == [
        "anchor_position"
    ]
    assert json.loads(json.dumps(content, allow_nan=False)) == content


@pytest.mark.slow
def test_every_key_of_json_is_in_the_document(result, diagnosed_without_truth):
    text = (DOCS / "diagnosis_report.md").read_text()
    term = SmoothTerm({"c0": 0.1}, {}, knots=(0.0, 1.0))
    shown = replace(result, findings=[*result.findings, finding(term)], refused=[Refused("a", "b")])
    keys = keys_of(output.as_json(shown)) | keys_of(output.as_json(diagnosed_without_truth))
    assert {key for key in keys if f"`{key}`" not in text} == set()


# -------------------------------------------------------------------------------------------------------------
# page


@pytest.fixture(scope="module")
def all_pages(page, result, diagnosed_without_truth):
    none = judged(result, {"one": 0.1}, {"one": 0.1}, [0.0, 0.0], findings=[], effects=EffectSet())
    return [page, html(none), html(diagnosed_without_truth)]


@pytest.mark.slow
def test_names_of_others_are_text(result):
    name = """</title><script>alert('"')</script>"""
    flights = tuple(replace(flight, name=name) for flight in result.flights)
    sides = [
        {**side, "runs": [{**run, "flight": name} for run in side["runs"]]}
        for side in (result.before, result.after)
    ]
    page = html(
        replace(result, flights=flights, before=sides[0], after=sides[1], applying=((name, name),))
    )
    assert "<script" not in page and Tags(page).open == []
    assert name in said(page)
    assert any(name in attributes["alt"] for tag, attributes, _ in Tags(page).seen if tag == "img")


@pytest.mark.slow
def test_a_page_is_light_well_formed_holds_all_itself_and_describes_its_pictures(all_pages):
    for page in all_pages:
        assert len(page) < 1_000_000
        assert not [word for word in ("http", "<script", "<link", "url(") if word in page]
        tags = Tags(page)
        assert tags.open == []
        pictures = [attributes for tag, attributes, _ in tags.seen if tag == "img"]
        assert pictures and all(
            len(item["alt"]) > 20 and item["src"].startswith("data:image/") for item in pictures
        )
        assert len({item["alt"] for item in pictures}) == len(pictures)


@pytest.mark.slow
def test_every_abbreviation_is_spelled_out_and_every_effect_explained(all_pages):
    for page in all_pages:
        text, _, meanings = said(page).rpartition("What abbreviations and names of effects mean")
        shown = set(re.findall(r"\b(?:[A-Z]{2,}s?|3D)\b", f"{text} {meanings}")) - {"FLIGHT"}
        assert {"TDOA", "TDOAs", "IMU", "3D"} & shown
        for name in shown:
            assert TERMS[name] in meanings or TERMS[name.rstrip("s")] in meanings, name
        named = {name for name in EFFECTS if re.search(rf"\b{name}\b", text)}
        assert all(EFFECTS[name].row.physics in meanings for name in named)


def test_a_row_is_either_worth_something_or_says_why_it_is_not_in_the_file(result):
    findings = [
        finding(delay(), worth=0.03),
        finding(
            EFFECTS["floor_multipath"]({"2.delay": 2.0}, {"2.delay": 0.1}), False, None, tried=False
        ),
    ]
    changed = replace(
        result,
        findings=findings,
        refused=[Refused("floor_multipath", "does not make the filter better")],
    )
    text = said(html(changed, "worth"))
    assert "3.0 cm" in text
    folded = "Found, and not in effects.yaml why not what does not make the filter better floor_multipath"
    assert folded in text
    assert "yes" not in text.split() and "0 %" not in text


def test_what_is_not_needed_at_once_is_folded_and_the_picture_of_pairs_comes_first(page):
    fold = [("details", {})]
    tags = Tags(page).seen
    alts = [attributes["alt"] for tag, attributes, _ in tags if tag == "img"]
    assert [alt.startswith("Residuals of the TDOAs of each pair") for alt in alts[:3]] == [
        True,
        True,
        False,
    ]
    open_ones = [
        (tag, attributes)
        for tag, attributes, within in tags
        if tag in ("table", "img") and not any(one[0] == fold[0][0] for one in within)
    ]
    assert [tag for tag, _ in open_ones] == ["img", "img"]
    size = [float(re.search(r": ([0-9.]+) cm$", alt).group(1)) for alt in alts[:2]]
    assert size[0] > 3.0 * size[1]


@pytest.mark.parametrize(
    "name, values, worth, added, asked",
    [
        ("anchor_delay", {"3": 0.3}, 0.0095, True, False),
        ("anchor_delay", {"3": 0.3}, 0.0105, True, True),
        ("anchor_delay", {"3": 0.3}, 0.0105, False, False),
        ("outlier_rate", {"share": 0.1}, None, False, False),
        ("pair_sign", {"0-1": -1.0}, 0.001, True, True),  # a fault
    ],
)
def test_what_gains_less_than_a_centimetre_is_asked_of_nobody_unless_it_is_a_fault(
    result, name, values, worth, added, asked
):
    effect = EFFECTS[name](values, {} if name == "pair_sign" else dict.fromkeys(values, 0.01))
    changed = replace(result, findings=[finding(effect, added, worth, tried=worth is not None)])
    (sentence,) = effect.advice()
    assert any(sentence in action for action in verdict(changed).actions) == asked
    rest = said(html(changed, "rest")).partition("Seen too, not worth a visit")[2]
    assert (sentence in rest) == (not asked)
    assert any(line.startswith("do ") for line in output.as_text(changed).splitlines()) == asked


@pytest.mark.parametrize("count", [3, 5])
def test_values_of_many_anchors_are_in_a_table_alone(result, count):
    values = {str(k): 0.3 + 0.01 * k for k in range(count)}
    values |= {str(k): 0.0 for k in range(count, 8)}
    values |= {"8": 0.0, "9": 0.0}
    effect = EFFECTS["anchor_delay"](values, dict.fromkeys(values, 0.01))
    shifts = EFFECTS["anchor_position"](
        {f"{k}.{axis}": 0.2 for k in range(count) for axis in "xz"},
        {f"{k}.x": 0.01 for k in range(count)},
    )
    found = replace(result, findings=[finding(effect), finding(shifts)])
    text = " ".join(verdict(found).actions)
    assert ("anchor 2 0.32 ± 0.01 m late" in text) == (count == 3)
    if count > 3:
        assert "anchors 0, 1, 2, 3 and 4: the table of anchors in report.html has the" in text
    assert "If the survey proves right" in text
    table = anchors(found)
    assert list(table.head) == ["anchor", "x, cm", "z, cm", "late by, cm"]
    assert table.rows[2][1] == "+20 ± 1" and table.rows[2][3] == "+32 ± 1"


def test_labels_of_anchors_lie_on_nothing(result, monkeypatch):
    drawn = []
    monkeypatch.setattr(maps, "embedded", lambda figure, *_: drawn.append(figure))
    caption, _ = maps.maps(result)
    assert (
        "Triangles: anchors" in caption
        and f"Flight: {result.before['runs'][0]['flight']}." in caption
    )
    assert len(drawn) == 2
    for figure in drawn:
        figure.canvas.draw()
        for ax in figure.axes[:2]:
            boxes = [text.get_window_extent() for text in ax.texts if text.get_text()]
            (triangles,) = [line for line in ax.lines if line.get_marker() == "^"]
            marks = ax.transData.transform(triangles.get_xydata())
            assert not any(
                one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k]
            )
            assert not any(box.contains(*mark) for box in boxes for mark in marks)
        pictures.plt.close(figure)


def test_a_blocked_region_is_on_the_map_and_in_the_list(result):
    values = {"1.x": -0.9, "1.y": -1.2, "1.z": 2.0, "1.radius": 1.0, "1.delay": 0.5}
    effect = EFFECTS["nlos"](values, {"1.delay": 0.02})
    changed = replace(result, findings=[finding(effect)], effects=EffectSet((effect,)))
    shifts, (region,) = maps.shifts_and_regions(changed)
    assert shifts == {} and region.anchor == 1 and region.radius == 1.0
    assert all("1 region where an anchor is disturbed" in one.alt for one in maps.maps(changed)[1])
    assert "anchor 1 and (-0.9, -1.2, 2.0) m" in " ".join(verdict(changed).actions)


def test_shifts_of_anchors_add_up_over_effects(result):
    effects = (
        EFFECTS["anchor_position"]({"6.x": 0.2}, {"6.x": 0.03}),
        EFFECTS["anchor_position"]({"6.x": 0.1}, {"6.x": 0.04}),
    )
    by, std = maps.shifts_and_regions(replace(result, effects=EffectSet(effects)))[0][6]
    assert by[0] == pytest.approx(0.3) and std[0] == pytest.approx(0.05)


# ---------------------------------------------------------------------------------------------------------
# pictures


def score(error):
    """Return the Score of a flight from one cell into the next, ten samples each.

    errors : (n, 3) m.
    """
    places = np.where(np.arange(20)[:, None] < 10, [0.5, 0.5, 1.5], [1.5, 0.5, 1.5])
    return SimpleNamespace(t=5.0 + np.arange(20) * 0.1, first=5.0, p=places, error=np.array(error))


def test_runs_without_an_estimate_are_left_out(result):
    lost = score(np.full((20, 3), np.nan))
    assert maps.flown([lost]) == []
    late = score(np.where(np.arange(20)[:, None] < 5, np.nan, 0.1) * np.ones(3))
    (run,) = maps.flown([late])
    assert len(run.t) == 15 and run.t[0] == pytest.approx(0.5)
    sides = [{**side, "scores": [lost]} for side in (result.before, result.after)]
    changed = replace(result, before=sides[0], after=sides[1])
    assert curves.errors_over_time(changed) == ([], 0) and "estimated path" in maps.maps(changed)[0]


def test_a_curve_keeps_its_largest_value():
    t, values = np.arange(10_000) * 0.01, np.zeros(10_000)
    values[7_777] = 5.0
    shown = curves._peaks(t, values)
    assert len(shown[0]) <= curves.BINS and shown[1].max() == 5.0


@pytest.mark.parametrize("shape, knots", [("step", (0.0, 1.5, 3.0)), ("pulse", (0.0, 2.0, 8.0))])
def test_a_function_of_two_covariates_is_drawn_as_a_map_of_both(shape, knots):
    term = SmoothTerm(
        {"3.c0": 0.1, "3.c1": 0.8},
        covariate="time" if shape == "pulse" else "speed",
        form="anchor",
        shape=shape,
        knots=knots,
        domain={"time": (0.0, 40.0)},
        factor="height",
        factor_shape="beyond",
        factor_knots=(0.5, 1.2, 2.5),
    )
    picture = curves._product(term)
    assert picture.alt == f"Function of {term.covariate} and height in tdoa of anchor 3"
    assert picture.caption.startswith("Anchor 3 seems 0.8 m farther")
    assert picture.caption.endswith("Beyond these values it fades.")
    finding = EffectFinding(term, "tdoa", {}, 0.5)
    assert output._function(finding, term)["factor"] == {
        "covariate": "height",
        "course": "beyond",
        "knots": (0.5, 1.2, 2.5),
    }
