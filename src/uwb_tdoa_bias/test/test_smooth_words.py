import pytest

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.covariates import OF_AIDS, OF_ARRIVAL, OF_IMU, OF_TDOA
from uwb_tdoa_bias.effects.smooth_words import causes, described


def term(values, covariate, form, knots, shape, channel="tdoa"):
    return SmoothTerm(
        values,
        {key: 0.02 for key in values if key.endswith("c1")},
        "",
        channel,
        covariate,
        form,
        knots,
        shape,
    )


@pytest.mark.parametrize(
    "found, part, words",
    [
        (
            term({"2.c0": 0.0, "2.c1": 0.64}, "range", "anchor", (1.0, 5.0, 8.0), "step"),
            "2",
            "anchor 2 seems 0.64 ± 0.02 m farther where range is above 5 m (seen from 1 m to 8 m)",
        ),
        (
            term(
                {"0-1.c0": 0.0, "0-1.c1": -0.3}, "time", "pair", (0.0, 10.0, 20.0, 30.0), "interval"
            ),
            "0-1",
            "the TDOA of 0-1 is 0.30 ± 0.02 m smaller from 10 s to 20 s (seen from 0 s to 30 s)",
        ),
        (
            term({"c0": 0.0, "c1": 0.4}, "height", "common", (1.0, 3.0), "line"),
            "",
            "every TDOA is 0.20 ± 0.01 m larger for each m more of height (seen from 1 m to 3 m)",
        ),
        (
            term({"c0": 0.0, "c1": 0.4}, "accel_z", "common", (8.0, 10.0, 12.0), "below", "gyro.y"),
            "",
            "the gyroscope reads 0.20 ± 0.01 rad/s too little about y for each m/s^2 more of "
            "accel z, below 10 m/s^2 "
            "(seen from 8 m/s^2 to 12 m/s^2)",
        ),
    ],
)
def test_a_function_in_words(found, part, words):
    assert described(found, part) == words


@pytest.mark.parametrize("form", ["common", "arrival", "anchor", "pair", "direction"])
def test_every_function_has_causes_and_a_trial_that_tells(form):
    for covariate in OF_ARRIVAL if form == "arrival" else OF_TDOA:
        assert all(causes(SmoothTerm(covariate=covariate, form=form, knots=(0.0, 1.0))))


@pytest.mark.parametrize("channel", ["gyro.x", "accel.z"])
def test_every_function_of_a_sensor_has_causes(channel):
    for covariate in (*OF_IMU, *OF_AIDS):
        assert all(causes(SmoothTerm(channel=channel, covariate=covariate, knots=(0.0, 1.0))))


def test_what_all_anchors_share_over_the_room_is_no_advice():
    values = {f"{anchor}.c0": 0.1 for anchor in range(8)}
    assert SmoothTerm(values, {}, "", "tdoa", "x", "anchor", (0.0, 1.0)).advice() == ()
