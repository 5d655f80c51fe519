# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from recordings import ANCHORS, SURVEY
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import UNITS
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import ARM_TIPS, orientation_from_tips, read_survey

SOME = Rotation.from_euler("zyx", [0.7, -0.2, 3.0])  # nearly upside down
CENTRE = np.array([3.0, -2.0, 1.5])


def survey_lines(rotation=SOME, centre=CENTRE, number=4, noise=0.0):
    tips = rotation.apply(ARM_TIPS) + centre + noise * np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    antenna = rotation.apply([0.011, -0.026, 0.049]) + centre
    lines = [f"anchorAnt{number},{antenna[0]:.4f},{antenna[1]:.4f}, {antenna[2]:.4f}  "]
    lines += [
        f"anchor{number}_{k},{x:.4f},{y:.4f},{z:.4f}" for k, (x, y, z) in enumerate(tips, start=1)
    ]
    return lines, antenna


@pytest.fixture
def read(tmp_path):
    def read(text):
        file = tmp_path / "survey"
        file.write_text(text if isinstance(text, str) else "\n".join(text) + "\n")
        return read_survey(file)

    return read


def test_total_station(read):
    lines, antenna = survey_lines()
    anchors = read(["TPS0001,0,0,-0", *lines, "", "anchorAnt9,1,2,3", "landmark1,4.9,1.0,1.8"])
    np.testing.assert_array_equal(anchors.ids, [4, 9])
    np.testing.assert_allclose(anchors.positions, [antenna, [1, 2, 3]], atol=1e-4)
    angle = (Rotation.from_quat(anchors.orientations[0]) * SOME.inv()).magnitude()
    assert angle < 0.002  # coordinates are rounded to 0.1 mm
    assert np.isnan(anchors.orientations[1]).all()
    assert anchors.frame == "map"


def test_orientation_is_exact_and_says_what_remains():
    q, residual = orientation_from_tips(SOME.apply(ARM_TIPS) + CENTRE)
    assert (Rotation.from_quat(q) * SOME.inv()).magnitude() < 1e-9 and residual < 1e-12
    q, residual = orientation_from_tips(SOME.apply(1.01 * ARM_TIPS) + CENTRE)
    assert 1e-4 < residual < 2e-3


def test_arms_up_left_forward_are_what_the_surveyor_saw():
    """In front of an upright stand that faces the viewer, arm 2 is on the left.

    REP 103: this is -y.
    """
    up, left_of_viewer, forward = ARM_TIPS
    assert up[2] == 0.110 and forward[0] == 0.080
    np.testing.assert_allclose(np.linalg.norm(left_of_viewer), 0.121)
    viewer = -forward / np.linalg.norm(forward)  # direction of view
    assert np.cross(up, viewer) @ left_of_viewer > 0


def test_positions_only(read):
    anchors = read(SURVEY)
    np.testing.assert_array_equal(anchors.ids, ANCHORS.ids)
    np.testing.assert_array_equal(anchors.positions, ANCHORS.positions)
    assert np.isnan(anchors.orientations).all()


def test_axes_of_the_world_by_their_directions(read):
    """East, north and up are x, y and z, in any order (REP 103)."""
    rows = [
        f"{k};{y};{x};{z}".replace(".", ",") for k, (x, y, z) in zip(ANCHORS.ids, ANCHORS.positions)
    ]
    anchors = read("\n".join(["Anchor;North;East [m];Up", *rows]))
    np.testing.assert_array_equal(anchors.positions, ANCHORS.positions)


