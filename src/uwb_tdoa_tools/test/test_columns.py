# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV files of other tools: any column names, common units, one file or several."""

import numpy as np
import pytest
from recordings import ANCHORS, SURVEY

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import NamedAnchors, read_named_anchors, read_survey
from uwb_tdoa_tools.commands.convert import main
from uwb_tdoa_tools.readers import read_by_profile, read_flight
from uwb_tdoa_tools.readers.profile import TIME, UNITS, Profile, Source, parse_columns

NAMED = NamedAnchors(ANCHORS)
TDOA = "time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff:mm"
IMU = ",".join(
    f"{s}_{axis}={s[0]}{axis}{unit}"
    for s, unit in (("gyro", ":deg/s"), ("accel", ":g"))
    for axis in "xyz"
)
RANGING = "t_ms,to,from,diff,quality\n1000,1,0,250,9\n1010,5,1,-500,9\n1020,0,0x5,750,9\n"
INERTIAL = "t_ms,gx,gy,gz,ax,ay,az\n1000,180,0,0,0,0,1\n1001,0,90,0,0,0.5,1\n"


def read_columns(paths, columns, named, salvage=False):
    return read_by_profile(paths, Profile.of_columns(columns), named, salvage=salvage)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ranging.csv").write_text(RANGING)
    (tmp_path / "imu.csv").write_text(INERTIAL)
    (tmp_path / "survey.csv").write_text(SURVEY)
    return tmp_path


def test_units_and_names_end_at_the_border(files):
    flight = read_columns(["ranging.csv", "imu.csv"], parse_columns(f"{TDOA},{IMU}"), NAMED)
    assert flight.name == "ranging"
    np.testing.assert_allclose(flight.tdoa.t, [1.0, 1.01, 1.02])
    np.testing.assert_array_equal(flight.tdoa.a, [0, 1, 5])
    np.testing.assert_array_equal(flight.tdoa.b, [1, 5, 0])
    np.testing.assert_allclose(flight.tdoa.d, [0.25, -0.5, 0.75])
    np.testing.assert_allclose(flight.imu.gyro, [[np.pi, 0, 0], [0, np.pi / 2, 0]], atol=1e-12)
    np.testing.assert_allclose(flight.imu.accel, [[0, 0, 9.81], [0, 4.905, 9.81]])
    assert flight.truth is None


@pytest.mark.parametrize(
    "unit, cell",
    [
        ("m", "1.5"),
        ("cm", "150"),
        ("mm", "1500"),
        ("ft", "4.92126"),
        ("ns", "5.00346143"),
        ("ticks", "319.7097"),
    ],
)
def test_every_unit_of_a_tdoa(files, unit, cell):
    (files / "one.csv").write_text(f"t,a,b,d\n0.5,0,1,{cell}\n")
    flight = read_columns(
        ["one.csv"], parse_columns(f"time=t,anchor_a=a,anchor_b=b,tdoa=d:{unit}"), NAMED
    )
    assert flight.tdoa.d[0] == pytest.approx(1.5, abs=1e-4)


def test_rows_of_several_sensors_in_one_file(files):
    rows = "t,a,b,d,gx,gy,gz,ax,ay,az,px,py,pz\n0.1,0,1,0.5,,,,,,,,,\n0.1,,,,1,2,3,4,5,6,,,\n0.2,,,,,,,,,,7,8,9\n"
    (files / "all.csv").write_text(rows)
    others = (
        f"{sensor}_{axis}={sensor[0]}{axis}"
        for sensor in ("gyro", "accel", "pose")
        for axis in "xyz"
    )
    columns = parse_columns(",".join(["time=t,anchor_a=a,anchor_b=b,tdoa=d", *others]))
    flight = read_columns(["all.csv"], columns, NAMED)
    assert (len(flight.tdoa), len(flight.imu), len(flight.truth)) == (1, 1, 1)
    np.testing.assert_allclose(flight.imu.gyro, [[1, 2, 3]])
    np.testing.assert_allclose(flight.imu.accel, [[4, 5, 6]])
    np.testing.assert_array_equal(flight.truth.p, [[7, 8, 9]])
    assert np.isnan(flight.truth.q).all()


def test_blanks_about_names_and_units_do_not_matter():
    text = TDOA.replace("tdoa=diff:mm", " tdoa = diff : mm ")
    assert parse_columns(text) == parse_columns(TDOA)


