"""Covariances in effects.yaml."""

import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, Covariance, EffectSet
from uwb_tdoa_bias.foundation.errors import InputError

EFFECTS_HERE = (
    EFFECTS["anchor_delay"]({"0": 0.1, "3": -0.2}),
    EFFECTS["anchor_position"]({"3.x": 0.0}),
)
KEYS = ("anchor_delay", "0"), ("anchor_delay", "3"), ("anchor_position", "3.x")
MATRIX = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, -2e-4], [0.0, -2e-4, 1e-4]])


def test_a_file_holds_what_was_written(tmp_path):
    EffectSet(EFFECTS_HERE, Covariance(KEYS, MATRIX)).to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert read.covariance.keys == KEYS and read == EffectSet(EFFECTS_HERE)
    np.testing.assert_allclose(read.covariance.matrix, MATRIX)


def test_parts_of_it():
    whole = Covariance(KEYS, MATRIX)
    places, some = whole.of((("anchor_delay", "7"), KEYS[2], KEYS[0]))
    np.testing.assert_array_equal(places, [1, 2])
    np.testing.assert_array_equal(some, MATRIX[np.ix_([2, 0], [2, 0])])
    assert whole.without(("3",)).keys == KEYS[:1] and whole.without(("3",)).matrix == MATRIX[0, 0]


@pytest.mark.parametrize(
    "text, words",
    [
        ("[]", "must hold parameters and matrix"),
        ("{parameters: [anchor_delay 0], matrix: []}", "a row of the matrix for each"),
        ("{parameters: [anchor_delay 5], matrix: [[1]]}", "'anchor_delay 5' is no parameter above"),
        ("{parameters: [anchor_delay 0, anchor_delay 0], matrix: [[1], [0, 1]]}", "there twice"),
        (
            "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], [0, 0, 1]]}",
            "row 2 must be 2 numbers",
        ),
        (
            "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], []]}",
            "row 2 must be 2 numbers",
        ),
        (
            "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], [2, 1]]}",
            "positive semidefinite",
        ),
        ("{parameters: [anchor_delay 0], matrix: [[-1]]}", "positive semidefinite"),
    ],
)
def test_what_is_no_covariance_is_refused(tmp_path, text, words):
    (tmp_path / "effects.yaml").write_text(
        f"effects: {{anchor_delay: {{values: {{0: 0.1, 3: 0.1}}}}}}\ncovariance: {text}\n"
    )
    with pytest.raises(InputError, match=words):
        EffectSet.from_yaml(tmp_path / "effects.yaml")


def test_of_a_hall_it_says_what_belongs_to_each_anchor_and_a_file_holds_that(tmp_path):
    n, rng = 300, np.random.default_rng(0)
    keys = (
        *(("anchor_position", f"{i}.{axis}") for i in range(n) for axis in "xyz"),
        *(("anchor_delay", str(i)) for i in range(n)),
    )
    root = rng.standard_normal((4 * n, 40))
    whole = Covariance(keys, root @ root.T + np.eye(4 * n))
    each = whole.of_each_anchor()
    effects = tuple(
        EFFECTS[name]({key: 0.1 for of, key in keys if of == name})
        for name in ("anchor_position", "anchor_delay")
    )
    EffectSet(effects, each).to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml").covariance
    assert (
        sorted(read.keys) == sorted(keys) and (tmp_path / "effects.yaml").stat().st_size < 200_000
    )
    for anchor in (0, 17, 299):
        mine = [(*("anchor_position", f"{anchor}.{axis}"),) for axis in "xyz"] + [
            ("anchor_delay", str(anchor))
        ]
        np.testing.assert_allclose(read.of(mine)[1], whole.of(mine)[1], rtol=1e-5)
    assert read.of([("anchor_delay", "0"), ("anchor_delay", "1")])[1][0, 1] == 0.0
