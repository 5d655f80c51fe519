# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rules over streams in flight, on measured and simulated flights."""

from collections import Counter
import re

from faults import ARRIVAL, FAULTS, FLIGHT, OF_THE_CLOCK, D, columns_of, put
import numpy as np
import pytest
from test_stream_rules import ANCHORS, standing, streams

from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.status import Use
from uwb_tdoa_ekf.monitoring.stream_rules import FEW_ANCHORS, StreamWatch

LOOK = 0.2  # s


def watched(imu, tdoa, seconds=8.0, **options):
    """Return [{rule: Finding}], for each second, of columns as from `streams`."""
    watch = StreamWatch(ANCHORS, 0.25, **options)
    begin, said = min(imu[1][0], tdoa[1][0]), []
    for second in range(int(seconds)):
        for columns, add in ((imu, watch.add_imu), (tdoa, watch.add_tdoa)):
            inside = (columns[1] >= begin + second) & (columns[1] < begin + second + 1.0)
            for some in np.array_split(np.flatnonzero(inside), 50):
                add(*(column[some] for column in columns))
        said.append({finding.rule: finding for finding in watch.findings()})
    return said


def shifted(columns, arrival):
    return (columns[0], arrival, *columns[2:])


def test_a_healthy_flight_has_no_findings():
    assert not any(watched(*streams(8.0)))


@pytest.mark.parametrize("fault", sorted(FAULTS.keys() - OF_THE_CLOCK))
def test_a_fault_is_named_within_five_seconds_and_forgotten_when_it_ends(fault, phase=0.55):
    begin, rng = 1e9 + 3.7 * phase, np.random.default_rng(0)
    columns = columns_of(begin, [(0.0, 4.0, ()), (4.0, 10.0, (fault,)), (10.0, 16.0, ())])
    # Senders are not on time either: messages come in lumps, up to 30 ms late.
    for stream in columns:
        late = stream[ARRIVAL] + 0.03 * rng.random(len(stream[ARRIVAL])) ** 4
        stream[ARRIVAL][:] = np.maximum.accumulate(late)
    watch, said, before = StreamWatch(FLIGHT.anchors, 0.25), [], -np.inf
    for now in np.arange(begin + phase, begin + 16.0):
        for stream, add in zip(columns, (watch.add_imu, watch.add_tdoa)):
            inside = (stream[ARRIVAL] >= before) & (stream[ARRIVAL] < now)
            add(*(column[inside] for column in stream))
        said.append((now - begin, "; ".join(finding.sentence for finding in watch.findings())))
        before = now
    assert not any(words for at, words in said if at < 4.0), said
    named = [at - 4.0 for at, words in said if at > 4.0 and re.search(FAULTS[fault][1], words)]
    assert named and named[0] <= 5.0, said
    assert not any(words for at, words in said if at > 15.0), said


def test_the_text_of_a_finding_stays_as_long_as_it_goes_on():
    imu, tdoa = streams(16.0)
    turned = (
        *imu[:-1],
        imu[-1] * [1.0, -1.0, -1.0] + np.array([0.0, 0.0, 0.3]) * np.sin(0.7 * imu[0])[:, None],
    )
    said = [
        found["imu_turned"].sentence
        for found in watched(turned, tdoa, 16.0)
        if "imu_turned" in found
    ]
    assert len(said) > 8 and len(set(said)) == 1


def test_a_replay_at_another_speed_is_none():
    imu, tdoa = streams(8.0)
    fast = [
        shifted(columns, columns[1][0] + (columns[1] - columns[1][0]) / 4.0)
        for columns in (imu, tdoa)
    ]
    assert not any(watched(*fast, 2.0))


def test_blocks_of_both_streams_are_the_affair_of_who_runs_us_and_those_of_one_are_not():
    imu, tdoa = streams(8.0)
    imu_blocks, tdoa_blocks = (shifted(columns, np.ceil(columns[1])) for columns in (imu, tdoa))
    assert any("blocks" in found for found in watched(imu, tdoa_blocks))
    assert not any("blocks" in found for found in watched(imu_blocks, tdoa_blocks))