@pytest.mark.parametrize(
    "text, said",
    [
        ("time", "is not OURS=THEIRS"),
        ("distance=r", "is not OURS=THEIRS"),
        ("range=r", "anchor is missing"),
        ("anchor=a,range=r", "range_time, or time, is missing"),
        ("time=t,time=u", "OURS, once"),
        ("tdoa=:mm", "is not OURS=THEIRS"),
        ("tdoa=d:feet", "'feet' is no unit of tdoa"),
        ("anchor_a=a:m", "'m' is no unit of anchor_a; use none"),
        ("anchor_a=a,anchor_b=b", "tdoa is missing"),
        ("anchor_a=a,anchor_b=b,tdoa=d", "tdoa_time, or time, is missing"),
        (f"{TDOA},gyro_x=w", "gyro_y is missing"),
        (f"{TDOA},pose_x=x,pose_y=y,pose_z=z,pose_qx=q", "belong together"),
    ],
)
def test_a_mapping_that_cannot_be_is_one_sentence(text, said):
    with pytest.raises(InputError, match=said):
        parse_columns(text)


def test_every_column_can_be_named_and_every_time_has_units():
    assert {"time", "tdoa_time", "imu_time", "pose_time"} <= UNITS.keys() and UNITS[
        "imu_time"
    ] == TIME


@pytest.mark.parametrize(
    "rows, said",
    [
        ("t_ms,from,to\n1,0,1\n", "has no column 'diff'; its columns are t_ms, from, to"),
        ("t_ms,from,to,diff\n1,0,1,x\n", "line 2: diff is 'x'; it must be a finite number"),
        ("t_ms,from,to,diff\n1,,1,3\n", "line 2: from is ''; it must be an anchor"),
        (
            "t_ms,from,to,diff\n1,0.5,1,3\n",
            "it must be an anchor of the survey, by its name, or an id 0 ... 65535",
        ),
        (
            "t_ms,from,to,diff\n1,0,70000,3\n",
            "it must be an anchor of the survey, by its name, or an id 0 ... 65535",
        ),
        (
            "t_ms,from,to,diff\n1,0,nan,3\n",
            "it must be an anchor of the survey, by its name, or an id 0 ... 65535",
        ),
        ("t_ms,from,to,diff\n1,0,1,inf\n", "it must be a finite number"),
        (
            f"t_ms,from,to,diff\n1,0,1,0x{'f' * 300}\n",
            "line 2: diff is '0xffff.*; it must be a finite number",
        ),
        ("t_ms,from,to,diff\n", "has no row below"),
    ],
)
def test_a_bad_file_is_one_sentence(files, rows, said):
    (files / "bad.csv").write_text(rows)
    with pytest.raises(InputError, match=said):
        read_columns(["bad.csv"], parse_columns(TDOA), NAMED)


def test_a_comma_before_three_digits_is_refused_between_commas(files):
    """It may be a thousands separator or a decimal comma. Other decimal commas are read."""
    rows = 't_ms,from,to,diff\n10,0,1,"0,5"\n20,0,1,"{}"\n'
    for cell in ("1,000", "-12,345"):
        (files / "big.csv").write_text(rows.format(cell))
        with pytest.raises(InputError, match=f"line 3: diff is '{cell}', .* or a decimal comma"):
            read_columns(["big.csv"], parse_columns(TDOA), NAMED)
    for cell in ("0,123", "1,25", "1,2345"):
        (files / "small.csv").write_text(rows.format(cell))
        flight = read_columns(["small.csv"], parse_columns(TDOA), NAMED)
        np.testing.assert_allclose(flight.tdoa.d, [5e-4, float(cell.replace(",", ".")) / 1e3])


def test_a_comma_between_semicolons_or_tabs_is_a_decimal_comma(files):
    for delimiter in ";\t":
        rows = "t_ms,from,to,diff\n10,0,1,1\n20,0,1,1\n".replace(",", delimiter)
        (files / "one.csv").write_text(rows)
        one = read_columns(["one.csv"], parse_columns(TDOA), NAMED)
        (files / "one.csv").write_text(rows.replace(f"1{delimiter}1\n2", f"1{delimiter}1,000\n2"))
        np.testing.assert_array_equal(
            read_columns(["one.csv"], parse_columns(TDOA), NAMED).tdoa.d, one.tdoa.d
        )


