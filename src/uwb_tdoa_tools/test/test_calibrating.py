# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""calibrate: from recordings to a calibrated tag."""

from dataclasses import replace
import json
import os
from pathlib import Path
import re
from types import SimpleNamespace

import numpy as np
import pytest
from test_bag_frames import ODOMETRY, bag_of

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Imu, Tdoas, Truth
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_tools import calibrating as library, options
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.calibrating import (
    Calibration,
    Forecast,
    Prospect,
    between,
    prospect,
    without_truth,
)
from uwb_tdoa_tools.checking.check import Report
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.command_lines import evaluate_line, lines_of_use
from uwb_tdoa_tools.commands import calibrate, check as check_command, diagnose, survey
from uwb_tdoa_tools.diagnosis.noise import has_imu, write_parameters
from uwb_tdoa_tools.diagnosis.references import Nothing
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.scoring.evaluation import score_of
from uwb_tdoa_tools.scoring.metrics import NO_DIFFERENCE
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

CLEAN = dict(
    duration=45.0,
    floor_time=1.0,
    imu_rate=100.0,
    tdoa_rate=200.0,
    bias=False,
    multipath=False,
    outlier_probability=0.0,
)


def shaken_flight(seed):
    """Return a flight with survey errors. The errors are the same in each flight."""
    flight = simulate(SimulationConfig(seed=seed, trajectory="sines", **CLEAN))
    off = 0.1 * np.random.default_rng(5).standard_normal(flight.anchors.positions.shape)
    return replace(
        flight, name=f"flight{seed}", anchors=flight.anchors.at(flight.anchors.positions + off)
    )


def beginning(flight, seconds):
    """Return the first seconds of a Flight."""
    return between(flight, flight.tdoa.t[0], flight.tdoa.t[0] + seconds)


@pytest.fixture(scope="module")
def flights():
    return [shaken_flight(seed) for seed in (1, 2, 3)]


# --- without ground truth ---


@pytest.mark.slow
def test_without_ground_truth_other_flights_get_better_and_none_is_read(flights):
    one, two, other = flights
    wrong = [
        replace(flight, truth=replace(flight.truth, p=flight.truth.p + np.nan))
        for flight in (one, two)
    ]
    made = without_truth(wrong[:1], wrong[1:])
    assert made.why_not is None and made.after < 0.8 * made.before and made.judged_on == "flight2"
    before = score_of(other, FlightEstimator())[0].row()["rmse_3d"]
    after = score_of(replace(other, anchors=made.anchors), FlightEstimator(None, made.effects))[
        0
    ].row()["rmse_3d"]
    assert after < 0.8 * before


@pytest.mark.slow
def test_ranges_of_another_tag_judge():
    """The hold-out flight has another tag with another delay.

    The filter estimates this delay. The anchors are correct, so no calibration is needed.
    """
    flown = dict(CLEAN, range_noise=0.1)
    ranged = [
        simulate(SimulationConfig(seed=seed, trajectory=path, **flown))
        for seed, path in ((500, "sines"), (501, "circle"))
    ]
    ranged = [
        without_offset(replace(flight, truth=None, tdoa=Tdoas(*np.empty((4, 0)))), -delay)
        for flight, delay in zip(ranged, (0.25, 0.4))
    ]
    made = without_truth(ranged[:1], ranged[1:])
    assert max(made.before, made.after) < 0.05 and made.why_not is not None


@pytest.mark.slow
def test_a_single_flight_is_judged_on_its_end(flights):
    made = without_truth([replace(flights[0], truth=None)], [])
    assert made.judged_on == "the last third of flight1" and made.after < made.before


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        (
            0.2,
            0.1,
            (
                "10.0 cm of the innovations are slow with it on flight3, more than 5.5 cm: "
                "something else is wrong too"
            ),
        ),
        # The report describes a difference within the noise in the same way in both directions.
        (0.05, 0.04, f"it makes {NO_DIFFERENCE}: 3D RMSE 5.0 -> 4.0 cm"),
        (0.04, 0.05, f"it makes {NO_DIFFERENCE}: 3D RMSE 4.0 -> 5.0 cm"),
        (0.02, 0.05, "it makes things worse: 3D RMSE 2.0 -> 5.0 cm"),
        (0.055, 0.02, None),
        (0.08, 0.05, None),  # anchors measured by tape to 5 cm
    ],
)
def test_innovations_alone_must_speak_clearly(before, after, why):
    against = library._reason_against_unverified(before, after, False, GOOD.judged_on)
    blind = replace(GOOD, before=before, after=after, measure="slow innovations", why_not=against)
    told = library._validated(blind, True).why_not
    assert told is why if why is None else why.replace(GOOD.measure, blind.measure) in told


