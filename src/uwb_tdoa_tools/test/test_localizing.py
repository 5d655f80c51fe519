# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import json

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.core.memory import REJECTED, USED
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_ekf.results import Odometry, Residuals, rows_of
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag
from uwb_tdoa_tools.commands import evaluate, localize
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing import pictures
from uwb_tdoa_tools.localizing.localize import (
    BAD,
    GOOD,
    assess,
    check_names,
    lost_spans,
    name_of,
    write_tum,
)
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

CLEAN = dict(
    duration=14.0,
    floor_time=1.0,
    imu_rate=200.0,
    bias=False,
    multipath=False,
    outlier_probability=0.0,
)


@pytest.fixture(scope="module")
def flight():
    return simulate(SimulationConfig(seed=1, **CLEAN))


@pytest.fixture(scope="module")
def bags(flight, tmp_path_factory):
    """Write the same flight with its ground truth, without one, and with a wrong one.

    The wrong ground truth is shifted by 3 m in each coordinate, and one position is NaN.
    """
    folder = tmp_path_factory.mktemp("localize")
    wrong = replace(flight.truth, p=flight.truth.p + 3.0)
    wrong.p[9] = np.nan
    for name, truth in (("true", flight.truth), ("none", None), ("wrong", wrong)):
        write_bag(replace(flight, truth=truth), folder / name / "flight.bag")
    return folder


def run(arguments, code=0):
    assert localize.main([*map(str, arguments)]) == code


# --- the trajectory ---


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--smooth",)])
def test_ground_truth_is_not_read_and_the_trajectory_is_that_of_evaluate_to_the_bit(
    bags, tmp_path, more
):
    names = ("wrong",) if more else ("true", "none", "wrong")
    for name in names:
        run([bags / name / "flight.bag", "--out", tmp_path / name, "--residuals", *more])
    for file in ("flight.tum", "flight.csv", "flight_residuals.csv"):
        contents = {(tmp_path / name / file).read_bytes() for name in names}
        assert len(contents) == 1 and contents.pop().count(b"\n") > 100
    assert (
        evaluate.main([str(bags / "true" / "flight.bag"), "--tum", str(tmp_path / "judged"), *more])
        == 0
    )
    (judged,) = [
        path for path in (tmp_path / "judged").glob("*.tum") if not path.stem.endswith("_truth")
    ]
    assert judged.read_bytes() == (tmp_path / "wrong" / "flight.tum").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("ranges", [False, True])
def test_evaluate_and_localize_state_the_same_nis(bags, ranges, tmp_path, capsys):
    """They reported 5.26 and 0.93 for one flight. Later, `evaluate` left out ranges."""
    recording = bags / "true" / "flight.bag"
    if ranges:
        recording = tmp_path / "ranged.bag"
        write_bag(simulate(SimulationConfig(seed=1, range_noise=0.1, **CLEAN)), recording)
    run([recording, "--out", tmp_path, "--json", tmp_path / "localized.json"])
    assert evaluate.main([str(recording), "--json", str(tmp_path / "judged.json")]) == 0
    localized, judged = (
        json.loads((tmp_path / f"{name}.json").read_text()) for name in ("localized", "judged")
    )
    (told,), (run_of_it,) = localized["flights"], judged["runs"]
    assert run_of_it["nis_mean"] == pytest.approx(told["nis"], abs=1e-9)