def test_the_file_that_lacks_the_fewest_columns_is_named(files):
    """`imu.csv` has none of the columns, `ranging.csv` all except one."""
    for paths in (["imu.csv", "ranging.csv"], ["ranging.csv", "imu.csv"]):
        with pytest.raises(InputError, match="^ranging.csv: has no column 'dist'; its columns"):
            read_columns(paths, parse_columns(TDOA.replace("diff", "dist")), NAMED)


def test_columns_in_two_files_are_refused(files):
    (files / "again.csv").write_text(RANGING)
    with pytest.raises(InputError, match="give one of them"):
        read_columns(["ranging.csv", "again.csv"], parse_columns(TDOA), NAMED)


ROWS = [(0.1 * k, k % 4, 5.0 + 0.01 * k) for k in range(240)]
RANGES = parse_columns("time=t,anchor=anchor,range=d")


def written(path, rows):
    path.write_text("t,anchor,d\n" + "".join("{:.1f},{},{:.2f}\n".format(*row) for row in rows))


def test_rows_that_are_grouped_by_anchor_are_read_in_the_order_of_time(files):
    written(files / "ordered.csv", ROWS)
    written(files / "grouped.csv", sorted(ROWS, key=lambda row: (row[1], row[0])))
    expected = read_columns(["ordered.csv"], RANGES, NAMED).range
    flight = read_columns(["grouped.csv"], RANGES, NAMED)
    np.testing.assert_array_equal(flight.range.t, expected.t)
    np.testing.assert_array_equal(flight.range.d, expected.d)
    assert not flight.restarts and "grouped by anchor" in flight.meta["remarks"][0]


def test_files_of_one_shape_for_each_anchor_are_read_together(files):
    written(files / "ordered.csv", ROWS)
    names = [f"A{anchor}.csv" for anchor in range(4)]
    for anchor, name in enumerate(names):
        written(files / name, [row for row in ROWS if row[1] == anchor])
    expected = read_columns(["ordered.csv"], RANGES, NAMED).range
    by_name = Profile("by name", (Source(RANGES | {"anchor": ("n", 1.0)}, topic="A{n}.csv"),))
    for profile in (Profile.of_columns(RANGES), by_name):
        ranges = read_by_profile(names, profile, NAMED).range
        np.testing.assert_array_equal(ranges.t, expected.t)
        np.testing.assert_array_equal(ranges.anchor, expected.anchor)
    with pytest.raises(InputError, match=r"ordered.csv: has the columns and anchors that A0.csv"):
        read_columns([*names, "ordered.csv"], RANGES, NAMED)
    with pytest.raises(InputError, match="where each anchor has a file, write a profile"):
        parse_columns("time=t,range=d")


def test_the_command_writes_a_bag_that_every_tool_reads(files, capsys):
    words = [
        "ranging.csv",
        "imu.csv",
        "--columns",
        f"{TDOA},{IMU}",
        "--survey",
        "survey.csv",
        "--out",
        "our.bag",
    ]
    assert main(words) == 0
    assert "uwb/tdoa: 3" in capsys.readouterr().out
    flight = read_flight("our.bag")
    np.testing.assert_allclose(flight.tdoa.d, [0.25, -0.5, 0.75])
    assert len(flight.imu) == 2 and len(flight.anchors) == 3


@pytest.mark.parametrize(
    "words, said",
    [
        (
            ["ranging.csv", "imu.csv", "--survey", "survey.csv"],
            "convert one by one, or name --columns",
        ),
        (["ranging.csv", "--columns", TDOA], "give a survey file"),
    ],
)
def test_what_is_missing_is_said(files, words, said, capsys):
    assert main([*words, "--out", "our.bag"]) == 2
    assert said in capsys.readouterr().err and not (files / "our.bag").exists()


# --- as other tools write them ---

OTHERS = """\
Zeit;von;nach;Differenz\r
0,00;NE Ecke;SW Ecke;1,25\r
0,01;sw ecke;Tuer;-0,5\r
0,02;Tuer;NE Ecke;
0,03;Tuer;NE Ecke;NaN\r
0,04;NE Ecke;Tuer;-\r
0,05;NE Ecke;SW Ecke;0,75\r
""" + "".join(f"0,{k};NE Ecke;SW Ecke;0,75\r\n" for k in range(10, 20))
NAMES = "name,x,y,z\nNE Ecke,0,0,1\nSW Ecke,5,0,1\nTuer,0,5,2\n"


