import re

from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, LabelEffect
from uwb_tdoa_bias.effects.covariates import OF_ARRIVAL, OF_IMU, OF_TDOA, UNITS
from uwb_tdoa_bias.effects.wording import counted, listed, measured
from uwb_tdoa_bias.foundation.anchors import Anchors

ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 3], [0, 7, 0], [8, 7, 3]], ids=[0, 1, 3, 7])
PAIRS = np.array([[0, 1], [3, 7]])
ESTIMATED = [effect for effect in EFFECTS.values() if not issubclass(effect, LabelEffect)]
WITH_ADVICE = [effect for effect in ESTIMATED if effect.name != "noise_correlation"]


def filled(effect, value, std):
    """The effect with one value for everything that can be fitted, "x, y, z, radius" of a region
    aside.
    """
    keys = effect.groups(ANCHORS, PAIRS)[0] or (effect.example,)
    limits = {"0.x": 1.0, "0.y": -2.0, "0.z": 1.5, "0.radius": 0.6} if effect.name == "nlos" else {}
    return effect({**dict.fromkeys(keys, value), **limits}, dict.fromkeys(keys, std))


@pytest.mark.parametrize(
    "value, std, text",
    [
        (0.3123, 0.0104, "0.31 ± 0.01 m"),
        (0.0507, 0.12, "0.05 ± 0.12 m"),
        (1.26, 1.4, "1.3 ± 1.4 m"),
        (0.3123, 0.0008, "0.3123 ± 0.0008 m"),
        (-0.05, 0.096, "-0.05 ± 0.10 m"),
        (16.74, 1.1, "17 ± 1 m"),
        (1234.0, 40.0, "1234 ± 40 m"),
        (0.28333, None, "0.283 m"),
        (0.28333, 0.0, "0.283 m"),
    ],
)
def test_values_are_rounded_to_their_standard_deviation(value, std, text):
    assert measured(value, std, "m") == text


def test_a_value_without_spread_comes_last():
    late = EFFECTS["anchor_delay"]({"0": 0.3, "1": 0.2, "3": 0.4}, {"0": 0.0, "1": 0.01})
    assert list(late.significant()) == ["1", "0", "3"]


@given(st.floats(-100, 100), st.floats(1e-6, 10))
def test_what_is_printed_is_the_value_within_half_a_digit_of_its_standard_deviation(value, std):
    shown, error = (float(number) for number in measured(value, std).split(" ± "))
    assert abs(shown - value) <= 0.5 * std * (1 + 1e-6) and error == pytest.approx(
        std, rel=0.51 if std > 1.0 else 0.12
    )


def test_lists():
    assert listed(["3"]) == "3" and listed("357") == "3, 5 and 7"
    assert counted(["3"], "anchor") == "anchor 3" and counted("35", "anchor") == "anchors 3 and 5"


def test_significant_values_come_in_the_order_of_their_significance():
    effect = EFFECTS["anchor_delay"]({0: 0.1, 1: -0.3, 3: 0.02}, {0: 0.05, 1: 0.02, 3: 0.011})
    assert list(effect.significant()) == ["1", "0"]


@pytest.mark.parametrize("effect", WITH_ADVICE)
def test_advice_is_imperative_sentences_with_the_size(effect):
    sentences = filled(effect, 0.2, 0.01).advice()
    assert sentences
    for sentence in sentences:
        assert (
            re.match(r"[A-Z][a-z]+ [a-zA-Z]", sentence)
            and sentence.endswith(".")
            and "\n" not in sentence
        )
        assert "nan" not in sentence and len(sentence) < 900
    assert any("±" in sentence for sentence in sentences)


@pytest.mark.parametrize("effect", ESTIMATED)
@given(st.floats(0.0, 0.2), st.floats(1.001, 5.0))
def test_nothing_is_advised_on_what_the_data_do_not_tell(effect, value, doubt):
    assume(value > 1e-6)
    assert filled(effect, value, 0.5 * value * doubt).advice() == ()


