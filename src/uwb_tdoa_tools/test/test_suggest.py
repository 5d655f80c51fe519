# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Text files as others write them: --suggest writes a profile, and the command that it prints works."""

import json
from pathlib import Path
import shlex
import tracemalloc

import numpy as np
from programs import run
import pytest
from recordings import SURVEY

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_tools.commands.convert import main as convert
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.readers.by_profile import as_time

CASES = Path(__file__).resolve().parents[4] / "shared" / "cases" / "reports"
START, N = 1_700_000_000, 200
T = START + 0.0035 + 0.005 * np.arange(N)
A, B = np.arange(N) % 6, (np.arange(N) + 1) % 6
D = np.round(np.sin(0.1 * np.arange(N)) + 0.1 * A - 0.2, 4)
DATES = [f"2023-11-14T22:{13 + (20 + k // 200) // 60}:{20 + k // 200:02d}" for k in range(N)]
FRACTIONS = np.round((T - START) * 1e6).astype(int)


def lines(pattern, header=""):
    """Return a table with a line for each TDOA."""
    rows = (
        pattern.format(t=t, f=f, ns=1000 * f, a=a, b=b, d=d, ms=f / 1e3)
        for t, f, a, b, d in zip(T, FRACTIONS, A, B, D)
    )
    return "\n".join([*filter(None, [header]), *rows]) + "\n"