def test_semicolons_commas_names_and_holes_of_a_spreadsheet(files, capsys):
    (files / "tag.csv").write_text(OTHERS)
    (files / "names.csv").write_text(NAMES)
    words = [
        "tag.csv",
        "--columns",
        "time=Zeit,anchor_a=von,anchor_b=nach,tdoa=Differenz",
        "--survey",
        "names.csv",
        "--out",
        "our.bag",
    ]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "ids in the bag: NE Ecke is 0, SW Ecke is 1, Tuer is 2" in told
    flight = read_flight("our.bag")
    assert "3 of 16 records left out, line 4: Differenz is ''; it must be a finite number." in told
    np.testing.assert_allclose(flight.tdoa.d[:3], [1.25, -0.5, 0.75])
    np.testing.assert_array_equal(flight.tdoa.a[:3], [0, 1, 0])
    np.testing.assert_array_equal(flight.anchors.positions[flight.anchors.row(2)], [0, 5, 2])


@pytest.mark.parametrize(
    "survey, ids",
    [
        (NAMES, {"NE Ecke": 0, "SW Ecke": 1, "Tuer": 2}),
        ("id,x,y,z\nA7,0,0,1\nA3,5,0,1\nA12,0,5,2\n", {"A7": 7, "A3": 3, "A12": 12}),
        (
            "anchors: {left: {position: [0, 0, 1]}, right: {position: [5, 0, 1]}}\n",
            {"left": 0, "right": 1},
        ),
        (SURVEY, {}),
    ],
)
def test_names_of_a_survey(files, survey, ids):
    (files / "named.yaml").write_text(survey)
    named = read_named_anchors("named.yaml")
    assert named.ids == ids and (not ids or set(named.anchors.ids) == set(ids.values()))


IDS = ["151B", "1E10", "0012", "0E07"]  # hexadecimal; three of them look like numbers


@pytest.mark.parametrize(
    "survey",
    [
        "id,x,y,z\n" + "".join(f"{name},{k},0,{k % 2}\n" for k, name in enumerate(IDS)),
        "anchors:\n" + "".join(f"  {name}: [{k}, 0, {k % 2}]\n" for k, name in enumerate(IDS)),
        "anchors:\n"
        + "".join(f"- {{id: {name}, x: {k}, y: 0, z: {k % 2}}}\n" for k, name in enumerate(IDS)),
    ],
)
def test_ids_that_look_like_numbers_are_texts(files, survey):
    (files / "hex").write_text(survey)
    named = read_named_anchors("hex")
    assert [named.id_of(name) for name in IDS] == [0, 1, 2, 3] == list(named.ids.values())
    rows = "".join(f"{k},{name},5,{name}\n" for k, name in enumerate(IDS))
    (files / "ranges.csv").write_text(f"t,anchor,d,tag\n{rows}")
    flight = read_columns(["ranges.csv"], parse_columns("time=t,anchor=anchor,range=d"), named)
    assert flight.range.anchor.tolist() == [0, 1, 2, 3] and "remarks" not in flight.meta
    source = Source(parse_columns("time=t,anchor=anchor,range=d"), tag="tag")
    for number, tag in enumerate(IDS):
        flight = read_by_profile(["ranges.csv"], Profile("tags", (source,)), named, tag)
        assert flight.range.anchor.tolist() == [number]


def test_an_id_of_exponential_form_is_no_other_anchor(files):
    for text in ("0E07", "1E1", "1e00"):
        assert NAMED.id_of(text) is None
    for value in ("1", "1.0", "1.000000e+00", 1, 1.0, "0x1", "01"):  # numpy writes the third
        assert NAMED.id_of(value) == 1