@pytest.mark.parametrize(
    "name, values, std, said",
    [
        ("anchor_delay", {3: 0.31}, {3: 0.01}, ["anchor 3", "0.31 ± 0.01 m late"]),
        ("anchor_delay", {3: -0.31, 1: 0.01}, {3: 0.01, 1: 0.02}, ["0.31 ± 0.01 m early"]),
        (
            "anchor_position",
            {"5.x": 0.2, "5.z": -0.1},
            {"5.x": 0.01, "5.z": 0.01},
            ["+x", "-z", "Measure anchor 5 again before you move it"],
        ),
        (
            "nlos",
            {"1.delay": 0.5, "1.start": 20, "1.end": 32},
            {"1.delay": 0.02},
            ["from 20 to 32 s", "anchor 1"],
        ),
        (
            "imu_misalignment",
            {"z": -0.0698},
            {"z": 0.005},
            ["Turn the IMU by 4.0 ± 0.3 degrees about z"],
        ),
        ("tdoa_time_offset", {"offset": 0.012}, {"offset": 0.001}, ["12 ± 1 ms late"]),
        (
            "accel_bias",
            {"x": -2.181, "z": -0.04},
            {"x": 0.092, "z": 0.055},
            ["2.18 ± 0.09 m/s^2 too little along x"],
        ),
        ("anchor_ids", {"1": 4}, {}, ["Give the anchors", "called 1 is anchor 4 of the survey"]),
        ("pair_sign", {"1-4": -1}, {}, ["Look in the driver", "the sign of the TDOA of 1-4"]),
        ("gyro_scale", {"z": 0.03}, {"z": 0.001}, ["3.0 ± 0.1 % too much about z"]),
    ],
)
def test_advice_names_place_size_and_sign(name, values, std, said):
    (sentence,) = EFFECTS[name](values, std).advice()
    for part in said:
        assert part in sentence
    for key in values:  # of what is not significant nothing is said
        if key in std and abs(values[key]) < 2 * std[key]:
            assert f"anchor {key}" not in sentence and f"along {key}" not in sentence


def test_a_blocked_region_is_named_by_its_place_and_marked_on_the_map():
    values = {"1.x": -0.9, "1.y": -1.2, "1.z": 2.0, "1.radius": 1.0, "1.delay": 0.53}
    effect = EFFECTS["nlos"](values, {"1.delay": 0.04})
    (sentence,) = effect.advice()
    assert (
        "anchor 1 and (-0.9, -1.2, 2.0) m" in sentence
        and "within 1.0 m" in sentence
        and "0.53 ± 0.04 m" in sentence
    )
    (region,) = effect.marks(ANCHORS)
    assert (
        region.anchor == 1 and region.radius == 1.0 and region.centre.tolist() == [-0.9, -1.2, 2.0]
    )


def test_shifts_on_the_map_are_those_of_the_values():
    (shift,) = EFFECTS["anchor_position"]({"3.x": 0.2, "3.z": -0.1}, {"3.x": 0.03}).marks(ANCHORS)
    assert shift.anchor == 3 and shift.by.tolist() == [0.2, 0.0, -0.1]
    np.testing.assert_array_equal(shift.std, [0.03, np.nan, np.nan])
    frame = EFFECTS["truth_frame"]({"x": 0.1, "yaw": 0.05}).marks(ANCHORS)
    assert [mark.anchor for mark in frame] == [0, 1, 3, 7]
    np.testing.assert_allclose(frame[0].by, [0.1, 0.0, 0.0], atol=1e-12)
    assert np.linalg.norm(frame[3].by) > 0.4


def test_an_effect_without_a_sentence_of_its_own_is_advised_on_by_its_physics():
    class Rust(EFFECTS["anchor_delay"]):
        """An effect that somebody adds."""

        name, physics, unit = "rust", "rusty connectors", "m"
        advice = EFFECTS["noise_level"].__mro__[1].advice

    (sentence,) = Rust({3: 0.31, 1: 0.001}, {3: 0.01, 1: 0.002}).advice()
    assert (
        sentence == "Look for the cause of rust: rusty connectors (found: 3 = 0.31 ± 0.01, in m)."
    )


def test_every_covariate_has_a_unit():
    assert set(UNITS) == {*OF_TDOA, *OF_ARRIVAL, *OF_IMU}