@pytest.mark.slow
def test_what_is_written_says_the_same(bags, flight, tmp_path, capsys):
    run(
        [
            bags / "none" / "flight.bag",
            "--out",
            tmp_path,
            "--bag",
            "--residuals",
            "--json",
            tmp_path / "all.json",
            "--no-bias",
        ]
    )
    odometry = FlightEstimator()(read_bag(bags / "none" / "flight.bag")).odometry
    table = np.genfromtxt(tmp_path / "flight.csv", delimiter=",", names=True)
    np.testing.assert_allclose(
        np.column_stack([table[name] for name in "xyz"]), odometry.p, atol=1e-6
    )
    np.testing.assert_allclose(table["std_z"], np.sqrt(odometry.covariance[:, 2, 2]), atol=1e-6)
    recorded = read_odometry(tmp_path / "flight_bag")
    np.testing.assert_allclose(recorded.p, odometry.p, atol=1e-12)
    np.testing.assert_allclose(recorded.v, odometry.v, atol=1e-9)
    with AnyReader([tmp_path / "flight_bag"]) as reader:
        moves = [
            reader.deserialize(data, one.msgtype)
            for one, _, data in reader.messages(
                [one for one in reader.connections if one.topic == "/tf"]
            )
        ]
    frames = [move.transforms[0] for move in moves]
    assert {(one.header.frame_id, one.child_frame_id) for one in frames} == {("map", "base_link")}
    moved = [one.transform.translation for one in frames]
    np.testing.assert_allclose([(p.x, p.y, p.z) for p in moved], odometry.p, atol=1e-12)
    np.testing.assert_allclose(
        recorded.covariance[:, :3, :3], odometry.covariance[:, :3, :3], atol=1e-12
    )
    lines = (tmp_path / "flight_residuals.csv").read_text().splitlines()
    assert len(lines) == 1 + len(flight.tdoa) and lines[0] == "t,a,b,residual,std,weight,verdict"
    for picture in ("flight.png", "flight_residuals.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    (found,) = json.loads((tmp_path / "all.json").read_text())["flights"]
    assert (
        found["verdict"] == "good"
        and found["explained"] > 0.95
        and found["estimates"] == len(odometry)
    )
    assert "flight: good: standard deviation" in capsys.readouterr().out


def test_a_tum_file_has_one_line_per_pose(tmp_path):
    path = tmp_path / "made" / "for" / "it.tum"
    t = np.array([1700000000.123456, 1700000000.128456])
    p, q = (
        np.array([[1.0, -2.0, 3.25], [0.0, 0.5, 1e-7]]),
        np.array([[0.0, 0.0, 0.6, 0.8], [np.nan] * 4]),
    )
    write_tum(path, t, p, q)
    lines = path.read_text().splitlines()
    assert (
        lines[0]
        == "1700000000.123456001 1.000000 -2.000000 3.250000 0.000000 0.000000 0.600000 0.800000"
    )
    assert [len(line.split()) for line in lines] == [8, 8]
    read = np.loadtxt(path)
    np.testing.assert_allclose(read[:, 0], t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read[:, 1:4], p, atol=1e-6)
    # unknown attitudes become the identity
    np.testing.assert_array_equal(read[1, 4:], [0, 0, 0, 1])
    write_tum(tmp_path / "none.tum", np.empty(0), np.empty((0, 3)), np.empty((0, 4)))
    assert (tmp_path / "none.tum").read_text() == ""


# --- how reliable it is ---


def assessed(flight):
    return assess(flight, FlightEstimator()(flight))


def test_a_clean_flight_is_good_and_within_what_is_stated(flight):
    found = assessed(replace(flight, truth=None))
    assert found.level == GOOD and not found.reasons and not found.lost
    odometry = FlightEstimator()(flight).odometry
    true = np.stack(
        [np.interp(odometry.t, flight.truth.t, flight.truth.p[:, k]) for k in range(3)], axis=1
    )
    assert np.mean(np.linalg.norm(odometry.p - true, axis=1) <= found.figures["within"]) >= 0.95


@pytest.fixture(scope="module")
def ranged():
    """Return a flight with ranges only, without ground truth."""
    made = simulate(SimulationConfig(seed=1, range_noise=0.1, **CLEAN))
    return replace(made, tdoa=rows_of(made.tdoa, slice(0)), truth=None)


@pytest.mark.slow
def test_ranges_alone_are_assessed_like_tdoas(ranged, tmp_path):
    found = assessed(ranged)
    assert found.level == GOOD and not found.reasons and not found.lost
    assert (
        f"% of {len(ranged.range)} ranges fit it" in found.sentences()[0]
        and found.figures["seconds"] > 12.0
    )
    write_bag(ranged, tmp_path / "ranged.bag")
    run([tmp_path / "ranged.bag", "--residuals", "--zones", "2", "--out", tmp_path / "out"])
    lines = (tmp_path / "out" / "ranged_residuals.csv").read_text().splitlines()
    assert len(lines) == 1 + len(ranged.range)
    assert (
        {line.split(",")[1] for line in lines[1:]}
        == {line.split(",")[2] for line in lines[1:]}
        == {str(i) for i in ranged.anchors.ids}
    )
    assert (tmp_path / "out" / "ranged_residuals.png").exists() and (
        tmp_path / "out" / "ranged_zones.csv"
    ).exists()


def test_an_offset_of_all_ranges_is_reported(ranged):
    found = assess(ranged, FlightEstimator(smoothed=True)(without_offset(ranged, -0.25)))
    assert found.figures["range_offset"] == pytest.approx(0.25, abs=0.02)
    assert "all ranges are 25 cm too long: that was found, and taken out" in found.sentences()
    sound = assessed(ranged)
    assert abs(sound.figures["range_offset"]) < 0.02 and not any(
        "all ranges" in sentence for sentence in sound.sentences()
    )


def test_ranges_that_contradict_each_other_are_not_good(ranged):
    far = replace(ranged.range, d=ranged.range.d + 20.0 * (ranged.range.anchor % 3))
    found = assessed(replace(ranged, range=far))
    assert found.level != GOOD and "ranges" in " ".join(found.reasons)


@pytest.mark.parametrize(("step", "lost"), [(0.01, [(5.0, 8.0)]), (2.0, [])])
def test_a_tag_that_is_heard_seldom_is_not_lost_in_between(step, lost):
    t = np.arange(0.0, 20.0, step)
    t = t[(t <= 5.0) | (t >= 8.0)]
    n = len(t)
    known = np.tile(1e-4 * np.eye(9), (n, 1, 1))
    odometry = Odometry(
        t, *np.zeros((2, n, 3)), np.zeros((n, 4)), *np.zeros((2, n, 3)), known, known
    )
    assert np.ravel(lost_spans(t, odometry)) == pytest.approx(np.ravel(lost), abs=0.02)


@pytest.mark.parametrize("stream", ["tdoa", "range"])
def test_silence_is_where_the_tag_was_lost(flight, ranged, stream):
    recording = flight if stream == "tdoa" else ranged
    heard = getattr(recording, stream)
    begin, end = heard.t[0] + 6.0, heard.t[0] + 10.0
    kept = rows_of(heard, (heard.t < begin) | (heard.t > end))
    found = assessed(replace(recording, imu=None, **{stream: kept}))
    assert found.level != GOOD and "the tag was lost for" in " ".join(found.reasons)
    assert found.lost[0][0] == pytest.approx(begin, abs=2.1)
    assert found.lost[-1][1] == pytest.approx(end, abs=1.0)
    assert any("inertial" in sentence for sentence in found.remedies)


@pytest.mark.slow
def test_an_error_of_check_is_bad_with_a_remedy_and_exit_code_1(flight, tmp_path, capsys):
    wrong = replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d))
    found = assessed(wrong)
    assert found.level == BAD and "sign" in " ".join(found.reasons) and found.remedies
    write_bag(wrong, tmp_path / "flight.bag")
    run([tmp_path / "flight.bag", "--out", tmp_path / "out"], 1)
    assert "flight: bad: " in capsys.readouterr().out