@pytest.mark.parametrize(("before", "after", "kept"), [(0.12, 0.064, True), (0.08, 0.07, False)])
def test_ranges_may_leave_more_if_much_less_is_slow(before, after, kept):
    of_ranges, of_tdoas = (
        library._reason_against_unverified(before, after, alone, "flight3")
        for alone in (True, False)
    )
    assert (of_ranges is None) == kept and "more than 5.5 cm" in of_tdoas


@pytest.mark.parametrize(
    ("after", "interval", "why"),
    [
        (0.199, (-0.02, 0.03), f"it makes {NO_DIFFERENCE}: 3D RMSE 20.0 -> 19.9 cm"),
        (0.201, (-0.03, 0.02), f"it makes {NO_DIFFERENCE}: 3D RMSE 20.0 -> 20.1 cm"),
        (0.25, (-0.4, -0.1), "it makes things worse: 3D RMSE 20.0 -> 25.0 cm"),
        (0.15, (0.1, 0.4), None),
    ],
)
def test_a_gain_within_the_noise_writes_nothing_in_either_direction(after, interval, why):
    told = library._validated(replace(GOOD, after=after, interval=interval), True).why_not
    assert told is None if why is None else told.startswith(why)


@pytest.mark.parametrize(
    ("better", "path", "sentence"),
    [
        (True, (5.0, 5.0, 2.0), "the flights are exciting enough"),
        (
            True,
            (5.0, 5.0, 0.2),
            (
                "the flights determine most coordinates; for the others move farther along z, "
                "where the tag moves by 0.2 m among anchors that are 3.0 m apart"
            ),
        ),
        (
            False,
            (5.0, 5.0, 2.0),
            (
                "the flights are not exciting enough: move closer to anchors 0 and 1, on all "
                "sides, high and low"
            ),
        ),
    ],
)
def test_one_sentence_alone_judges_the_motion(better, path, sentence):
    given = np.full((2, 3), 0.1)
    expected = given * (0.1 if better else 1.0)
    size, hall = np.array(path), np.array([6.0, 6.0, 3.0])
    told = Prospect(60.0, 60.0, given, expected, 0.1, 0.05, size, hall, "xyz", (0, 1), None)
    *others, last = told.sentences()
    assert last == sentence
    assert not any(word in " ".join(others) for word in ("enough", "farther", "closer", "fly more"))


@pytest.mark.slow
def test_with_ground_truth_quick_forecasts_what_a_diagnosis_gains(flights):
    """Forecast from one flight and from two, within seconds.

    The gain is measured on hold-out flights.
    """
    *fitted, other = flights
    alone, several = library.forecast(fitted[:1]), library.forecast(fitted)
    assert (alone.flights, several.flights) == (1, 2)
    before = score_of(other, FlightEstimator())[0].row()["rmse_3d"]
    for told in (alone, several):
        assert told.before == pytest.approx(before, rel=0.3) and told.after < 0.5 * told.before
        assert told.interval[0] > 0.0
        assert told.sentences()[-1] == "a calibration with --out is likely to gain about as much"
    assert "positions and delays of all anchors" in alone.sentences()[1]


@pytest.mark.parametrize(
    ("after", "interval", "last"),
    [
        (0.199, (-0.02, 0.03), f"that is {NO_DIFFERENCE}"),
        (0.201, (-0.03, 0.02), f"that is {NO_DIFFERENCE}"),
        (0.25, (-0.4, -0.1), "positions and delays of anchors do not describe these flights"),
    ],
)
def test_a_forecast_without_a_gain_says_so(after, interval, last):
    told = Forecast(60.0, 1, 0.2, after, interval).sentences()
    assert told[-1].startswith(last)


@pytest.mark.slow
def test_quick_says_what_is_to_be_expected(flights):
    told = prospect([replace(flight, truth=None) for flight in flights])
    assert told.exciting and told.left < told.before and told.better.mean() > 0.5
    assert np.median(told.expected) < 0.7 * np.median(told.given)
    sentences = told.sentences()
    assert (
        f"all flights are likely to improve {told.better.sum()} of 24 coordinates" in sentences[1]
    )
    assert sentences[-1] == "the flights are exciting enough"


# --- the command ---


@pytest.fixture(scope="module")
def bags(flights, tmp_path_factory):
    """Write the beginnings of flights as bags and return their folder."""
    folder = tmp_path_factory.mktemp("bags")
    begun = [beginning(flight, 5.0) for flight in flights]
    for flight in begun:
        write_bag(flight, folder / f"{flight.name}.bag")
    write_bag(replace(begun[0], truth=None, name="blind"), folder / "blind.bag")
    return folder