def test_a_tag_at_a_fixed_height_may_hear_three_anchors():
    imu, tdoa = streams(8.0)
    three = (tdoa[2] >= 15) & (tdoa[3] >= 15)
    tdoa = tuple(column[three] for column in tdoa)
    assert any(FEW_ANCHORS in found for found in watched(imu, tdoa))
    assert not any(FEW_ANCHORS in found for found in watched(imu, tdoa, ignored=[FEW_ANCHORS]))


def test_few_tdoas_a_second_are_slow_and_not_clipped():
    imu, tdoa = streams(10.0)
    said = watched(imu, tuple(column[::37] for column in tdoa), 10.0)
    assert {rule for found in said for rule in found} == {"rate"}


def clipped(columns, since):
    return np.where(columns[0] < since, columns[D], np.clip(columns[D], -1.0, 1.0))


@pytest.mark.parametrize(
    ("rule", "wrong"),
    [("tdoa_frozen", standing), ("tdoa_clipped", clipped)],
)
@pytest.mark.parametrize("at", [4.0, 4.5])
def test_values_that_stand_still_or_are_clipped_are_a_fault_within_two_seconds(rule, wrong, at):
    imu, tdoa = streams(9.0)
    said = watched(imu, put(tdoa, D, wrong(tdoa, 100.0 + at)), 9.0)
    assert not any(said[:4])
    assert all(set(found) == {rule} and found[rule].position_wrong() for found in said[6:])


def test_another_time_is_judged_anew():
    imu, tdoa = streams(8.0)
    watch = StreamWatch(ANCHORS, 0.25)
    watch.add_imu(*imu[:3], imu[3] / 9.81)
    assert watch.findings()
    watch.restart()
    assert not watch.findings()


def flights(folder):
    """Yield (name, Flight) of the measured micro-SD logs."""
    readers = pytest.importorskip("uwb_tdoa_tools.readers")
    for log in sorted(
        path for path in (folder / "flights").rglob("*") if path.is_file() and not path.suffix
    ):
        day = log.relative_to(folder / "flights").parts[0]
        yield log.name, readers.read_flight(log, folder / "surveys" / f"anchor_{day}.txt")


@pytest.mark.slow
def test_nothing_is_said_of_measured_flights(shared_data):
    """Run stream rules, use, sign, yaw and IMU checks live, from the floor to the landing."""
    count, rng = 0, np.random.default_rng(0)
    for name, flight in flights(shared_data):
        watch, use, received = StreamWatch(flight.anchors, 0.25), Use(0.25), Counter()
        estimator, imu, tdoa = Estimator(flight.anchors), flight.imu, flight.tdoa
        late = [t + 0.002 + rng.exponential(0.001, len(t)) for t in (imu.t, tdoa.t)]
        begin, end = min(imu.t[0], tdoa.t[0]), max(imu.t[-1], tdoa.t[-1])
        for k, now in enumerate(np.arange(begin, end, LOOK)):
            i, j = (slice(*np.searchsorted(t, [now, now + LOOK])) for t in (imu.t, tdoa.t))
            watch.add_imu(imu.t[i], late[0][i], imu.gyro[i], imu.accel[i])
            watch.add_tdoa(tdoa.t[j], late[1][j], tdoa.a[j], tdoa.b[j], tdoa.d[j])
            estimator.add_imu(imu.t[i], imu.gyro[i], imu.accel[i])
            estimator.add_tdoa(tdoa.t[j], tdoa.a[j], tdoa.b[j], tdoa.d[j])
            estimator.advance()
            received["tdoa"] += j.stop - j.start
            use.update(now, received, Counter(estimator.counts), estimator.running)
            assert use.why_unused is None, (name, now - begin, use.why_unused)
            if k % 5 == 4:
                assert watch.findings() == [], (name, now - begin)
        assert estimator.sign_turns == estimator.yaw_doubts == 0, name
        # The filter never runs without its IMU.
        assert estimator._ekf.imu_fault_detector.contradicted == -np.inf, name
        count += 1
    assert count == 22
