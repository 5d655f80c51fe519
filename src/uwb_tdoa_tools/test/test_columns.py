"""CSV files of other tools: any column names, any of the usual units, one file or several."""

import numpy as np
import pytest
from recordings import ANCHORS, SURVEY
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.commands.convert import main
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.readers.columns import TIME, UNITS, parse_columns, read_columns

TDOA = "time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff:mm"
IMU = ",".join(f"{s}_{axis}={s[0]}{axis}{unit}" for s, unit in (("gyro", ":deg/s"), ("accel", ":g")) for axis in "xyz")
RANGING = "t_ms,to,from,diff,quality\n1000,1,0,250,9\n1010,5,1,-500,9\n1020,0,0x5,750,9\n"
INERTIAL = "t_ms,gx,gy,gz,ax,ay,az\n1000,180,0,0,0,0,1\n1001,0,90,0,0,0.5,1\n"


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ranging.csv").write_text(RANGING)
    (tmp_path / "imu.csv").write_text(INERTIAL)
    (tmp_path / "survey.csv").write_text(SURVEY)
    return tmp_path


def test_units_and_names_end_at_the_border(files):
    flight = read_columns(["ranging.csv", "imu.csv"], parse_columns(f"{TDOA},{IMU}"), ANCHORS)
    assert flight.name == "ranging"
    np.testing.assert_allclose(flight.tdoa.t, [1.0, 1.01, 1.02])
    np.testing.assert_array_equal(flight.tdoa.a, [0, 1, 5])
    np.testing.assert_array_equal(flight.tdoa.b, [1, 5, 0])
    np.testing.assert_allclose(flight.tdoa.d, [0.25, -0.5, 0.75])
    np.testing.assert_allclose(flight.imu.gyro, [[np.pi, 0, 0], [0, np.pi / 2, 0]], atol=1e-12)
    np.testing.assert_allclose(flight.imu.accel, [[0, 0, 9.81], [0, 4.905, 9.81]])
    assert flight.truth is None


@pytest.mark.parametrize(
    "unit, cell", [("m", "1.5"), ("cm", "150"), ("mm", "1500"), ("ns", "5.00346143"), ("ticks", "319.7097")]
)
def test_every_unit_of_a_tdoa(files, unit, cell):
    (files / "one.csv").write_text(f"t,a,b,d\n0.5,0,1,{cell}\n")
    flight = read_columns(["one.csv"], parse_columns(f"time=t,anchor_a=a,anchor_b=b,tdoa=d:{unit}"), ANCHORS)
    assert flight.tdoa.d[0] == pytest.approx(1.5, abs=1e-4)


def test_rows_of_several_sensors_in_one_file(files):
    rows = "t,a,b,d,gx,gy,gz,ax,ay,az,px,py,pz\n0.1,0,1,0.5,,,,,,,,,\n0.1,,,,1,2,3,4,5,6,,,\n0.2,,,,,,,,,,7,8,9\n"
    (files / "all.csv").write_text(rows)
    others = (f"{sensor}_{axis}={sensor[0]}{axis}" for sensor in ("gyro", "accel", "pose") for axis in "xyz")
    columns = parse_columns(",".join(["time=t,anchor_a=a,anchor_b=b,tdoa=d", *others]))
    flight = read_columns(["all.csv"], columns, ANCHORS)
    assert (len(flight.tdoa), len(flight.imu), len(flight.truth)) == (1, 1, 1)
    np.testing.assert_allclose(flight.imu.gyro, [[1, 2, 3]])
    np.testing.assert_allclose(flight.imu.accel, [[4, 5, 6]])
    np.testing.assert_array_equal(flight.truth.p, [[7, 8, 9]])
    assert np.isnan(flight.truth.q).all()


@pytest.mark.parametrize(
    "text, said",
    [
        ("time", "is not OURS=THEIRS"),
        ("range=r", "is not OURS=THEIRS"),
        ("time=t,time=u", "OURS, once"),
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
    assert {"time", "tdoa_time", "imu_time", "pose_time"} <= UNITS.keys() and UNITS["imu_time"] == TIME


@pytest.mark.parametrize(
    "rows, said",
    [
        ("t_ms,from,to\n1,0,1\n", "has no column 'diff'; its columns are t_ms, from, to"),
        ("t_ms,from,to,diff\n1,0,1,x\n", "line 2: diff is 'x'; it must be a number"),
        (f"t_ms,from,to,diff\n1,0,1,0x{'f' * 300}\n", "line 2: diff is '0xffff.*; it must be a number"),
        ("t_ms,from,to,diff\n1,,1,3\n", "line 2: from is ''"),
        ("t_ms,from,to,diff\n1,0.5,1,3\n", "ids are whole numbers"),
        ("t_ms,from,to,diff\n1,0,70000,3\n", "ids are whole numbers"),
        ("t_ms,from,to,diff\n1,0,nan,3\n", "ids are whole numbers"),
        ("t_ms,from,to,diff\n1,0,1,inf\n", "it must be finite"),
        ("t_ms,from,to,diff\n1,0,1\n", "line 2: has fewer cells"),
        ("t_ms,from,to,diff\n", "has no row below"),
    ],
)
def test_a_bad_file_is_one_sentence(files, rows, said):
    (files / "bad.csv").write_text(rows)
    with pytest.raises(InputError, match=said):
        read_columns(["bad.csv"], parse_columns(TDOA), ANCHORS)


def test_columns_in_two_files_are_refused(files):
    (files / "again.csv").write_text(RANGING)
    with pytest.raises(InputError, match="give one of them"):
        read_columns(["ranging.csv", "again.csv"], parse_columns(TDOA), ANCHORS)


def test_the_command_writes_a_bag_that_every_tool_reads(files, capsys):
    words = ["ranging.csv", "imu.csv", "--columns", f"{TDOA},{IMU}", "--survey", "survey.csv", "--out", "our.bag"]
    assert main(words) == 0
    assert "uwb/tdoa: 3" in capsys.readouterr().out
    flight = read_flight("our.bag")
    np.testing.assert_allclose(flight.tdoa.d, [0.25, -0.5, 0.75])
    assert len(flight.imu) == 2 and len(flight.anchors) == 3


@pytest.mark.parametrize(
    "words, said",
    [
        (["ranging.csv", "imu.csv", "--survey", "survey.csv"], "convert one by one, or name --columns"),
        (["ranging.csv", "--columns", TDOA], "give a survey file"),
    ],
)
def test_what_is_missing_is_said(files, words, said, capsys):
    assert main([*words, "--out", "our.bag"]) == 2
    assert said in capsys.readouterr().err and not (files / "our.bag").exists()