@pytest.fixture
def room(bags, tmp_path, monkeypatch):
    """Return a working directory with flights as bags."""
    monkeypatch.chdir(tmp_path)
    for bag in bags.iterdir():
        (tmp_path / bag.name).symlink_to(bag)
    return tmp_path


GOOD = Calibration(
    Anchors([0, 1, 2, 3], np.eye(4)[:, :3], np.full((4, 4), np.nan)),
    EffectSet((AnchorDelay({"0": 0.1}),)),
    0.1,
    "3D RMSE",
    0.2,
    0.1,
    "flight3",
    None,
    "found",
)


def stub(monkeypatch, made, seen):
    def instead(flights, holdout, *_):
        seen.append(
            (
                [flight.name for flight in flights],
                [flight.name for flight in holdout],
                [f.truth is not None for f in flights],
            )
        )
        return made

    monkeypatch.setattr(library, "with_truth", instead)
    monkeypatch.setattr(library, "without_truth", instead)
    monkeypatch.setattr(library, "check", lambda recording, *_: Report(recording.name, [], {}))


@pytest.mark.parametrize(
    ("more", "seen"),
    [
        # the last flight is the hold-out flight
        ((), (["flight1", "flight2"], ["flight3"], [True, True])),
        (("--no-truth",), (["flight1", "flight2"], ["flight3"], [False, False])),
        (("--holdout", "flight1.bag"), (["flight2", "flight3"], ["flight1"], [True, True])),
    ],
)
def test_what_judges_takes_no_part(room, monkeypatch, more, seen):
    calls = []
    stub(monkeypatch, GOOD, calls)
    flights = [f"flight{k}.bag" for k in (1, 2, 3) if f"flight{k}.bag" not in more]
    assert calibrate.main([*flights, *more, "--out", "out"]) == 0
    assert calls == [seen]
    assert sorted(path.name for path in (room / "out").iterdir()) == [
        "anchors.yaml",
        "calibration.json",
        "effects.yaml",
        "ekf_node.yaml",
    ]


@pytest.mark.parametrize("more", [(), ("--no-truth",)])
@pytest.mark.parametrize("jobs", [1, 2])
def test_jobs_are_processes(room, monkeypatch, jobs, more):
    stub(monkeypatch, GOOD, [])
    processes = set()

    def instead(*given):
        processes.update(given[-1](lambda _: os.getpid(), range(4)))
        return GOOD

    for name in ("with_truth", "without_truth"):
        monkeypatch.setattr(library, name, instead)
    given = ["flight1.bag", "flight2.bag", *more, "--jobs", str(jobs), "--out", "out"]
    assert calibrate.main(given) == 0
    assert os.getpid() in processes and (len(processes) == 1) == (jobs == 1)


def test_what_is_not_to_be_used_is_not_written(room, monkeypatch, capsys):
    stub(monkeypatch, replace(GOOD, why_not="it makes things worse"), [])
    assert calibrate.main(["flight1.bag", "--out", "out"]) == 1
    assert [path.name for path in (room / "out").iterdir()] == ["calibration.json"]
    assert json.loads((room / "out" / "calibration.json").read_text())["offered"] is False
    printed = capsys.readouterr()
    assert (
        "calibrate: stopped, and nothing to use is written: it makes things worse." in printed.err
    )
    assert "wrote calibration.json, the figures of this, to out" in printed.out
    assert re.search(
        r"^next: add flights.*\n.*diagnose flight1.bag --out diagnosis/$", printed.out, re.M
    )
    assert calibrate.main(["flight1.bag", "--no-truth", "--out", "out"]) == 1
    said = capsys.readouterr().out
    (line,) = re.findall(r"^next: .*marks.yaml.*\n(.*)$", said, re.M)
    words = line.partition(" survey ")[2].split()
    assert survey.parser().parse_args(words).marks == "marks.yaml"


