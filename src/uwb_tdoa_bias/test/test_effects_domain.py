"""What is taken out of TDOAs and of inertial samples where effects were seen, and beyond."""

import numpy as np
import pytest

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, ImuCorrector
from uwb_tdoa_bias.effects.anchor_clock_drift import AnchorClockDrift
from uwb_tdoa_bias.effects.anchor_delay import AnchorDelay
from uwb_tdoa_bias.effects.range_bias import RangeBias
from uwb_tdoa_bias.effects.smooth_term import SmoothTerm
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

ANCHORS = Anchors.from_positions(
    [[0.0, 0.0, 0.0], [6.0, 0.0, 1.0], [0.0, 6.0, 2.0], [6.0, 6.0, 3.0]]
)


def corrected(effect, t, p=(3.0, 3.0, 1.5), first=0.0):
    """(Correction, Corrector) of TDOAs of anchors 0 and 1 at t (n,) s, the first one at `first`,
    with the tag at p.
    """
    corrector, t = (
        Corrector(ANCHORS, EffectSet((effect,))),
        np.concatenate([[first], np.atleast_1d(t)]),
    )
    corrector.add_pose(first - 1.0, np.array(p), np.array([0.0, 0.0, 0.0, 1.0]))
    zeros = np.zeros(len(t), dtype=int)
    out = corrector.correct(t, zeros, zeros + 1, np.zeros(len(t)))
    return type(out)(*(column[1:] for column in vars(out).values())), corrector


def test_a_drift_is_taken_out_while_it_was_seen_and_not_for_an_hour():
    drift = AnchorClockDrift({"1": 0.01}, domain={"time": (0.0, 60.0)})
    out, corrector = corrected(drift, [30.0, 60.0, 90.0, 600.0, 3600.0])
    assert out.bias[:2] == pytest.approx([0.3, 0.6]) and 0.2 < out.bias[2] < 0.5
    assert abs(out.bias[3:]).max() < 1e-6
    assert (out.std[:2] == 0.0).all() and out.std[3:] == pytest.approx(
        [0.6, 0.6], abs=1e-6
    )  # what it may still be
    assert corrector.outside == ["anchor_clock_drift (time 0 to 60 s)"]
    assert corrected(drift, 30.0)[1].outside == []


def test_a_function_fades_beyond_where_it_was_seen_and_its_slope_with_it():
    height = SmoothTerm(
        {"1.c0": 0.4, "1.c1": 0.4, "1.c2": 0.4},
        covariate="height",
        form="anchor",
        knots=(1.0, 2.0),
        domain={"height": (1.0, 2.0)},
    )
    at = {z: corrected(height, 1.0, (3.0, 3.0, z))[0] for z in (0.0, 1.5, 2.0, 2.5, 5.0)}
    assert at[1.5].bias == pytest.approx(0.4) and at[1.5].std == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < at[2.5].bias[0] < 0.4 and at[2.5].slope[0, 2] < 0.0
    assert at[5.0].bias == pytest.approx(0.0, abs=1e-6) and at[5.0].std == pytest.approx(
        0.4, abs=1e-3
    )
    assert at[0.0].bias[0] < 0.1


def test_what_depends_on_the_way_of_a_signal_fades_with_the_longer_of_both():
    near = RangeBias({"quadratic": 0.01}, domain={"range": (2.0, 5.0)})
    assert corrected(near, 1.0, (3.0, 0.0, 1.0))[0].std == pytest.approx(0.0, abs=1e-9)
    far, corrector = corrected(near, 1.0, (3.0, 30.0, 1.0))
    assert far.bias == pytest.approx(0.0, abs=1e-6) and len(corrector.outside) == 1


def test_without_a_domain_everything_is_as_it_was():
    assert corrected(AnchorClockDrift({"1": 0.01}), 600.0)[0].bias == pytest.approx([6.0])
    assert corrected(AnchorDelay({"1": 0.3}), 600.0)[0].bias == pytest.approx([0.3])


def test_inertial_samples_are_corrected_where_it_was_seen():
    knots = (0.0, 10.0)
    warming = SmoothTerm(
        {"c0": 0.1, "c1": 0.1, "c2": 0.1},
        channel="gyro.z",
        covariate="time",
        knots=knots,
        domain={"time": knots},
    )
    corrector, t = ImuCorrector((warming,)), np.arange(0.0, 100.0, 0.1)
    gyro, _ = corrector.correct(t, np.zeros((1000, 3)), np.zeros((1000, 3)))
    assert gyro[t <= 10.0, 2] == pytest.approx(-0.1) and abs(gyro[t > 40.0]).max() < 1e-6
    assert corrector.outside == ["gyro.z over time (time 0 to 10 s)"]


def test_what_the_filter_takes_out_by_itself_fades_too():
    knots = (1.0, 2.0)
    term = SmoothTerm(
        {"c0": 0.1, "c1": 0.1, "c2": 0.1},
        channel="gyro.z",
        covariate="height",
        knots=knots,
        domain={"height": knots},
    )
    (function,) = term.sensor_functions()
    at = np.linspace(function.low, function.high, len(function.values))
    assert function.values[(at > 1.0) & (at < 2.0)] == pytest.approx(0.1)
    assert abs(function.values[[0, -1]]).max() < 1e-4


def test_a_domain_is_written_and_read_and_files_without_one_too(tmp_path):
    drift = AnchorClockDrift({"1": 0.01}, domain={"time": (0.0, 60.0)})
    EffectSet((drift, AnchorDelay({"1": 0.3}))).to_yaml(tmp_path / "effects.yaml")
    one, other = EffectSet.from_yaml(tmp_path / "effects.yaml").effects
    assert one.domain == {"time": (0.0, 60.0)} and other.domain == {}
    assert "domain" not in (tmp_path / "effects.yaml").read_text().partition("anchor_delay")[2]


@pytest.mark.parametrize(
    "domain",
    [
        {"time": [60.0, 0.0]},
        {"time": 60.0},
        {"weather": [0.0, 1.0]},
        {"time": ["a", 2]},
        {"time": [0.0, float("inf")]},
    ],
)
def test_a_domain_that_is_none_is_refused(domain):
    with pytest.raises(InputError, match="domain"):
        AnchorClockDrift({"1": 0.01}, domain=domain)
