"""Recordings of others, read by the shipped profiles and by others: to a trajectory with one command each."""

import dataclasses

from foreign_recordings import (
    BEGIN,
    cf_msgs,
    dwm1001_arrays,
    dwm1001_topics,
    isas,
    linktrack,
    px4_bag,
    tdoa_arrays,
    two_way_ranges,
    write_ros_1,
    write_ros_2,
    write_starloc,
    write_ulog,
)
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
import yaml

from uwb_tdoa_tools.commands.check import main as check
from uwb_tdoa_tools.commands.convert import main as convert
from uwb_tdoa_tools.commands.localize import main as localize
from uwb_tdoa_tools.readers import load_profile, read_flight
from uwb_tdoa_tools.readers.profile import shipped
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
FLOAT32 = 1e-6  # relative


@pytest.fixture(scope="session")
def flight():
    """A simulated flight with ranges and TDOAs, whose stamps a us holds."""
    config = SimulationConfig(
        duration=18.0,
        imu_rate=100.0,
        truth_rate=50.0,
        range_noise=0.05,
        bias=False,
        multipath=False,
        outlier_probability=0.0,
        yaw="rotating",
        seed=4,
    )
    made = simulate(config)
    rounded = {
        name: dataclasses.replace(getattr(made, name), t=np.round(getattr(made, name).t, 6))
        for name in ("tdoa", "range", "imu", "truth")
    }
    return dataclasses.replace(made, **rounded)


def ulog(path, flight):
    pytest.importorskip("pyulog")
    return write_ulog(path, flight)


# {kind: (profile, options, write(path, flight), streams that come back)}
KINDS = {
    "util": ("util", [], lambda p, f: write_ros_1(p, cf_msgs(f)), "tdoa imu truth"),
    "util, bz2": (
        "util",
        [],
        lambda p, f: write_ros_1(p, cf_msgs(f), Ros1Writer.CompressionFormat.BZ2),
        "tdoa imu truth",
    ),
    "linktrack node 2": (
        "linktrack",
        [],
        lambda p, f: write_ros_1(p, linktrack(f, "nodeframe2")),
        "range",
    ),
    "linktrack node 3": (
        "linktrack",
        [],
        lambda p, f: write_ros_2(p, linktrack(f, "nodeframe3"), MCAP),
        "range",
    ),
    "linktrack tag": (
        "linktrack",
        [],
        lambda p, f: write_ros_2(p, linktrack(f, "tagframe0"), SQLITE),
        "range",
    ),
    "dwm1001 topics": (
        "dwm1001",
        [],
        lambda p, f: write_ros_1(p, dwm1001_topics(f)),
        "range anchors",
    ),
    "dwm1001 arrays": (
        "dwm1001",
        [],
        lambda p, f: write_ros_2(p, dwm1001_arrays(f), MCAP),
        "range anchors",
    ),
    "uwb_msgs ranges": ("uwb_msgs", [], lambda p, f: write_ros_1(p, two_way_ranges(f)), "range"),
    "uwb_msgs tdoas": ("uwb_msgs", [], lambda p, f: write_ros_1(p, tdoa_arrays(f)), "tdoa"),
    "px4 bag": ("px4", [], lambda p, f: write_ros_2(p, px4_bag(f), MCAP), "range imu truth"),
    "px4 ulog": ("px4", [], ulog, "range imu truth"),
    "isas": ("isas", [], lambda p, f: write_ros_1(p, isas(f)), "range imu truth anchors"),
    "starloc": ("starloc", ["--tag", "1"], write_starloc, "range imu"),
}