def test_gaps_are_skipped_and_counted_and_too_many_are_refused(files, capsys):
    lines = [f"{10 * k},0,1,{k}" for k in range(30)]
    lines[4], lines[9] = "40,0,1,broken", "90,,1,5"
    (files / "gaps.csv").write_text("t_ms,from,to,diff\n" + "\n".join(lines))
    words = ["gaps.csv", "--columns", TDOA, "--survey", "survey.csv", "--out", "our.bag"]
    assert main(words) == 0
    assert (
        "2 of 30 records left out, line 6: diff is 'broken'; it must be a finite number."
        in capsys.readouterr().out
    )
    assert len(read_flight("our.bag").tdoa) == 28
    (files / "gaps.csv").write_text(
        "t_ms,from,to,diff\n" + "\n".join(line.replace(",1,1", ",1,x1") for line in lines)
    )
    assert main([*words, "--force"]) == 2
    assert (
        "records of anchor_a, anchor_b, tdoa are like that: more than a gap"
        in capsys.readouterr().err
    )
    assert main([*words, "--force", "--salvage"]) == 0


def test_sensors_with_clocks_of_their_own_in_one_file(files, capsys):
    """Each sensor has a time column.

    Stamps of the IMU have another origin. Stamps of motion capture are late.
    """
    rows = ["t_uwb,from,to,diff,t_gyro,gx,gy,gz,t_acc,ax,ay,az,t_cap,x,y,z"]
    rows += [f"{k},0,1,100,{k + 1.7e9},1,2,3,{k + 1.7e9},0,0,1,{k + 0.2},1,2,3" for k in range(5)]
    (files / "all.csv").write_text("\n".join(rows))
    columns = "tdoa_time=t_uwb,anchor_a=from,anchor_b=to,tdoa=diff:mm,gyro_time=t_gyro,accel_time=t_acc,pose_time=t_cap"
    columns += "".join(f",pose_{axis}={axis}" for axis in "xyz") + "," + IMU
    words = ["all.csv", "--columns", columns, "--survey", "survey.csv", "--out", "our.bag"]
    assert main(words) == 0
    told = capsys.readouterr()
    assert "all: 4.2 s" in told.out  # and not 1.7e9
    assert (
        "imu runs from 1700000000.0 to 1700000004.0 s" in told.err
        and "--time-offset imu=-1700000000.000" in told.err
    )
    assert (
        main(
            [*words, "--force", "--time-offset", "imu=-1700000000.0", "--time-offset", "truth=-0.2"]
        )
        == 0
    )
    assert "no time in common" not in capsys.readouterr().err
    flight = read_flight("our.bag")
    np.testing.assert_allclose(flight.truth.t, flight.tdoa.t, atol=1e-6)
    np.testing.assert_allclose(flight.imu.t, flight.tdoa.t, atol=1e-6)


@pytest.mark.parametrize(
    "offset, said",
    [
        ("truth", "'truth' is not SENSOR=SECONDS"),
        ("camera=1", "'camera=1' is not SENSOR=SECONDS"),
        ("imu=soon", "'imu=soon' is not SENSOR=SECONDS"),
        ("imu=1", "ranging holds no imu; it holds tdoa"),
    ],
)
def test_an_offset_that_cannot_be_is_one_sentence(files, offset, said, capsys):
    words = [
        "ranging.csv",
        "--columns",
        TDOA,
        "--survey",
        "survey.csv",
        "--out",
        "our.bag",
        "--time-offset",
        offset,
    ]
    assert main(words) == 2
    assert said in capsys.readouterr().err


def test_ranges_need_no_tdoas(files, capsys):
    rows = "9,1,2500,100", "9,5,,100", "9,0,750,50", "9,0,760,50", "9,1,760,50"
    lines = [f"{0.5 + 0.1 * k:.1f},{row},1,2,3" for k, row in enumerate(rows)]
    (files / "twr.csv").write_text("\n".join(["t,tag,to,mm,sigma,px,py,pz", *lines, ""]))
    flight = read_columns(
        ["twr.csv"], parse_columns("time=t,anchor=to,range=mm:mm,range_std=sigma:mm"), NAMED
    )
    assert (
        len(flight.tdoa) == 0
        and flight.range.anchor.tolist() == [1, 0, 0, 1]
        and (flight.start, flight.end) == (0.5, 0.9)
    )
    np.testing.assert_allclose(flight.range.d, [2.5, 0.75, 0.76, 0.76])
    np.testing.assert_allclose(flight.range.variance, [0.01, 0.0025, 0.0025, 0.0025])
    assert "1 of 5 records left out" in flight.meta["remarks"][0]
    words = [
        "twr.csv",
        "--columns",
        "time=t,anchor=to,range=mm:mm,pose_x=px,pose_y=py,pose_z=pz",
        "--survey",
        "survey.csv",
        "--out",
        "twr.bag",
    ]
    assert main(words) == 0 and "uwb/range: 4" in capsys.readouterr().out
    back = read_flight("twr.bag", survey=None)
    np.testing.assert_allclose(back.range.d, flight.range.d)
    assert len(back.tdoa) == 0 and len(back.truth) == 5


