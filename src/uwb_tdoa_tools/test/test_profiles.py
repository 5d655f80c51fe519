# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of others, read by shipped and by other profiles.

Each becomes a trajectory with one command.
"""

import bz2
import dataclasses
import sqlite3

from documented import blocks, section
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
from hypothesis import HealthCheck, given, settings, strategies as st
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
import uwb_tdoa
import yaml

from uwb_tdoa_bias.common.errors import InputError, TooMuch, most_unpacked
from uwb_tdoa_bias.common.survey import NamedAnchors, read_named_anchors
from uwb_tdoa_tools.checking.check import check as judged
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.commands.check import main as check
from uwb_tdoa_tools.commands.convert import main as convert
from uwb_tdoa_tools.commands.localize import main as localize
from uwb_tdoa_tools.readers import load_profile, read_by_profile, read_flight
from uwb_tdoa_tools.readers.profile import shipped
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
FLOAT32 = 1e-6  # relative


@pytest.fixture(scope="session")
def flight():
    """Return a simulated flight with ranges and TDOAs. Stamps are multiples of 1 us."""
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
    return write_ulog(path, flight)


# {kind: (profile, options, write(path, flight), streams that it contains)}
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
    """Return (path, words of a command line that reads it, streams that it contains)."""
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
    """Compare streams. Stamps of `other` are later by `start`, s."""
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
    assert "  read " in told and " records of " in told
    ours = read_flight(tmp_path / "our.bag")
    grouped = (
        any(name in str(words) for name in ("linktrack", "dwm1001", "isas")) and "range" in streams
    )
    if grouped:  # several ranges have one stamp
        n = len(flight.range)
        assert n * 0.9 < len(ours.range) <= n
        streams = [name for name in streams if name != "range"]
    same(flight, ours, streams, BEGIN / 1e9 if ours.start > 1e9 else 0.0)


@pytest.mark.slow
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


# One topic, with our own profiles.


@pytest.fixture
def survey(flight):
    return NamedAnchors(flight.anchors)


def profile_of(folder, *sources, **more):
    """Return the Profile of a YAML file with these sources."""
    path = folder / "own.yaml"
    path.write_text(yaml.safe_dump({"sources": list(sources), **more}))
    return load_profile(path)


TWR = {"anchor": "UWB_ID2", "range": "range_raw"}


@pytest.fixture
def twr(flight, tmp_path):
    return write_ros_1(tmp_path / "twr.bag", two_way_ranges(flight))


def test_units_signs_and_conditions(twr, flight, survey, tmp_path):
    source = {
        "type": "*/TwoWayRangeStamped",
        "where": {"UWB_ID2": [0, 3], "range_raw": "> 2.5"},
        "columns": {"anchor": "UWB_ID2", "range": "-range_raw:cm"},
    }
    read = read_by_profile([twr], profile_of(tmp_path, source), survey)
    kept = np.isin(flight.range.anchor, [0, 3]) & (flight.range.d.astype(np.float32) > 2.5)
    np.testing.assert_allclose(read.range.d, -0.01 * flight.range.d[kept], rtol=FLOAT32)
    (counted,) = [line for line in read.meta["read"] if "do not meet" in line]
    assert f"{np.count_nonzero(~kept)} records" in counted


def test_a_tag_is_chosen_and_never_merged_with_another(flight, tmp_path):
    bag = write_ros_1(tmp_path / "two.bag", dwm1001_topics(flight, ("7", "8")))
    with pytest.raises(InputError, match=r"several tags: 7 \(\d+ records\), 8 .*--tag 7"):
        read_by_profile([bag], load_profile("dwm1001"))
    with pytest.raises(InputError, match="no record of tag 9; its tags are 7"):
        read_by_profile([bag], load_profile("dwm1001"), tag="9")
    one = read_by_profile([bag], load_profile("dwm1001"), tag="8")
    assert len(one.range) == len(flight.range) and one.name.endswith("tag8")


def test_the_public_module_reads_by_a_profile(twr, flight, tmp_path):
    flight.anchors.to_yaml(tmp_path / "anchors.yaml")
    for survey in (flight.anchors, tmp_path / "anchors.yaml"):
        read = uwb_tdoa.read(twr, survey, profile="uwb_msgs")
        np.testing.assert_allclose(read.range.d, flight.range.d, rtol=FLOAT32)
    with pytest.raises(InputError, match="^tag: "):
        uwb_tdoa.read(twr, tag="7")


def test_topics_of_two_vehicles_are_never_merged(flight, survey, tmp_path):
    def both(store):
        kind, messages = two_way_ranges(flight)(store)["/tag/twr"]
        return {"/one/twr": (kind, messages), "/two/twr": (kind, messages)}

    bag = write_ros_1(tmp_path / "two.bag", both)
    profile = profile_of(tmp_path, {"type": "*/TwoWayRangeStamped", "columns": TWR})
    with pytest.raises(InputError, match="/one/twr and /two/twr fit to one source.*--namespace"):
        read_by_profile([bag], profile, survey)
    read = read_by_profile([bag], profile, survey, namespace="two")
    assert len(read.range) == len(flight.range)


def test_two_ground_truths_are_never_merged(flight, survey, tmp_path):
    def both(store):
        topics = isas(flight)(store)
        return topics | {"/rtls_pose": topics["/vive/transform/tracker_1_ref"]}

    bag = write_ros_1(tmp_path / "two.bag", both)
    pose = {f"pose_{axis}": f"transform.translation.{axis}" for axis in "xyz"}
    profile = profile_of(
        tmp_path,
        {
            "topic": "/rtls_flares",
            "each": "ranges",
            "columns": {"anchor": "ranges.id", "range": "ranges.range"},
        },
        {"topic": "/rtls_pose", "columns": pose},
        {"topic": "/vive/*", "columns": dict(pose)},
    )
    with pytest.raises(InputError, match="both give pose, which is of one sensor"):
        read_by_profile([bag], profile, survey)


def test_what_is_not_read_is_named_with_its_number(flight, tmp_path):
    bag = write_ros_1(tmp_path / "walk.bag", isas(flight))
    source = {
        "topic": "/rtls_flares",
        "each": "ranges",
        "columns": {"anchor": "ranges.id", "range": "ranges.range"},
    }
    read = read_by_profile([bag], profile_of(tmp_path, source), NamedAnchors(flight.anchors))
    assert [line.split(":")[0] for line in read.meta["unread"]] == [
        "/anchor_list",
        "/vive/transform/tracker_1_ref",
        "/waveshare_sense_hat_b",
    ]
    assert (
        f"/waveshare_sense_hat_b: {len(flight.imu)} messages of sensor_msgs/msg/Imu"
        in read.meta["unread"][-1]
    )


def test_stamps_that_are_zero_are_counted_and_replaced(flight, survey, tmp_path):
    def unstamped(store):
        ((topic, (kind, messages)),) = two_way_ranges(flight)(store).items()
        for _, content in messages[::2]:
            content.header.stamp.sec = content.header.stamp.nanosec = 0
        return {topic: (kind, messages)}

    bag = write_ros_1(tmp_path / "zero.bag", unstamped)
    read = read_by_profile(
        [bag], profile_of(tmp_path, {"topic": "/tag/twr", "columns": TWR}), survey
    )
    np.testing.assert_allclose(read.range.t, BEGIN / 1e9 + flight.range.t, atol=1e-6)
    half = (len(flight.range) + 1) // 2
    assert any(f"{half} messages without a stamp" in line for line in read.meta["read"])


@pytest.mark.parametrize("storage", [MCAP, SQLITE])
@pytest.mark.parametrize(
    "mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]
)
def test_compressed_bags_of_foreign_types(flight, survey, tmp_path, storage, mode):
    compression = None if mode == CompressionMode.NONE else (mode, CompressionFormat.ZSTD)
    bag = write_ros_2(tmp_path / "bag", two_way_ranges(flight), storage, compression)
    source = {"topic": "/tag/twr", "columns": TWR}
    for _ in range(2):  # with metadata.yaml and without
        read = read_by_profile([bag], profile_of(tmp_path, source), survey)
        np.testing.assert_allclose(read.range.d, flight.range.d, rtol=FLOAT32)
        (bag / "metadata.yaml").unlink(missing_ok=True)


def test_parts_of_a_bag_of_ros_1_are_one_recording(flight, survey, tmp_path):
    def part(first, last):
        def topics(store):
            ((topic, (kind, messages)),) = two_way_ranges(flight)(store).items()
            return {topic: (kind, messages[first:last])}

        return topics

    (tmp_path / "walk").mkdir()
    for number, (first, last) in enumerate([(0, 100), (100, None)]):
        write_ros_1(tmp_path / "walk" / f"walk_{number}.bag", part(first, last))
    read = read_by_profile([tmp_path / "walk"], load_profile("uwb_msgs"), survey)
    np.testing.assert_allclose(read.range.d, flight.range.d, rtol=FLOAT32)


@pytest.mark.parametrize(("shift", "said"), [(0, "at the same time"), (3600, "s apart")])
def test_several_recordings_in_a_folder_are_never_merged(flight, survey, tmp_path, shift, said):
    def later(store):
        ((topic, (kind, messages)),) = two_way_ranges(flight)(store).items()
        return {topic: (kind, [(stamp + shift * 10**9, content) for stamp, content in messages])}

    (tmp_path / "day").mkdir()
    write_ros_1(tmp_path / "day" / "flight1.bag", two_way_ranges(flight))
    write_ros_1(tmp_path / "day" / "flight2.bag", later)
    with pytest.raises(InputError, match=f"{said}: they are several recordings; give one"):
        read_by_profile([tmp_path / "day"], load_profile("uwb_msgs"), survey)


def test_definitions_come_from_the_profile_where_the_bag_has_none(
    flight, survey, tmp_path, monkeypatch
):
    """Bags of ROS 2 Humble in SQLite have no definitions."""
    bag = write_ros_2(tmp_path / "bag", two_way_ranges(flight), SQLITE)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as connection:
        connection.execute("DELETE FROM message_definitions")
    connection.close()
    source = {"topic": "/tag/twr", "columns": TWR}
    with pytest.raises(
        InputError, match="whose definition is not in the bag; write it into the profile"
    ):
        read_by_profile([bag], profile_of(tmp_path, source), survey)
    read = read_by_profile([bag], load_profile("uwb_msgs"), survey)
    np.testing.assert_allclose(read.range.d, flight.range.d, rtol=FLOAT32)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"columns": {"anchor": "UWB_ID2", "range": "distance"}},
            "has no field 'distance'; its fields are header",
        ),
        ({"each": "ranges"}, "has no field 'ranges'"),
        ({"columns": {"anchor": "header", "range": "range_raw"}}, "has no field 'header'"),
        ({"where": {"LOS2": 1}}, "has no field 'LOS2'"),
        ({"columns": {"anchor": "UWB_ID2", "range": "range_raw..x"}}, "is no field of a message"),
        ({"columns": {"anchor": "UWB_ID2"}}, "range is missing; anchor, range belong together"),
        (
            {"columns": {"anchor": "UWB_ID2", "range": "range_raw:feet"}},
            "'feet' is no unit of range",
        ),
        ({"columns": {"anchor": "UWB_ID2", "distance": "range_raw"}}, "is not OURS=THEIRS"),
        ({"colums": {}}, "'colums' is not one of topic, type"),
        ({"body": "rfu"}, "body: 'rfu' is not one of flu, frd"),
        ({"where": ["LOS"]}, "where is no"),
        ({"topic": 3}, "topic is 3; it must be a text"),
        ({"topic": "*a*b*c*d*e"}, "has more than 4 stars"),
        ({"topic": "/other"}, "takes TDOAs or ranges from; it has /tag/twr"),
    ],
)
def test_a_profile_that_does_not_fit_is_one_sentence(twr, survey, tmp_path, changed, said):
    source = {"topic": "/tag/twr", "columns": TWR, **changed}
    with pytest.raises(InputError, match=said):
        read_by_profile([twr], profile_of(tmp_path, source), survey)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"sources": []}, "no source gives tdoa or range"),
        ({"sources": {}}, "is no profile"),
        ({"sources": [3]}, "source 1: needs columns"),
        ({"sources": [], "antena": 1}, "'antena' is not one of"),
        ({"sources": [{"columns": TWR}], "antenna": [1, 2]}, "antenna must be"),
        ({"sources": [{"columns": TWR}], "types": {"a": 1}}, "types must be"),
    ],
)
def test_a_file_that_is_no_profile_is_one_sentence(tmp_path, content, said):
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=said):
        load_profile(tmp_path / "own.yaml")


def test_an_unknown_profile_lists_the_shipped_ones():
    with pytest.raises(InputError, match="these are dwm1001, isas, linktrack"):
        load_profile("decawave")


def test_the_antenna_of_each_tag(twr, survey, tmp_path):
    source = {"topic": "/tag/twr", "tag": "UWB_ID1", "columns": TWR}
    profile = profile_of(tmp_path, source, antenna={7: [0.1, 0.2, 0.3]})
    assert read_by_profile([twr], profile, survey, tag="7").meta["antenna"] == [0.1, 0.2, 0.3]


def test_records_that_are_no_numbers_are_counted_and_many_are_refused(flight, survey, tmp_path):
    def broken(share):
        def topics(store):
            ((topic, (kind, messages)),) = two_way_ranges(flight)(store).items()
            for _, content in messages[: int(share * len(messages))]:
                content.range_raw = float("nan")
            return {topic: (kind, messages)}

        return topics

    profile = profile_of(tmp_path, {"topic": "/tag/twr", "columns": TWR})
    few = write_ros_1(tmp_path / "few.bag", broken(0.1))
    read = read_by_profile([few], profile, survey)
    assert "message 1: range_raw is 'nan'; it must be a finite number" in read.meta["remarks"][0]
    many = write_ros_1(tmp_path / "many.bag", broken(0.5))
    with pytest.raises(InputError, match="more than a gap"):
        read_by_profile([many], profile, survey)
    assert len(read_by_profile([many], profile, survey, salvage=True).range)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(at=st.floats(0.0, 1.0), byte=st.integers(0, 255), cut=st.booleans())
def test_a_damaged_bag_of_ros_1_is_refused_or_loses_no_message_silently(
    twr, flight, survey, at, byte, cut
):
    content = bytearray(twr.read_bytes())
    place = min(int(at * len(content)), len(content) - 1)
    if cut:
        content = content[:place]
    else:
        content[place] = byte
    damaged = twr.with_name("damaged.bag")
    damaged.write_bytes(bytes(content) or b"#")
    try:
        read = read_by_profile([damaged], load_profile("uwb_msgs"), survey)
    except InputError:
        return
    lost = len(flight.range) - len(read.range)
    assert (
        lost == 0
        or read.meta["remarks"]
        or any("do not meet" in line for line in read.meta["read"])
    )


@pytest.mark.parametrize(("storage", "share"), [(MCAP, 0.99), (SQLITE, 0.8)])
def test_a_cut_bag_of_foreign_types_is_read(flight, survey, tmp_path, storage, share):
    bag = write_ros_2(tmp_path / "bag", two_way_ranges(flight), storage)
    (file,) = [file for file in bag.iterdir() if file.name != "metadata.yaml"]
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    read = read_by_profile([bag], load_profile("uwb_msgs"), survey)
    n = len(read.range)
    assert 0.1 * len(flight.range) < n <= len(flight.range)
    np.testing.assert_allclose(read.range.d, flight.range.d[:n], rtol=FLOAT32)
    assert any("cut or damaged" in remark for remark in read.meta["remarks"])


def test_an_index_that_lacks_messages_is_damage(twr, survey):
    """The last record of the file holds the counts of the chunks."""
    content = twr.read_bytes()
    count = int.from_bytes(content[-4:], "little")
    twr.write_bytes(content[:-4] + (count + 1).to_bytes(4, "little"))
    with pytest.raises(InputError, match="messages are missing on /tag/twr.*rosbag reindex"):
        read_by_profile([twr], load_profile("uwb_msgs"), survey)


@pytest.mark.slow
@pytest.mark.parametrize("find", [bytes.index, bytes.rindex])
def test_a_chunk_that_unpacks_to_too_much_is_refused(flight, survey, tmp_path, find):
    """Each byte unpacks to a megabyte of zeros, in the first or the last chunk of the bag."""
    bomb = bz2.compress(bytes(200_000_000), 9)

    def topics(store):
        return two_way_ranges(flight)(store)

    bag = write_ros_1(tmp_path / "bomb.bag", topics, Ros1Writer.CompressionFormat.BZ2, 20_000)
    content = bag.read_bytes()
    at = find(content, b"BZh")
    size = int.from_bytes(content[at - 4 : at], "little")
    assert len(bomb) < size
    bag.write_bytes(content[:at] + bomb + bytes(size - len(bomb)) + content[at + size :])
    limit = most_unpacked(len(content))
    with pytest.raises(TooMuch, match=f"unpacks to more than {limit} bytes"):
        read_by_profile([bag], load_profile("uwb_msgs"), survey)


def test_a_ulog_that_is_damaged_is_refused(flight, survey, tmp_path):
    log = write_ulog(tmp_path / "flight.ulg", flight)
    content = bytearray(log.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = bytes(400)
    log.write_bytes(bytes(content))
    with pytest.raises(InputError, match="this ULog is cut or damaged"):
        read_by_profile([log], load_profile("px4"), survey)


def test_the_profile_of_the_page_is_one(tmp_path):
    text = section("recordings.md", "Recordings of others")
    (tmp_path / "page.yaml").write_text(*blocks(text, "yaml"))
    page = load_profile(tmp_path / "page.yaml")
    assert page.sources[0].match("/uwb/2/ranges", "my_msgs/msg/Ranges") == {"tag": "2"}
    assert page.antenna == {"1": (0.1, 0.2, 0.3), "2": (0.1, -0.2, 0.3)}
    for name in shipped():
        assert f"`{name}`" in text and f"--profile {name}" in text


def test_a_first_profile_of_an_unknown_kind_is_used_as_it_is(flight, tmp_path, capsys):
    """The names and content of the fields determine streams and units."""
    csv = tmp_path / "rover.csv"
    rows = [
        f"{t:.6f},{anchor},{1e3 * d:.0f}"
        for t, anchor, d in zip(flight.range.t, flight.range.anchor, flight.range.d)
    ]
    csv.write_text("\n".join(["time_s,anchor_id,distance_mm", *rows]) + "\n")
    survey = tmp_path / "survey.csv"
    places = [
        f"{k},{x},{y},{z}" for k, (x, y, z) in zip(flight.anchors.ids, flight.anchors.positions)
    ]
    survey.write_text("\n".join(["id,x,y,z", *places]))
    assert check([str(csv), "--survey", str(survey)]) == 2
    assert "a CSV file of another tool; it needs a profile" in capsys.readouterr().err
    profile = tmp_path / "profile.yaml"
    assert convert([str(csv), "--suggest", str(profile)]) == 0
    text = profile.read_text()
    assert "taken as mm" in text and "# Missing: ground truth" in text
    words = [
        str(csv),
        "--profile",
        str(profile),
        "--survey",
        str(survey),
        "--out",
        str(tmp_path / "our.bag"),
    ]
    assert convert(words) == 0
    np.testing.assert_allclose(read_flight(tmp_path / "our.bag").range.d, flight.range.d, atol=6e-4)


def test_a_foreign_bag_without_our_topics_is_suggested_as_it_is(flight, tmp_path, capsys):
    """`check` names the same command. It also works if no profile fits."""
    bag = write_ros_1(
        tmp_path / "walk.bag",
        lambda store: {
            {"/rtls_flares": "/radio/distances"}.get(name, name): topic
            for name, topic in isas(flight)(store).items()
        },
    )
    profile = tmp_path / "profile.yaml"
    assert convert([str(bag), "--suggest", str(profile)]) == 0
    assert "shipped profile" not in capsys.readouterr().out
    assert convert([str(bag), "--profile", str(profile), "--out", str(tmp_path / "our.bag")]) == 0
    read = read_flight(tmp_path / "our.bag")
    assert (
        len(read.anchors) == 8
        and len(read.imu) == len(flight.imu)
        and len(read.truth) == len(flight.truth)
    )


@pytest.mark.parametrize("tag, error", [("1", 0.25), ("2", 0.25)])
def test_the_measured_ranges_of_starloc(shared_data, tag, error):
    folder = shared_data / "ranging" / "starloc"
    read = read_by_profile(
        [folder / "loop-2d-fast_s1"],
        load_profile("starloc"),
        read_named_anchors(folder / "uwb_markers_v2.csv"),
        tag=tag,
    )
    assert len(read.range) > 3700 and len(read.imu) == 3989
    true = np.array([np.interp(read.range.t, read.truth.t, column) for column in read.truth.p.T]).T
    expected = np.linalg.norm(
        true - read.anchors.positions[read.anchors.index(read.range.anchor)], axis=1
    )
    # README: ranges are 0.1 to 0.5 m too long
    assert 0.1 < np.median(read.range.d - expected) < 0.3


@pytest.mark.slow
def test_the_measured_walk_of_isas(shared_data):
    bag = shared_data / "ranging" / "isas" / "ISAS-Walk1.bag"
    read = read_by_profile([bag], load_profile("isas"))
    assert (len(read.anchors), len(read.range), len(read.imu), len(read.truth)) == (
        5,
        4266,
        4839,
        3168,
    )
    # The accelerometer shows the axis: anchors with z = 1.86 are below anchors with z = 0.
    assert sorted(read.anchors.positions[:, 2].round(2).tolist()) == [-1.86, -1.85, 0.0, 0.0, 0.0]
    upside_down = dataclasses.replace(
        read, anchors=read.anchors.at(read.anchors.positions * [1.0, -1.0, -1.0])
    )
    rules = [
        {finding.rule for finding in judged(of_flight(flight)).findings}
        for flight in (read, upside_down)
    ]
    assert "survey_upside_down" not in rules[0] and "survey_upside_down" in rules[1]
    assert read.meta["unread"] == [
        "/rtls_pose: 970 messages of geometry_msgs/msg/PoseStamped, which the profile does not name"
    ]