@pytest.fixture(scope="session", params=KINDS)
def recording(request, flight, tmp_path_factory):
    """(path, words of a command line that read it, streams that it has)."""
    profile, more, write, streams = KINDS[request.param]
    folder = tmp_path_factory.mktemp("foreign")
    path = write(folder / "recording", flight)
    words = [str(path), "--profile", profile, *more]
    if "anchors" not in streams:
        survey = folder / "survey.csv"
        rows = [
            f"{k},{x},{y},{z}" for k, (x, y, z) in zip(flight.anchors.ids, flight.anchors.positions)
        ]
        survey.write_text("\n".join(["id,x,y,z", *rows]))
        words += ["--survey", str(survey)]
    return path, words, streams.split()


def same(one, other, streams, start):
    """Compare streams, whose stamps are `start` later in `other`."""
    for name in streams:
        if name == "anchors":
            np.testing.assert_allclose(
                np.sort(other.anchors.positions, axis=0), np.sort(one.anchors.positions, axis=0)
            )
            continue
        first, second = getattr(one, name), getattr(other, name)
        for column, values in vars(first).items():
            theirs = np.asarray(getattr(second, column))
            if column == "t":
                theirs = theirs - start
            if column == "q":
                theirs = theirs * np.sign((theirs * values).sum(axis=1, keepdims=True))
            if column == "variance" or (column == "q" and np.isnan(theirs).all()):
                continue
            np.testing.assert_allclose(
                theirs, values, rtol=2e-6, atol=3e-6, err_msg=f"{name} {column}"
            )


def test_the_streams_of_a_recording_come_back(recording, flight, tmp_path, capsys):
    path, words, streams = recording
    code = convert([*words, "--out", str(tmp_path / "our.bag")])
    assert code == 0, capsys.readouterr().err
    told = capsys.readouterr().out
    assert "read: " in told
    ours = read_flight(tmp_path / "our.bag")
    grouped = (
        any(name in str(words) for name in ("linktrack", "dwm1001", "isas")) and "range" in streams
    )
    if grouped:  # several ranges have one stamp
        n = len(flight.range)
        assert n * 0.9 < len(ours.range) <= n
        streams = [name for name in streams if name != "range"]
    same(flight, ours, streams, BEGIN / 1e9 if ours.start > 1e9 else 0.0)


def test_a_recording_becomes_a_trajectory_with_one_command(recording, flight, tmp_path, capsys):
    path, words, _ = recording
    assert localize([*words, "--out", str(tmp_path / "out")]) in (0, 1)
    (table,) = [file for file in (tmp_path / "out").rglob("*.tum")]
    rows = np.loadtxt(table)
    t = rows[:, 0] - (BEGIN / 1e9 if rows[0, 0] > 1e9 else 0.0)
    late = t > 4.0
    truth = np.array([np.interp(t[late], flight.truth.t, column) for column in flight.truth.p.T]).T
    assert np.median(np.linalg.norm(rows[late, 1:4] - truth, axis=1)) < 0.3


def test_the_message_without_a_profile_names_the_command(recording, capsys):
    path, words, _ = recording
    survey = words[words.index("--survey") :] if "--survey" in words else []
    assert check([str(path), *survey]) == 2
    said = capsys.readouterr().err
    assert "--suggest" in said or "--profile" in said


def test_suggest_finds_the_profile_or_writes_one(recording, flight, tmp_path, capsys):
    path, words, streams = recording
    out = tmp_path / "profile.yaml"
    assert convert([str(path), "--suggest", str(out)]) == 0
    assert f"--profile {words[2]}" in capsys.readouterr().out
    text = out.read_text()
    assert words[2] in text
    if "tdoa" in streams or "range" in streams:
        columns = [source["columns"] for source in yaml.safe_load(text)["sources"] or []]
        known = {name for each in columns for name in each}
        if not any(name in str(words) for name in ("topics", "tagframe0", "TDOARanges", "tdoas")):
            assert known & {"tdoa", "range"} or "Missing: TDOAs or ranges" in text


def test_every_shipped_profile_is_tested_and_loads():
    assert {profile for profile, *_ in KINDS.values()} == {*shipped()}
    for name in shipped():
        assert load_profile(name).about
