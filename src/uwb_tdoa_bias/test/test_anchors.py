from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError

UNKNOWN = [np.nan] * 4
unique_ids = st.lists(st.integers(0, 65535), min_size=1, max_size=70, unique=True)


def test_keeps_what_it_is_given_and_normalises_orientations():
    anchors = Anchors([7, 3], [[0, 1, 2], [3, 4, 5]], [[0, 0, 0, 2], UNKNOWN])
    assert len(anchors) == 2
    assert anchors.ids.tolist() == [7, 3]
    assert anchors.positions.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert anchors.orientations[0].tolist() == [0, 0, 0, 1]
    assert np.isnan(anchors.orientations[1]).all()
    assert anchors.frame == "map"


def test_arrays_cannot_be_changed():
    anchors = Anchors.from_positions(np.eye(3))
    for array in (anchors.ids, anchors.positions, anchors.orientations):
        with pytest.raises(ValueError):
            array[0] = 1


@pytest.mark.parametrize(
    "ids, positions, orientations, said",
    [
        ([], np.empty((0, 3)), np.empty((0, 4)), "empty"),
        ([1, 1], np.zeros((2, 3)), [UNKNOWN] * 2, "id 1 is given twice"),
        ([-1], np.zeros((1, 3)), [UNKNOWN], "id -1"),
        ([65536], np.zeros((1, 3)), [UNKNOWN], "id 65536"),
        ([4], [[0, np.inf, 0]], [UNKNOWN], "position of anchor 4"),
        ([4], [[0, 0, np.nan]], [UNKNOWN], "position of anchor 4"),
        ([4, 5], np.zeros((1, 3)), [UNKNOWN] * 2, "shape"),
        ([4], np.zeros((1, 3)), np.zeros((1, 3)), "shape"),
    ],
)
def test_refuses(ids, positions, orientations, said):
    with pytest.raises(InputError, match=said):
        Anchors(ids, positions, orientations)


@given(unique_ids, st.lists(st.integers(-5, 70000), max_size=20))
def test_index_finds_every_known_id_and_no_other(ids, asked):
    anchors = Anchors.from_positions(np.zeros((len(ids), 3)), ids)
    asked = asked + ids[:3]
    expected = [ids.index(i) if i in ids else -1 for i in asked]
    assert anchors.index(asked).tolist() == expected
    assert [anchors.row(i) for i in asked] == expected


def test_index_keeps_the_shape():
    anchors = Anchors.from_positions(np.zeros((3, 3)), [5, 9, 1])
    assert anchors.index(9) == 1
    assert anchors.index([[5, 1], [2, 9]]).tolist() == [[0, 2], [-1, 1]]


@given(unique_ids, st.randoms(use_true_random=False))
def test_yaml_gives_back_what_was_written(tmp_path_factory, ids, random):
    rng = np.random.default_rng(random.getrandbits(32))
    orientations = rng.standard_normal((len(ids), 4))
    orientations[rng.random(len(ids)) < 0.3] = np.nan
    written = Anchors(ids, rng.normal(0.0, 10.0, (len(ids), 3)), orientations, "hall")
    path = tmp_path_factory.mktemp("anchors") / "anchors.yaml"
    written.to_yaml(path)
    read = Anchors.from_yaml(path)
    assert read.frame == "hall"
    np.testing.assert_array_equal(read.ids, written.ids)
    np.testing.assert_array_equal(read.positions, written.positions)
    np.testing.assert_allclose(read.orientations, written.orientations, rtol=0, atol=1e-15)


def test_yaml_as_people_write_it(tmp_path):
    path = tmp_path / "anchors.yaml"
    path.write_text(
        "anchors:\n  2: {position: [1, 2.5, 3]}\n  '4': {position: [0, 0, 0], orientation: "
        "[0, 0, 1, 1]}\n"
    )
    anchors = Anchors.from_yaml(path)
    assert anchors.ids.tolist() == [2, 4]
    assert anchors.positions[0].tolist() == [1, 2.5, 3]
    assert np.isnan(anchors.orientations[0]).all()
    np.testing.assert_allclose(anchors.orientations[1], [0, 0, 0.5**0.5, 0.5**0.5])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "anchors:",
        "anchors: []",
        "anchors: {}",
        "anchors: {0: [1, 2, 3]}",
        "anchors: {0: {position: [1, 2]}}",
        "anchors: {0: {position: [1, 2, x]}}",
        "anchors: {0: {orientation: [0, 0, 0, 1]}}",
        "anchors: {0: {position: [1, 2, 3], orientation: [0, 0, 1]}}",
        "anchors: {north: {position: [1, 2, 3]}}",
        "anchors: {0: {position: [1, 2, .nan]}}",
        "anchors: {0: {position: [1, 2, 3]",
        "anchors: {0: {position: [1, 2, 3]}, 0: {position: [1, 2, 4]}}",
        "anchors: {0: {position: [1, 2, 3]}, '0': {position: [1, 2, 4]}}",
        "anchors: {1.7: {position: [1, 2, 3]}}",
        "anchors: {true: {position: [1, 2, 3]}}",
        "anchors: {-1: {position: [1, 2, 3]}}",
        "anchors: {65536: {position: [1, 2, 3]}}",
        "anchors: {12345678901234567890: {position: [1, 2, 3]}}",
        "anchors: {'12345678901234567890': {position: [1, 2, 3]}}",
        "anchors: {0: {position: [1, 2, true]}}",
        "anchors: {0: {position: 123}}",
        "anchors: {0: {postion: [1, 2, 3]}}",
        "anchors: {0: {position: [1, 2, 3], orientation: [0, 0, 1, .inf]}}",
        "anchors: {0: {position: [1, 2, 3], orientation: [0, 0, 1, 1e300]}}",
        "anchors: {0: {position: [1, 2, 3]}}\nframe: 3",
        "- 1",
    ],
)
def test_bad_yaml_is_told_in_one_sentence(tmp_path, text):
    path = tmp_path / "anchors.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"^\S*anchors.yaml: [^\n]*[.]$"):
        Anchors.from_yaml(path)


def test_leaves_the_arrays_of_the_caller_alone():
    ids, positions, orientations = np.arange(3), np.eye(3), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    anchors = Anchors(ids, positions, orientations)
    # the caller's own, to do with as it likes
    positions[0, 0], ids[0], orientations[0, 3] = (9.0, 9, 0.0)
    assert (
        anchors.positions[0, 0] == 1.0 and anchors.ids[0] == 0 and anchors.orientations[0, 3] == 1.0
    )