def test_yaml(tmp_path):
    ANCHORS.to_yaml(tmp_path / "anchors.dat")
    anchors = read_survey(tmp_path / "anchors.dat")
    np.testing.assert_array_equal(anchors.positions, ANCHORS.positions)
    np.testing.assert_allclose(anchors.orientations, ANCHORS.orientations)


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "empty"),
        ("hello\n", "line 1: 'hello' is not 'name,x,y,z'"),
        ("landmark,1,2,3\n", "no survey that can be read"),
        ("id,x,y,z\n", "holds no anchor"),
        ("id,x,y,z\n0,1,2\n", "line 2: '0,1,2' has 3 cells, the header 4"),
        ("id,x,y,z\none,1,2,3\n", "id is 'one'"),
        ("id,x,y,z\n0,1,2,3\n0,1,2,3\n", "id 0 is given twice"),
        ("anchorAnt0,1,2,nan\n", "line 1: 'anchorAnt0,1,2,nan' is not"),
        ("anchorAnt0,1,2,3\nanchorAnt0,1,2,3\n", "line 2: anchorAnt0 is there twice"),
        ("anchorAnt0,1,2,3\nanchor1_1,1,2,3\n", "anchor 1 has arm tips but no line"),
        ("anchorAnt0,1,2,3\nanchor0_1,1,2,3\n", "1 of 3 arm tips"),
        ("\n".join(survey_lines(noise=0.03)[0]), "miss the stand's shape by"),
        ("anchors: {}\n", "no anchor is recognized; write"),
    ],
)
def test_refused_with_the_line(read, text, sentence):
    with pytest.raises(InputError, match=sentence):
        read(text)


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_a_total_station_is_named(read, unit):
    lines = []
    for line in survey_lines()[0]:
        name, *point = line.split(",")
        lines.append(",".join([name, *(f"{UNITS[unit] * float(x):.6f}" for x in point)]))
    with pytest.raises(InputError) as refused:
        read("\n".join(lines))
    assert f"the survey looks like {unit} (the arms" in str(refused.value)
    assert f"give metres: divide all coordinates by {UNITS[unit]:.6g}." in str(refused.value)


def test_arm_tips_alone_in_another_unit_are_named(read):
    lines = []
    for line in survey_lines()[0]:
        name, *point = line.split(",")
        factor = 1.0 if "Ant" in name else 1000.0
        lines.append(",".join([name, *(f"{factor * float(x):.6f}" for x in point)]))
    with pytest.raises(
        InputError, match="the arm tips of anchor 4 look like millimetres .*: divide "
    ):
        read("\n".join(lines))


def test_missing_and_binary(tmp_path):
    with pytest.raises(InputError, match="cannot be read .*; give the path of a survey file"):
        read_survey(tmp_path / "nowhere.txt")
    (tmp_path / "binary").write_bytes(b"\xbc\xff\xfe")
    with pytest.raises(InputError, match="is not text"):
        read_survey(tmp_path / "binary")


def test_measured_stands_are_one_shape(shared_data):
    """The antenna is at the same place of all stands, and stands on the floor are upright.

    So the frame is correct.
    """
    for file in sorted((shared_data / "surveys").glob("*.txt")):
        anchors = read_survey(file)
        rotation = Rotation.from_quat(anchors.orientations)
        up = rotation.apply([0.0, 0.0, 1.0])[:, 2]
        floor = anchors.positions[:, 2] < 1.0
        assert floor.sum() == 4
        assert (up[floor] > np.cos(np.radians(3))).all(), file
        assert (up[~floor] < -0.8).all(), file  # the upper ones hang upside down
        to_room = np.einsum(
            "ij,ij->i", rotation.apply([1.0, 0.0, 0.0])[:, :2], -anchors.positions[:, :2]
        )
        assert (to_room > 0).all(), file  # all face the room
        points = {
            line.split(",")[0]: line.split(",")[1:]
            for line in file.read_text().replace(" ", "").splitlines()
        }
        for number, position, turn in zip(anchors.ids, anchors.positions, rotation):
            tips = np.array([points[f"anchor{number}_{k}"] for k in (1, 2, 3)], dtype=float)
            centre = tips.mean(axis=0) - turn.apply(ARM_TIPS.mean(axis=0))
            in_stand = turn.inv().apply(position - centre)
            np.testing.assert_allclose(
                in_stand, [0.011, -0.026, 0.049], atol=0.009, err_msg=str(file)
            )
