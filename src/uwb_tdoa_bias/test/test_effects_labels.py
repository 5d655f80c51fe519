"""Effects on ids and signs of TDOAs."""

import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, LabelCorrector
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight, Tdoas

A, B, D = np.array([1, 2, 4, 7]), np.array([2, 4, 7, 1]), np.array([0.5, -1.0, 2.0, -0.25])
IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"4-2": -1})


def test_ids_are_exchanged_at_once_and_signs_after_them():
    a, b, d = LabelCorrector([IDS, SIGN, EFFECTS["anchor_delay"]({"1": 0.3})]).correct(A, B, D)
    assert (
        a.tolist() == [4, 2, 1, 7]
        and b.tolist() == [2, 1, 7, 4]
        and d.tolist() == [-0.5, -1.0, 2.0, -0.25]
    )
    assert A.tolist() == [1, 2, 4, 7] and D[0] == 0.5  # what was given stays as it was


def test_what_is_put_in_is_taken_out_whatever_the_cycle():
    around = EFFECTS["anchor_ids"]({"1": 2, "2": 4, "4": 1})
    flight = Flight("f", Anchors.from_positions(np.eye(3)), Tdoas(np.arange(4.0), A, B, D))
    for effects in (
        (around,),
        (EFFECTS["pair_sign"]({"1-2": -1.0}),),
        (around, EFFECTS["pair_sign"]({"1-7": -1.0})),
    ):
        changed = flight
        for effect in reversed(effects):
            changed = effect.inject(changed)
        assert not np.array_equal(changed.tdoa.a, A) or not np.array_equal(changed.tdoa.d, D)
        back = EffectSet(effects).correct_streams(changed).tdoa
        assert (back.a.tolist(), back.b.tolist(), back.d.tolist()) == (
            A.tolist(),
            B.tolist(),
            D.tolist(),
        )


def test_others_are_passed_over():
    assert (
        LabelCorrector([EFFECTS["anchor_delay"]({"1": 0.3})]).idle
        and not LabelCorrector([SIGN]).idle
    )


@pytest.mark.parametrize(
    "name, values",
    [("anchor_ids", {"1": 2.5}), ("anchor_ids", {"1": -2}), ("pair_sign", {"0-1": 0.5})],
)
def test_only_whole_numbers(name, values):
    with pytest.raises(InputError, match=f"{name}: values"):
        EFFECTS[name](values)


def test_a_file_holds_them(tmp_path):
    EffectSet((IDS, SIGN)).to_yaml(tmp_path / "effects.yaml")
    assert EffectSet.from_yaml(tmp_path / "effects.yaml") == EffectSet((IDS, SIGN))
