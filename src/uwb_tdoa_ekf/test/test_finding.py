"""Which findings make the position wrong is a property of a Finding; the text of one that goes on
stays.
"""

from dataclasses import replace

import pytest

from uwb_tdoa_ekf.streams import ERROR, NOTE, WARNING, Finding, Steady


def finding(rule, severity=ERROR, value=1.0):
    return Finding(rule, severity, "cause", "evidence", "remedy", value)


@pytest.mark.parametrize(
    "rule",
    [
        "tdoa_sign",
        "tdoa_large",
        "tdoa_unit",
        "two_tags",
        "ids_exchanged",
        "survey_misfit",
        "survey_unit",
    ],
)
def test_what_the_position_is_computed_from_makes_it_wrong(rule):
    assert finding(rule).position_wrong(True) and finding(rule).position_wrong(False)
    assert not finding(rule, WARNING).position_wrong() and not finding(rule, NOTE).position_wrong()


def test_an_imu_that_is_left_out_does_not():
    assert finding("imu_turned").position_wrong(True) and not finding("imu_turned").position_wrong(
        False
    )
    assert not finding("imu_left_out").position_wrong(True)


@pytest.mark.parametrize(
    ("share", "wrong"), [(0.05, False), (0.49, False), (0.51, True), (1.0, True)]
)
def test_unknown_ids_do_where_they_are_most(share, wrong):
    assert finding("ids_unknown", value=share).position_wrong() == wrong


def test_what_is_dropped_or_slow_does_not():
    assert not any(
        finding(rule).position_wrong()
        for rule in ("tdoa_twice", "gap", "rate", "blocks", "few_anchors", "tdoa_of_one")
    )


def test_the_text_of_what_goes_on_stays_until_it_is_over_or_much_else():
    steady = Steady()
    first, next_one = (
        finding("imu_turned", value=2.0),
        replace(finding("imu_turned", value=2.1), evidence="a little else"),
    )
    assert steady([first]) == [first] and steady([next_one]) == [first]
    worse = replace(next_one, value=4.0)
    assert (
        steady([worse]) == [worse]
        and steady([replace(worse, severity=WARNING)])[0].severity == WARNING
    )
    assert steady([]) == [] and steady([next_one]) == [next_one]
    nothing = finding("dead", value=float("nan"))
    assert steady([nothing]) == [nothing] and steady([replace(nothing, evidence="else")]) == [
        nothing
    ]