def test_residuals_of_a_pair_are_of_one_sign_of_it():
    n = 4
    some = Residuals(
        np.arange(n),
        np.array([1, 2, 1, 3]),
        np.array([2, 1, 2, 1]),
        np.array([0.1, -0.2, 5.0, 0.3]),
        np.full(n, 0.01),
        np.ones(n),
        np.array([USED, USED, REJECTED, USED], np.uint8),
    )
    first, second = pictures.by_pair(some)
    assert (first.a, first.b, second.a, second.b) == (1, 2, 1, 3)
    np.testing.assert_allclose(first.value, [0.1, 0.2, 5.0])
    np.testing.assert_allclose(second.value, [-0.3])
    assert first.explained.tolist() == [True, True, False]


# --- the command ---


def test_names_of_files_are_those_of_recordings_and_must_differ():
    assert [name_of(path) for path in ("a/const1-tdoa2.csv.gz", "b/flight_bag", "0425-traj1")] == [
        "const1-tdoa2",
        "flight",
        "0425-traj1",
    ]
    with pytest.raises(InputError, match="b/x.csv: a/x.bag has the same name"):
        check_names([("a/x.bag", None), ("b/x.csv", None)])


def test_a_recording_without_an_estimate_has_files_and_a_picture_too(flight, tmp_path, capsys):
    write_bag(replace(flight, tdoa=rows_of(flight.tdoa, slice(5))), tmp_path / "flight.bag")
    run(
        [
            tmp_path / "flight.bag",
            "--out",
            tmp_path / "out",
            "--bag",
            "--residuals",
            "--json",
            tmp_path / "all.json",
        ],
        1,
    )
    (found,) = json.loads((tmp_path / "all.json").read_text())["flights"]
    assert found["verdict"] == "bad" and found["estimates"] == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(
        path.rpartition("/")[2] for path in found["files"]
    )
    assert "flight: bad: there is no estimate" in capsys.readouterr().out