def wide(names):
    """Return a table with a column for each pair, where a value stands until the next one."""
    values, rows = [0.25] * 6, []
    for f, a, d in zip(FRACTIONS, A, D):
        values[a] = d
        rows.append(",".join(map(str, [f // 1000, *values])))
    return "\n".join([",".join(["timestamp", *names]), *rows]) + "\n"


RECORD = (
    '{{"header": {{"stamp": {{"sec": %d, "nanosec": {ns}}}}}, "from": {a}, "to": {b}, "diff": {d}}}'
)
TABLES = {
    "echo --csv": lines(f"{START},{{ns}},base_link,{{a}},{{b}},{{d}},0.0"),
    "rostopic echo -p": lines(
        f"1,{{a}},{START}{{ns:09d}},cf,{{a}},{{b}},{{d}}",
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.idA,field.idB,field.data",
    ),
    "two columns": lines(f"{START},{{ns}},{{a}},{{b}},{{d}}", "secs,nsecs,from,to,d"),
    "date": lines("2023-11-14 22:13:20.{f:06d}Z,{a},{b},{d}", "t,from,to,d"),
    "date and time": lines("2023/11/14;22:13:20,{f:06d};{a};{b};{d}", "date;time;src;dst;tdoa (m)"),
    "numpy": lines("{t:.6f},{a},{b},{d}", "# t,from,to,d"),
    "numpy, blanks": lines("{t:.18e} {a:.18e} {b:.18e} {d:.18e}", "# made by me\n# t from to d"),
    "no header": lines("{t:.6f},{a},{b},{d}"),
    "JSON lines": lines(RECORD % START),
    "JSON list": "[\n" + lines(RECORD % START + ",") + "]\n",
    "pairs": wide([f"tdoa2.d{k}-{(k + 1) % 6}" for k in range(6)]),
    "other pairs": wide([f"ddoa_A{k}_A{(k + 1) % 6} [m]" for k in range(6)]),
    "of another language": lines(
        "{t:.6f};{a};{b};{d}", "Zeit [s];Anker von;Anker nach;Differenz der Strecken"
    ),
    "nested": lines(
        '{{"ts": {f}, "uwb": {{"ref": {a}, "anchor": {b}, "quality": 90, "tdoa_m": {d}}}}}'
    ),
    "milliseconds by name": lines("{ms:.3f},{a},{b},{d}", "millis,from,to,d"),
    "mm and us": lines("{f},{a},{b},{d}", "time [us],a,b,diff_mm").replace(".", ""),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anchors.yaml").write_text(SURVEY)  # a survey is known by its content
    return tmp_path


def read_as_suggested(file, capsys, *words):
    """Return the Flight that the printed command makes of a file."""
    code = convert([str(file), "--suggest", "profile.yaml", *words])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    (line,) = [each for each in printed.out.splitlines() if each.startswith("next: ")]
    assert convert(shlex.split(line.partition(" convert ")[2])) == 0, capsys.readouterr().err
    capsys.readouterr()
    return read_flight("our_bag")


@pytest.mark.parametrize("kind", TABLES)
def test_the_printed_command_reads_the_file(folder, kind, capsys):
    (folder / "log.csv").write_text(TABLES[kind])
    flight = read_as_suggested("log.csv", capsys)
    if "pairs" in kind:  # repeated values are no new measurements
        assert N - 7 < len(flight.tdoa) <= N + 6 and {*zip(flight.tdoa.a, flight.tdoa.b)} == {
            *zip(A, B)
        }
        assert np.ptp(flight.tdoa.t) == pytest.approx(np.ptp(T), abs=2e-3)
        return
    scale = 10.0 if kind == "mm and us" else 1.0  # 4 decimals without their point
    np.testing.assert_array_equal(np.stack([flight.tdoa.a, flight.tdoa.b]), [A, B])
    np.testing.assert_allclose(flight.tdoa.t - flight.tdoa.t[0], T - T[0], atol=2e-6)
    if scale == 1.0:
        np.testing.assert_allclose(flight.tdoa.d, D, atol=1e-6)


SHELL = (
    "DIST,2,AN0,0C2F,3.72,3.65,0.19,{:.2f},AN1,1E10,-3.12,-4.39,3.02,{:.2f},POS,1.50,0.04,0.03,99"
)
LES = "0C2F[3.72,3.65,0.19]={:.2f} 1E10[-3.12,-4.39,3.02]={:.2f} le_us=2576 est[1.50,0.04,0.03,99]"


@pytest.mark.parametrize("form", [f"{{:.3f}},{SHELL}", f"{{:.3f}} {SHELL}", f"{{:.3f}} {LES}"])
def test_the_output_of_a_shell_is_named_with_a_line_that_makes_a_table(folder, form, capsys):
    rows = [form.format(0.1 * k, 4.0 + 0.01 * k, 6.0 - 0.01 * k) for k in range(30)]
    (folder / "tag.log").write_text("\n".join(rows))
    assert convert(["tag.log", "--suggest", "profile.yaml"]) == 2
    said = capsys.readouterr().err
    assert "of a DWM1001" in said and not Path("profile.yaml").exists()
    line = said[said.index("awk ") : said.index("; then: ")]
    run("sh", "-c", line, check=True)
    flight = read_as_suggested("ranges.csv", capsys)
    assert len(flight.range) == 60 and len(flight.anchors) == 2  # positions are in the log
    np.testing.assert_allclose(flight.range.d[:2], [4.0, 6.0], atol=1e-6)


@pytest.mark.parametrize("above", ["made by me\nof a tag\n\n", "sep=;\n"])
def test_lines_above_a_table_are_named_with_a_line_that_leaves_them_out(folder, above, capsys):
    separator = ";" if "sep" in above else ","
    table = lines("{t:.6f},{a},{b},{d}", "t,from,to,d").replace(",", separator)
    (folder / "log.csv").write_text(above + table)
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 2
    said = capsys.readouterr().err
    assert " lines above its table; leave them out" in said and not Path("profile.yaml").exists()
    run("sh", "-c", said[said.index("tail ") : said.index("; then: ")], check=True)
    np.testing.assert_allclose(read_as_suggested("table.csv", capsys).tdoa.d, D, atol=1e-6)


def test_text_of_another_encoding_is_named(folder, capsys):
    (folder / "log.csv").write_bytes(lines("{t:.6f};{a};{b};{d}", "Größe;a;b;d").encode("latin-1"))
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 2
    assert "byte 2 is not text in UTF-8; write the file in UTF-8" in capsys.readouterr().err


@pytest.mark.parametrize("header", ["", "kind,t,from,to,d,ax,ay,az,gx,gy,gz"])
@pytest.mark.parametrize("first", [True, False])
def test_rows_of_several_kinds_are_named_with_lines_that_split_them(folder, header, first, capsys):
    """The kind is in the first column, or behind the time."""
    rows = [header] if header else []
    for t, a, b, d in zip(T, A, B, D):
        rows += [f"TDOA,{t:.6f},{a},{b},{d}{6 * ',' if header else ''}"]
        rows += [f"IMU,{t:.6f},{3 * ',' if header else ''}0.1,0.2,9.8,0.0,0.0,0.3"]
    if not first:
        swapped = [row.split(",") for row in rows]
        rows = [",".join([t, kind, *more]) for kind, t, *more in swapped]
    (folder / "my log.csv").write_text("\n".join(rows) + "\n")
    assert convert(["my log.csv", "--suggest", "profile.yaml"]) == 2
    said = capsys.readouterr().err
    assert "several kinds, TDOA, IMU" in said and not Path("profile.yaml").exists()
    assert said.rstrip().endswith("convert tdoa.csv imu.csv --suggest profile.yaml")
    run("sh", "-c", said[said.index("grep ") : said.index("; then: ")], check=True)
    flight = read_as_suggested("tdoa.csv", capsys)
    np.testing.assert_allclose(flight.tdoa.d, D, atol=1e-6)


def test_kinds_of_rows_of_one_shape_are_named_by_their_words(folder, capsys):
    """Their values would be mixed; names of anchors are no kinds."""
    rows = [
        f"TDOA,{t:.6f},{a},{b},{d}\nRSSI,{t:.6f},{a},{b},-80.5" for t, a, b, d in zip(T, A, B, D)
    ]
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 2
    assert "several kinds, TDOA, RSSI" in capsys.readouterr().err
    names = [f"{('left', 'right')[k % 2]},{t:.6f},{3.0 + 0.01 * k}" for k, t in enumerate(T)]
    (folder / "log.csv").write_text("\n".join(["anchor,t,range", *names]) + "\n")
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 0


@pytest.mark.parametrize("prefix", ["", "q_", "rotation."])
def test_the_attitude_of_a_ground_truth_is_suggested(folder, prefix, capsys):
    """Whatever it is called, beside a position that is called ground truth."""
    axes = [f"{prefix}{k}" if prefix else f"q{k}" for k in "xyzw"]
    (folder / "log.csv").write_text(lines("{t:.6f},{a},{b},{d}", "t,from,to,d"))
    rows = [",".join(map(str, [t, 1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8])) for t in T]
    (folder / "mocap.csv").write_text("\n".join([",".join(["t", *"xyz", *axes]), *rows]) + "\n")
    assert convert(["log.csv", "mocap.csv", "--suggest", "profile.yaml"]) == 0
    (line,) = [each for each in capsys.readouterr().out.splitlines() if each.startswith("next: ")]
    assert convert(shlex.split(line.partition(" convert ")[2])) == 0
    np.testing.assert_allclose(read_flight("our_bag").truth.q[-1], [0.0, 0.0, 0.6, 0.8])


def test_two_columns_beside_a_number_are_no_tdoas_by_their_values_alone(folder, capsys):
    """A cell of a battery and its voltage have the form of an anchor and its range."""
    rows = [f"{t:.3f},{k % 4},{3.7 + 0.01 * (k % 7)}" for k, t in enumerate(T)]
    (folder / "log.csv").write_text("\n".join(["t,cell,volts", *rows]) + "\n")
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 2
    assert "no TDOAs or ranges are recognized" in capsys.readouterr().err


def test_files_of_arrays_are_named(folder, capsys):
    np.savez("log.npz", t=T, d=D)
    np.save("log.npy", D)
    for name, what in (
        ("log.npz", "a zip file, as Excel and numpy"),
        ("log.npy", "an array of numpy"),
    ):
        assert convert([name, "--suggest", "profile.yaml"]) == 2
        said = capsys.readouterr().err
        assert f"{name}: is {what}" in said and "save it as CSV, or give the arrays to" in said


def test_a_profile_without_use_is_an_error(folder, capsys):
    (folder / "log.csv").write_text("u,v\n1,2\n3,4\n")
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 2
    said = capsys.readouterr()
    assert "no TDOAs or ranges are recognized" in said.err and "next:" not in said.out
    (folder / "log.csv").write_text("from,to,d\n" + "1,2,0.5\n" * 9)
    assert convert(["log.csv", "--suggest", "profile.yaml", "--force"]) == 2
    assert "no column with the time is recognized" in capsys.readouterr().err


@pytest.mark.parametrize(
    "truth, force, units", [(1497.0, 1.0, "mm g"), (1.5, 9.8, "m m/s^2"), (1.5, 980.0, "m mg")]
)
def test_values_decide_the_units(folder, truth, force, units, capsys):
    header = "t,from,to,d,pose_x,pose_y,pose_z,gx,gy,gz,ax,ay,az"
    rest = f",{truth},{-truth},{truth},30.0,1.0,2.0,0.0,0.0,{force}"
    (folder / "log.csv").write_text(lines("{ms},{a},{b},{d}" + rest, header))
    assert convert(["log.csv", "--suggest", "profile.yaml"]) == 0
    text = Path("profile.yaml").read_text()
    place, acceleration = units.split()
    for column in ("t:ms", f"pose_x:{place}", "gx:deg/s", f"az:{acceleration}"):
        assert f'"{column}"' in text
    assert "doubtful" not in text


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("12.5", 12.5),
        ("1970-01-02T00:00:01.25Z", 86401.25),
        ("1970/1/2 00:00:01", 86401.0),
        ("1970-01-01T02:00:00+02:00", 0.0),
        ("00:01:00,5", 60.5),
        ("1970-13-01 00:00:00", None),
        ("noon", None),
    ],
)
def test_dates_and_times(text, seconds):
    assert as_time(text) == seconds


def nested(name, count):
    """Return a record of values below one name."""
    return json.dumps({name: dict.fromkeys(map(str, range(count)), 1)})


@pytest.mark.parametrize(
    "lines",
    [
        [nested("k" * 200_000, 20_000)],
        [nested("k" * 500 + str(row), 500) for row in range(200)],
        [json.dumps({"name" * 20 + str(row): 1}) for row in range(30_000)],
    ],
    ids=["a long path of many values", "long paths", "a name for each row"],
)
def test_records_with_endless_names_are_refused_in_little_memory(folder, capsys, lines):
    """A path is repeated for each value below it: 0.5 MB unfold to 4 GB."""
    (folder / "log.jsonl").write_text("\n".join(lines))
    tracemalloc.start()
    code = convert(["log.jsonl", "--suggest", "profile.yaml"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == 2 and "a row of more than 100000 characters" in capsys.readouterr().err
    assert peak < 50e6


def test_a_record_that_is_no_json_is_refused(folder, capsys):
    (folder / "log.jsonl").write_text('{"t": 1}\n{"t": \n')
    assert convert(["log.jsonl", "--suggest", "profile.yaml"]) == 2
    assert "log.jsonl: is no JSON with one record on each line" in capsys.readouterr().err


def test_entries_of_lists_are_records(folder, capsys):
    rows = [
        json.dumps(
            {"ts": int(1e3 * t), "ranges": [{"id": int(k), "dist_cm": 500 + i} for k in (0, 1)]}
        )
        for i, t in enumerate(T)
    ]
    (folder / "day").mkdir()
    (folder / "day" / "log.jsonl").write_text("\n".join(rows))
    flight = read_as_suggested("day", capsys)
    assert len(flight.range) == 2 * N and flight.range.d.min() == pytest.approx(5.0)


@pytest.mark.parametrize("header", ["id,lat,lon,alt", "id,x,y,z"])
def test_anchors_in_degrees_are_named(tmp_path, header):
    rows = [f"{k},{48.1 + 7e-5 * (k % 2):.8f},{11.5 + 9e-5 * (k // 2):.8f},{k}" for k in range(4)]
    file = tmp_path / "anchors.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    with pytest.raises(InputError, match="are latitude and longitude in degrees") as error:
        read_survey(file)
    line = str(error.value).replace("FILE", "anchors.csv")
    run("sh", "-c", line[line.index("awk ") :], check=True, cwd=tmp_path)
    positions = read_survey(tmp_path / "metres.csv").positions
    np.testing.assert_allclose(np.ptp(positions, axis=0), [6.7, 7.8, 3.0], atol=0.05)


@pytest.mark.skipif(not CASES.is_dir(), reason="needs ../shared")
@pytest.mark.parametrize(
    "case",
    ["echo_csv", "rostopic_csv", "wide_tdoa", "two_time_columns", "date_time", "hash_header"],
)
def test_recordings_as_reported(folder, case, capsys):
    survey = CASES.parents[1] / "data" / "surveys" / "anchor_0426.txt"
    flight = read_as_suggested(CASES / case, capsys, "--survey", str(survey))
    assert len(flight.tdoa) > 800 and 5.0 < np.ptp(flight.tdoa.t) < 20.0