def test_different_surveys_of_one_installation_are_named(room, flights, monkeypatch, capsys):
    stub(monkeypatch, GOOD, [])
    Path("surveys").mkdir()
    for name, shift in (("one", 0.0), ("two", 0.01)):
        moved = flights[0].anchors.at(flights[0].anchors.positions + [0.0, 0.0, shift])
        moved.to_yaml(Path("surveys") / f"anchor_{name}.yaml")
        write_bag(replace(beginning(flights[0], 5.0), anchors=moved), f"{name}.bag")
    given = ["one.bag", "two.bag", "--out", "out", "--survey"]
    assert calibrate.main([*given, "surveys"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "one: surveys/anchor_one.yaml; two: surveys/anchor_two.yaml), in which the same ids" in said
    )
    assert "up to 1.0 cm apart" in said and "for the nodes is for surveys/anchor_one.yaml" in said
    assert calibrate.main([*given, "surveys/anchor_one.yaml"]) == 0
    assert "different surveys" not in capsys.readouterr().err


@pytest.mark.slow
def test_it_stops_where_check_finds_an_error(room, flights, monkeypatch, capsys):
    for name in ("with_truth", "without_truth"):
        monkeypatch.setattr(library, name, lambda *_: pytest.fail("it went on"))
    flight = beginning(flights[0], 40.0)
    wrong = replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d))
    write_bag(wrong, "wrong.bag")
    assert calibrate.main(["wrong.bag", "--out", "out"]) == 1
    printed = capsys.readouterr()
    assert (
        "wrong: check finds an error: the sign of all TDOAs is wrong (tdoa_sign): it is left out; "
        "put that right, or use it as it is with --keep."
    ) in printed.err
    assert "no flight is left to calibrate with" in printed.err and not (room / "out").exists()


def faulty(monkeypatch, *names):
    """Make `check` report an error for the flights with these names."""
    error = Finding("tdoa_sign", ERROR, "the sign of all TDOAs is wrong", "seen", "turn it", 0.0)
    monkeypatch.setattr(
        library,
        "check",
        lambda recording, *_: Report(
            recording.name, [error] if recording.name in names else [], {}
        ),
    )


@pytest.mark.parametrize(
    ("bad", "more", "seen"),
    [
        (("flight2",), (), (["flight1"], ["flight3"])),
        (("flight3",), (), (["flight1"], ["flight2"])),
        (("flight3",), ("--holdout", "flight3.bag"), (["flight1"], ["flight2"])),
        (("flight2",), ("--keep",), (["flight1", "flight2"], ["flight3"])),
    ],
)
def test_a_bad_flight_is_left_out_by_name_and_rule(room, monkeypatch, capsys, bad, more, seen):
    calls = []
    stub(monkeypatch, GOOD, calls)
    faulty(monkeypatch, *bad)
    flights = [f"flight{k}.bag" for k in (1, 2, 3) if f"flight{k}.bag" not in more]
    assert calibrate.main([*flights, *more, "--out", "out"]) == 0
    assert calls[0][:2] == seen
    told = capsys.readouterr().err
    assert f"{bad[0]}: check finds an error: the sign of all TDOAs is wrong (tdoa_sign)" in told
    assert ("--keep asks for" if "--keep" in more else "it is left out") in told


@pytest.mark.parametrize("more", [(), ("--no-truth",)])
def test_quick_answers_of_one_flight_and_ends_with_0(room, monkeypatch, capsys, more):
    told = SimpleNamespace(sentences=lambda: ["so it is"])
    for name in ("prospect", "forecast"):
        monkeypatch.setattr(library, name, lambda *_: told)
    monkeypatch.setattr(library, "prospect" if not more else "forecast", None)
    monkeypatch.setattr(library, "check", lambda recording, *_: Report(recording.name, [], {}))
    assert calibrate.main(["flight1.bag", *more, "--quick"]) == 0
    assert "so it is" in capsys.readouterr().out


@pytest.mark.parametrize(
    "parser", [calibrate.parser, diagnose.parser, survey.parser, check_command.parser]
)
def test_a_sensor_that_is_switched_off_is_off_in_every_command(parser):
    args = parser().parse_args(
        [
            "a.bag",
            "--without",
            "height",
            *["--out", "o"][: 2 * (parser is not check_command.parser)],
        ]
    )
    config, _ = options.filter_of(args)
    assert config == replace(FilterConfig(), use_height=False)


@pytest.mark.parametrize("std", [None, 0.07])
def test_a_sensor_that_is_switched_off_stays_off_in_what_is_written_and_printed(tmp_path, std):
    config = FilterConfig(use_height=False)
    file = write_parameters(tmp_path / "ekf_node.yaml", std, config)
    expected = config if std is None else replace(config, tdoa_std=std)
    assert FilterConfig.from_yaml(file) == expected
    lines = [line for line, _ in lines_of_use(tmp_path, ["other.bag"])]
    assert f"--config {file}" in lines[0] and f"--params-file {file}" in lines[2]


def test_parameters_that_are_all_defaults_are_a_file_too(tmp_path):
    """The printed command names it, and other files of the folder may be of another day."""
    file = tmp_path / "ekf_node.yaml"
    file.write_text("of another day")
    assert write_parameters(file, None) == file
    assert FilterConfig.from_yaml(file) == FilterConfig()
    assert "# m; the default" in file.read_text()