# --- who is heard where ---


def walked(n=600):
    """Return (Odometry, Residuals) of a tag that moves from x = 0 to 40 m.

    Anchor k is received from 10 k to 10 k + 20 m. The last TDOAs are rejected.
    """
    t = 0.1 * np.arange(n)
    p = np.column_stack([40.0 * t / t[-1], np.full(n, 2.0), np.ones(n)])
    covariance = np.broadcast_to(0.01 * np.eye(9), (n, 9, 9))
    nothing = np.zeros((n, 3))
    odometry = Odometry(
        t,
        p,
        nothing,
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        nothing,
        nothing,
        covariance,
        covariance[:, :3, :3],
    )
    first = np.clip(p[:, 0] // 10.0, 1, 4).astype(int)
    verdict = np.where(p[:, 0] > 35.0, REJECTED, USED).astype(np.uint8)
    return odometry, Residuals(
        t, first, first - 1, np.full(n, 0.05), np.full(n, 0.01), np.ones(n), verdict
    )


def test_zones_say_who_is_heard_where_and_how_well():
    found = pictures.zones_of(*walked(), 10.0)
    assert [(zone.x, zone.y) for zone in found[:4]] == [
        (5.0, 5.0),
        (15.0, 5.0),
        (25.0, 5.0),
        (35.0, 5.0),
    ]
    assert [dict(zone.anchors).keys() for zone in found[1:3]] == [{0, 1}, {1, 2}]
    for zone in found[:3]:
        assert (
            zone.heard == 2.0
            and zone.used == 1.0
            and zone.left == pytest.approx(1.4826 * 0.05)
            and zone.std == pytest.approx(np.sqrt(0.03))
        )
        assert zone.seconds == pytest.approx(15.0, abs=0.2) and zone.tdoas_per_s == pytest.approx(
            10.0, rel=0.05
        )
    assert found[3].used == pytest.approx(0.5, abs=0.05)
    assert (
        pictures.zones_of(
            *(part for part in (walked()[0], Residuals(*(np.empty(0) for _ in range(7))))), 10.0
        )
        == []
    )


@pytest.mark.slow
def test_zones_are_written_as_a_table_and_a_map(bags, tmp_path, capsys):
    run([bags / "none" / "flight.bag", "--zones", "2", "--out", tmp_path])
    lines = (tmp_path / "flight_zones.csv").read_text().splitlines()
    assert (
        lines[0] == ",".join(pictures.ZONE_COLUMNS)
        and len(lines) > 3
        and all(len(line.split(",")) == len(pictures.ZONE_COLUMNS) for line in lines)
    )
    assert (tmp_path / "flight_zones.png").stat().st_size > 10_000
    run([bags / "none" / "flight.bag", "--zones", "0", "--out", tmp_path], 2)
    assert "--zones: '0' is not a number above 0" in capsys.readouterr().err