def test_tdoas_and_ranges_of_one_file(files):
    (files / "both.csv").write_text("t,a,b,d,to,r\n0.1,0,1,0.5,,\n0.2,,,,5,2.5\n")
    flight = read_columns(
        ["both.csv"], parse_columns("time=t,anchor_a=a,anchor_b=b,tdoa=d,anchor=to,range=r"), NAMED
    )
    assert (
        flight.tdoa.d.tolist() == [0.5]
        and flight.range.d.tolist() == [2.5]
        and flight.start == flight.end == 0.1
    )


def test_a_survey_of_pandas_has_no_name_for_its_ids(files):
    (files / "anchors.csv").write_text(SURVEY.replace("id,x,y,z", ",x,y,z"))
    np.testing.assert_array_equal(read_survey(files / "anchors.csv").positions, ANCHORS.positions)


def test_hexadecimal_ids_of_a_survey_are_the_ids_that_messages_have(tmp_path):
    """An id is the whole hexadecimal number, not the digits at its end."""
    survey = tmp_path / "survey.csv"
    survey.write_text("id,x,y,z\n0x1A20,0,0,0\n0x1A21,4,0,3\n0x00F2,4,5,0\n")
    named = read_named_anchors(survey)
    assert named.anchors.ids.tolist() == [0x1A20, 0x1A21, 0xF2] and not named.ids
    assert named.id_of("0x1A21") == named.id_of("6689") == 0x1A21


def test_an_id_counts_where_the_names_of_anchors_end_with_it(tmp_path):
    survey = tmp_path / "survey.csv"
    survey.write_text("name,x,y,z\nA1,0,0,0\nA2,4,0,3\nA12,4,5,0\n")
    named = read_named_anchors(survey)
    assert [named.id_of(text) for text in ("A12", "12", "2", "3")] == [12, 12, 2, None]
    survey.write_text("name,x,y,z\nNE,0,0,0\nNW,4,0,3\nSW,4,5,0\n")
    # neither the second line nor an id of the radio
    assert read_named_anchors(survey).id_of("1") is None


@pytest.mark.parametrize(
    "names",
    [
        ["A1", "A2", "A3", "A4"],
        ["A123", "0E07", "BEEF", "12E3"],
        ["NO", "NW", "SO", "SW"],  # YAML 1.1 reads NO as false
        ["1", "on", "off", "y"],
        ["A5", "B5", "C5", "wall"],
    ],
)
def test_names_of_a_yaml_survey_are_those_of_the_recording(tmp_path, names):
    """Of A123 beside BEEF the others were dropped, and NO was "no anchor of the survey"."""
    places = [[0, 0, 0], [4, 0, 3], [4, 5, 0], [0, 5, 3]]
    survey = tmp_path / "survey.yaml"
    lines = [f"  {name}: {{position: {place}}}" for name, place in zip(names, places)]
    survey.write_text("anchors:\n" + "\n".join(lines))
    named = read_named_anchors(survey)
    found = [named.anchors.index(np.array([named.id_of(name)]))[0] for name in names]
    np.testing.assert_array_equal(named.anchors.positions[found], places)


def test_a_letter_before_an_id_is_no_other_id(tmp_path):
    survey = tmp_path / "survey.yaml"
    survey.write_text("A01: [0, 0, 0]\na_2: [4, 0, 3]\nA7: [4, 5, 0]\n")
    assert read_survey(survey).ids.tolist() == [1, 2, 7]
    survey.write_text("a1_pos: [0, 0, 0]\na2_pos: [4, 0, 3]\na7_pos: [4, 5, 0]\nstart: [1, 1, 1]\n")
    assert read_survey(survey).ids.tolist() == [1, 2, 7]
    survey.write_text("A1: [0, 0, 0]\nA2: [4, 0, 3]\nB1: [4, 5, 0]\n")
    with pytest.raises(InputError, match="must be a whole number"):
        read_survey(survey)