def test_without_inertial_samples_the_nodes_are_told_so(tmp_path):
    inertial = Imu(np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3)))
    some, none = (SimpleNamespace(imu=imu) for imu in (inertial, None))
    assert has_imu([none, some]) and not has_imu([none, none])
    file = write_parameters(tmp_path / "ekf_node.yaml", None, FilterConfig(), has_imu([none]))
    assert FilterConfig.from_yaml(file) == replace(FilterConfig(), use_imu=False)
    assert "use_imu: false  # no recording has inertial samples" in file.read_text()


def test_the_line_that_judges_reads_as_the_command_did():
    words = ["a.bag", "--namespace", "tag1", "--topic", "uwb/tdoa=/my/tdoa", "--salvage"]
    args = calibrate.parser().parse_args([*words, "--quick"])
    line = evaluate_line(["a.bag"], more=options.words_of_reading(args))
    assert line.endswith("evaluate a.bag --namespace tag1 --topic uwb/tdoa=/my/tdoa --salvage")


def test_a_tape_that_is_off_does_not_stop_it_and_another_room_does(flights):
    flight, findings = flights[0], [Finding(library.MISFIT, ERROR, "", "", "", 0.0)]
    assert library.blocking_errors(of_flight(flight), findings, 0.1) == []
    far = flight.anchors.at(
        flight.anchors.positions
        + np.random.default_rng(6).standard_normal(flight.anchors.positions.shape)
    )
    assert (
        library.blocking_errors(of_flight(replace(flight, anchors=far)), findings, 0.1) == findings
    )
    other = Finding("tdoa_sign", ERROR, "", "", "", 0.0)
    assert library.blocking_errors(of_flight(flight), [other, *findings], 0.1) == [other]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["flight1.bag"], "--out: is missing"),
        (["flight1.bag", "--holdout", "flight1.bag", "--out", "out"], "is also a FLIGHT to fit"),
        (
            ["flight1.bag", "--std", "0.1", "--out", "out"],
            "--std: says how well anchors are known, and ground truth is there to tell",
        ),
        (
            ["flight1.bag", "blind.bag", "--out", "out"],
            "blind: holds no ground truth, and others do",
        ),
    ],
)
def test_bad_usage_is_one_sentence(room, monkeypatch, capsys, words, sentence):
    stub(monkeypatch, GOOD, [])
    assert calibrate.main(words) == 2
    assert sentence in capsys.readouterr().err


# --- a vehicle that never leaves the floor ---


@pytest.mark.slow
def test_a_rover_with_odometry_of_its_wheels_is_calibrated(tmp_path):
    flight = simulate(SimulationConfig.of("rover", seed=3, duration=36.0, wheel_scale=0.03))
    path = bag_of(flight, tmp_path, ("/velocity/odometry", ODOMETRY, flight.velocity))
    out = tmp_path / "calibrated"
    words = [str(path), "-p", "planar:=true", "-p", "fixed_height:=0.0", "--out", str(out)]
    assert calibrate.main(words) == 0
    found = {one.name: one for one in EffectSet.from_yaml(out / "effects.yaml").effects}
    for name in ("velocity_scale", "yaw_rate_scale"):
        assert abs(found[name].values["scale"] - 0.03) < 3.0 * found[name].std["scale"]
    # the nodes start with this configuration in the printed lines
    config = FilterConfig.from_yaml(out / "ekf_node.yaml")
    assert config.planar and config.fixed_height == 0.0
    told = json.loads((out / "calibration.json").read_text())
    assert told["offered"] and told["after"] < 0.8 * told["before"]


@pytest.mark.parametrize(
    ("height", "planar", "on_floor"),
    [(0.0, False, True), (1.0, False, False), (1.0, True, True), (0.15, False, True)],
)
def test_a_height_that_is_estimated_above_the_floor_now_and_then_is_no_flight(
    height, planar, on_floor
):
    t = np.linspace(0.0, 60.0, 3001)
    along = np.clip(t - 5.0, 0.0, 50.0)
    z = height * (along > 0.0) * (along < 50.0) + 0.1 * np.sin(7.0 * t) + 0.1 * np.cos(3.0 * t)
    poses = Truth(t, np.column_stack([0.2 * along, np.zeros(len(t)), z]), None)
    reference = Nothing(FilterConfig(planar=planar))
    assert reference.on_floor(poses) == on_floor
    flight = simulate(SimulationConfig.of("rover", duration=12.0))
    first, last = reference.span(flight, poses)
    assert 5.0 < first < 8.0 and 52.0 < last < 56.0
