# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors, and the survey files that hold them."""

import json
import re

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors, refuse_faulty, survey_fault
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import read_survey

# --- anchors ---


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


def test_arrays_are_its_own_and_cannot_be_changed():
    given = np.arange(3), np.eye(3), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    anchors = Anchors(*given)
    for own, array in zip((anchors.ids, anchors.positions, anchors.orientations), given):
        before = own.copy()
        array[0] = 9
        np.testing.assert_array_equal(own, before)
        with pytest.raises(ValueError):
            own[0] = 1


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
    assert anchors.index([asked, asked]).tolist() == [expected, expected]
    assert [anchors.row(i) for i in asked] == expected


@given(unique_ids, st.randoms(use_true_random=False))
def test_yaml_gives_back_what_was_written(tmp_path_factory, ids, random):
    rng = np.random.default_rng(random.getrandbits(32))
    orientations = rng.standard_normal((len(ids), 4))
    orientations[rng.random(len(ids)) < 0.3] = np.nan
    written = Anchors(ids, rng.normal(0.0, 10.0, (len(ids), 3)), orientations, "hall")
    path = tmp_path_factory.mktemp("anchors") / "anchors.yaml"
    written.to_yaml(path)
    read = read_survey(path)
    assert read.frame == "hall"
    np.testing.assert_array_equal(read.ids, written.ids)
    np.testing.assert_array_equal(read.positions, written.positions)
    np.testing.assert_allclose(read.orientations, written.orientations, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "anchors:",
        "anchors: []",
        "anchors: {}",
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
        read_survey(path)


# --- survey forms ---
PLACES = {0: (-3.1062, -4.0031, 0.1832), 1: (-3.1907, 3.7809, 2.9519), 4: (3.7205, 3.6519, -0.1869)}
ROWS = [(number, *place) for number, place in PLACES.items()]


def joined(separator, rows=ROWS, header=None, comma=False):
    lines = [separator.join(f"{cell}" for cell in row) for row in rows]
    text = "\n".join(lines).replace(".", ",") if comma else "\n".join(lines)
    return text if header is None else f"{header}\n{text}"


def scaled(factor):
    return [
        (number, *(f"{factor * value:.6f}" for value in place)) for number, place in PLACES.items()
    ]


def mappings(form):
    return "\n".join(form.format(number, *place) for number, place in PLACES.items())


READ = {
    "comma": joined(",", header="id,x,y,z"),
    "of pandas": joined(",", header=",x,y,z"),
    "spaces": joined("   "),
    "tabs": joined("\t", header="Anchor\tX\tY\tZ"),
    "no header": joined(","),
    "no header, CRLF": joined(", ").replace("\n", "\r\n"),
    "semicolons and decimal commas": joined(";", header="id;x;y;z", comma=True),
    "tabs and decimal commas": joined("\t", comma=True),
    "blanks and decimal commas": joined(" ", comma=True),
    "commented header": joined(" ", header="# id x y z"),
    "comments": joined(",", header="# measured on Monday\nid,x,y,z"),
    "upper case with units": joined(",", header="ID,X [m],Y [m],Z [m]"),
    "units in parentheses": joined(",", header="id,x (m),y (m),z (m)"),
    "units after an underscore": joined(",", header="anchor_id,x_m,y_m,z_m"),
    "millimetres in the header": joined(",", scaled(1000.0), "id,x_mm,y_mm,z_mm"),
    "centimetres in the header": joined(",", scaled(100.0), "id,x[cm],y[cm],z[cm]"),
    "feet in the header": joined(",", scaled(1.0 / 0.3048), "id,x (ft),y (ft),z (ft)"),
    "prefixes": joined(",", header="anchor_id,pos_x,pos_y,pos_z"),
    "suffixes": joined(",", header="id,x_pos,y_pos,z_pos"),
    "fields of a message": joined(",", header="id,pose.position.x,pose.position.y,pose.position.z"),
    "another order": joined(",", [(z, name, y, x) for name, x, y, z in ROWS], "z,id,y,x"),
    "further columns": joined(",", [(*row, "up") for row in ROWS], "id,x,y,z,remark"),
    "Crazyflie client": mappings("{0}:\n  x: {1}\n  y: {2}\n  z: {3}"),
    "flow mappings": mappings("{0}: {{x: {1}, y: {2}, z: {3}}}"),
    "lists by id": mappings("{0}: [{1}, {2}, {3}]"),
    "lps-ros": "n_anchors: 3\n" + mappings("anchor{0}_pos: [{1}, {2}, {3}] # address"),
    "names with numbers": mappings("anchor_{0}: {{position: [{1}, {2}, {3}]}}"),
    "ours": "frame: hall\nanchors:\n" + mappings("  {0}: {{position: [{1}, {2}, {3}]}}"),
    "anchors as mappings of axes": "anchors:\n" + mappings("  {0}: {{x: {1}, y: {2}, z: {3}}}"),
    "anchors in a list": "anchors:\n" + mappings("  - {{id: {0}, position: [{1}, {2}, {3}]}}"),
    "position as a mapping": "anchors:\n"
    + mappings("  - id: {0}\n    position: {{x: {1}, y: {2}, z: {3}}}"),
    "axes in a list": mappings("- {{anchor_id: {0}, x: {1}, y: {2}, z: {3}}}"),
    "rows in a list": mappings("- [{0}, {1}, {2}, {3}]"),
    "parameters of ROS": "/**:\n  ros__parameters:\n    anchors:\n"
    + mappings("      '{0}': [{1}, {2}, {3}]"),
    "JSON": json.dumps({str(number): dict(zip("xyz", place)) for number, place in PLACES.items()}),
    "JSON list": json.dumps(
        [{"id": number, "position": place} for number, place in PLACES.items()], indent=2
    ),
    "JSON anchors": json.dumps(
        {
            "anchors": [
                {"name": number, "pos": dict(zip("xyz", place))} for number, place in PLACES.items()
            ]
        }
    ),
}


@pytest.mark.parametrize("form", READ)
def test_usual_forms_are_read(tmp_path, form):
    file = tmp_path / "anchors"
    file.write_text(READ[form] + "\n", newline="")
    anchors = read_survey(file)
    np.testing.assert_array_equal(anchors.ids, list(PLACES))
    np.testing.assert_allclose(anchors.positions, list(PLACES.values()), atol=1e-6)
    assert np.isnan(anchors.orientations).all()


def test_the_rows_of_an_opencv_matrix_are_numbered(tmp_path):
    data = ", ".join(str(value) for place in PLACES.values() for value in place)
    head = "%YAML:1.0\n---\nnum_anchors: 3\naps_mat: !!opencv-matrix\n"
    (tmp_path / "anchors.yaml").write_text(
        f"{head}   rows: 3\n   cols: 3\n   dt: d\n   data: [ {data} ]\n"
    )
    anchors = read_survey(tmp_path / "anchors.yaml")
    np.testing.assert_array_equal(anchors.ids, [0, 1, 2])
    np.testing.assert_allclose(anchors.positions, list(PLACES.values()))


FEET = "[-10.191, -13.134, 0.601]"  # anchor 0
STATED = {
    "of the file": f"unit: ft\nanchors:\n  0: {{position: {FEET}}}\n",
    "of the anchors": f"anchors:\n  units: Feet\n  0: {FEET}\n",
    "of JSON": f'{{"units": "ft", "anchors": [{{"id": 0, "pos": {FEET}}}]}}',
    "of parameters": f"/**:\n  ros__parameters:\n    length_unit: foot\n    anchor0_pos: {FEET}\n",
    "of one anchor": "unit: m\n0: {unit: cm, x: -310.62, y: -400.31, z: 18.32}\n",
    "of a position": "0: {position: {x: -310.62, y: -400.31, z: 18.32, unit: centimetre}}\n",
    "of an axis": "unit: mm\n0: {x_cm: -310.62, y_cm: -400.31, z: 183.2}\n",
    "of a matrix": f"units: ft\nm: {{rows: 1, cols: 3, data: {FEET}}}\n",
    "of a row": "id,x,y,z,unit\n0,-122.291,-157.602,7.213,in\n",
    "of a comment": "# Units: [ft]\n" + "id,x,y,z\n0,-10.191,-13.134,0.601\n",
    "of a total station": "# unit = inches\n" + "anchorAnt0,-122.291,-157.602,7.213\n",
}


@pytest.mark.parametrize("form", STATED)
def test_a_stated_unit_is_converted_or_refused_by_its_name(tmp_path, form):
    file = tmp_path / "anchors"
    file.write_text(STATED[form])
    np.testing.assert_allclose(read_survey(file).positions, [PLACES[0]], atol=2e-4)
    unit = re.compile(r"(?<=[:=,\[\" ])(ft|Feet|foot|cm|centimetre|in|inches)(?=[\]\",}\n])")
    file.write_text(unit.sub("furlong", STATED[form], count=1))
    if form != "of an axis":
        with pytest.raises(InputError, match="unit 'furlong' is not known"):
            read_survey(file)


def test_orientations_are_read_where_they_stand(tmp_path):
    turn = np.array([0.0, 0.0, 0.6, 0.8])
    tables = (
        "id,x,y,z,qx,qy,qz,qw\n3,1,2,3,0,0,0.6,0.8\n",
        "- {id: 3, x: 1, y: 2, z: 3, orientation: {x: 0, y: 0, z: 0.6, w: 0.8}}\n",
    )
    for text in (*tables, "anchors: {3: {position: [1, 2, 3], orientation: [0, 0, 0.6, 0.8]}}\n"):
        (tmp_path / "anchors").write_text(text)
        anchors = read_survey(tmp_path / "anchors")
        np.testing.assert_allclose(anchors.orientations, [turn])
        np.testing.assert_array_equal(anchors.positions, [[1.0, 2.0, 3.0]])


REFUSED = {
    "no ids in a table": (
        "x,y,z\n1,2,3\n",
        "line 1: columns x, y and z are recognized, and no column with the ids",
    ),
    "no ids and no header": (
        "1 2 3\n4 5 6\n",
        "line 1: three numbers are recognized as a position, and no id",
    ),
    "too many numbers": ("0,1,2,3,9\n", "line 1: 5 numbers and no header"),
    "no ids in a list": (
        "- [1, 2, 3]\n- [4, 5, 6]\n",
        r"anchors\[0\]: a position is recognized, and no id; write",
    ),
    "no axes": ("0: {lat: 48.1, lon: 11.5}\n", "0: no position is recognized among lat, lon"),
    "two axes": ("0: {x: 1, y: 2}\n", "0: no position is recognized among x, y"),
    "decimal commas in a list": (
        "anchors:\n  0: {position: [-3,1062, -4,0031, 0,1832]}\n",
        "0: position: 6 numbers .* decimal commas",
    ),
    "decimal commas among commas": (
        "id,x,y,z\n0,-3,1062,-4,0031,0,1832\n",
        "line 2: .* 7 cells, the header 4; decimal commas need ';'",
    ),
    "a matrix of columns": (
        "m: !!opencv-matrix\n  rows: 3\n  cols: 2\n  data: [1, 2, 3, 4, 5, 6]\n",
        "m: a matrix of 3 x 2 is recognized",
    ),
    "not a number": ("id x y z\n0 1 two 3\n", r"line 2: \['1', 'two', '3'\] is not 3 numbers"),
    "nothing": ("scale: 3\n", "scale: 3 is no position"),
    "a name": ("id,x,y,z\nNE,1,2,3\n", "id is 'NE'"),
    "twice": ("- [0, 1, 2, 3]\n- [0, 4, 5, 6]\n", "id 0 is given twice"),
    "an orientation of three": (
        "0: {position: [1, 2, 3], orientation: [0, 0, 1]}\n",
        "0: orientation is .* not 4 numbers",
    ),
}


@pytest.mark.parametrize("form", REFUSED)
def test_what_is_not_certain_is_refused_with_place_and_remedy(tmp_path, form):
    text, sentence = REFUSED[form]
    (tmp_path / "anchors").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_survey(tmp_path / "anchors")


def test_cases_of_others(shared_data):
    """Read small files on which the reader failed once."""
    folder = shared_data.parent / "cases" / "anchors"
    for name in (
        "cfclient.yaml",
        "lps_ros.yaml",
        "list_pos.yaml",
        "opencv.yaml",
        "starloc.csv",
        "upper.csv",
        "spaces.txt",
    ):
        anchors = read_survey(folder / name)
        np.testing.assert_allclose(
            anchors.positions[[0, 7]], [[-3.1062, -4.0031, 0.1832], [-3.1298, 3.3829, 0.1824]]
        )
        np.testing.assert_array_equal(anchors.ids, np.arange(8))
    with pytest.raises(InputError, match="decimal"):
        read_survey(folder / "decimalcomma.yaml")


@given(st.text(alphabet="0123456789,;:.-{}[]() \t\nxyzidanchors#\"'mft", max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    file = tmp_path_factory.getbasetemp() / "any"
    file.write_text(text)
    try:
        assert np.isfinite(read_survey(file).positions).all()
    except InputError as error:
        assert str(error).startswith(str(file))


# --- survey faults ---
ROOM = np.array(
    [[x, y, z] for x, y in ((-3.1, -4.0), (-3.2, 3.8), (3.7, 3.7), (4.0, -4.4)) for z in (0.2, 3.0)]
)


def sentence(positions):
    return survey_fault(Anchors.from_positions(positions, ids=np.arange(len(positions)) + 10))


def test_a_line_of_anchors_along_a_parallel_is_in_degrees():
    along = np.arange(6)
    degrees = np.column_stack([np.full(6, 48.1), 11.5 + 2e-5 * along, 0.5 + along % 2])
    assert "latitude and longitude" in sentence(degrees)
    assert not sentence(np.column_stack([np.full(6, 48.1), 11.5 + 2.0 * along, 0.5 + along % 2]))


def changed(rows, function):
    """Return the positions of ROOM, with a function applied to some rows."""
    positions = ROOM.copy()
    positions[rows] = function(positions[rows])
    return positions


IN_MILLIMETRES = {
    f"the position of anchor {row + 10} looks like millimetres": changed(row, lambda p: 1e3 * p)
    for row in range(8)
}
FAULTS = {
    **IN_MILLIMETRES,
    "the survey looks like millimetres .*divide it by 1000": 1000.0 * ROOM,
    "the survey looks like centimetres .*divide it by 100": 100.0 * ROOM * [-1.0, 1.0, 1.0],
    "the positions of anchors 13 and 15 look like millimetres": changed([3, 5], lambda p: 1e3 * p),
    "anchor 12 cannot be in metres": changed(2, lambda p: p + [5e6, 0.0, 0.0]),
    "all anchors are at one place .*at .0, 0, 0.": np.zeros_like(ROOM),
    "all anchors are at one place .*at .4, 5, 6.": np.tile([4.0, 5.0, 6.0], (8, 1)),
    "anchors 12 and 13 are at one place": changed([2, 3], lambda p: p[0]),
}


@pytest.mark.parametrize("said", FAULTS)
def test_a_fault_is_named(said):
    assert re.search(said, sentence(FAULTS[said]))


def test_it_is_refused_with_its_source():
    with pytest.raises(InputError, match="^room.csv: the survey looks like millimetres"):
        refuse_faulty(Anchors.from_positions(1000.0 * ROOM), "room.csv")


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**31),
    st.integers(1, 40),
    st.floats(0.5, 300.0),
    st.floats(0.5, 200.0),
    st.floats(0.0, 20.0),
    st.sampled_from([0.0, 1e3, 5e6]),
)
def test_rooms_and_halls_are_usable(seed, count, length, width, height, origin):
    """Test layouts from a table to a hall of 300 x 200 m, in any frame."""
    positions = (
        np.random.default_rng(seed).uniform(0.0, 1.0, (count, 3)) * [length, width, height] + origin
    )
    assert not sentence(positions)


def test_a_large_network_takes_little_work():
    """Test ten thousand anchors on a grid of 30 m, over three kilometres."""
    x, y = np.meshgrid(np.arange(100) * 30.0, np.arange(100) * 30.0)
    positions = np.column_stack([x.ravel(), y.ravel(), np.full(10_000, 5.0)])
    assert not sentence(positions)
