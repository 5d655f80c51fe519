# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Known data besides flights: the last calibration, distances, and the path of other odometry."""

from dataclasses import replace
import re

from known_effects import clean_flight, sparse_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.survey import main
from uwb_tdoa_tools.diagnosis import self_calibration
from uwb_tdoa_tools.diagnosis.constraints import Distance, Mark, OdometryPath
from uwb_tdoa_tools.diagnosis.references import OdometryReference
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.surveying import report
from uwb_tdoa_tools.surveying.known import read_distances, read_paths
from uwb_tdoa_tools.surveying.report import as_text, with_blocked, with_large_delays

LATE = EFFECTS["anchor_delay"]({"3": 0.15})


@pytest.fixture(scope="module")
def flights():
    return [LATE.inject(sparse_flight(seed, 40.0), np.random.default_rng(0)) for seed in (200, 201)]


@pytest.fixture(scope="module")
def last_week(flights):
    return self_calibrate(flights[:1], Tape(0.05))


def at(flight, positions):
    return replace(flight, anchors=flight.anchors.at(positions))


@pytest.fixture(scope="module")
def again(flights, last_week):
    """Return the self-calibration of the second flight, with that of the first as its prior."""
    return self_calibrate([at(flights[1], last_week.anchors.positions)], Tape(), last_week.effects)


@pytest.mark.slow
def test_nothing_has_changed_since_last_week(again, last_week):
    assert not again.changes and "no anchor has changed clearly" in as_text(again)
    assert (again.position_std <= last_week.position_std + 0.005).all()
    before, after = (
        next(e for e in one.effects.effects if e.name == "anchor_delay")
        for one in (last_week, again)
    )
    assert all(
        abs(after.values[key] - value) < 3.0 * before.std[key]
        for key, value in before.values.items()
    )
    assert len(again.effects) == 2 and again.effects.covariance.matrix.shape == (32, 32)


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect, shown",
    [
        (EFFECTS["anchor_delay"]({"5": 0.25}), ("anchor_delay", "5")),
        (
            EFFECTS["anchor_position"]({"2.x": 0.3, "2.y": -0.3, "2.z": 0.25}),
            ("anchor_position", "2"),
        ),
    ],
)
def test_what_has_changed_is_named_with_its_size(flights, last_week, effect, shown):
    today = at(effect.inject(flights[1], np.random.default_rng(0)), last_week.anchors.positions)
    changes = self_calibrate([today], Tape(), last_week.effects).changes
    assert [(one.effect, one.anchor) for one in changes] == [shown]
    away = changes[0].values - list(effect.values.values())
    assert (np.abs(away) < 4.0 * changes[0].std + 0.05).all() and (changes[0].std < 0.15).all()


@pytest.mark.slow
def test_an_anchor_that_is_said_to_be_unknown_is_not_held_by_last_week(last_week):
    kept = last_week.effects.covariance.without(("5",))
    assert len(kept.keys) == 28 and not [key for key in kept.keys if key[1][0] == "5"]


@pytest.mark.slow
def test_distances_tell_of_anchors_what_flights_do_not(flights):
    true = flights[0].anchors
    rough = true.positions + 0.1 * np.random.default_rng(5).standard_normal((8, 3))
    ids, k = true.ids, [(a, b) for a in range(8) for b in range(a)]
    laser = [
        Distance(
            int(ids[a]),
            int(ids[b]),
            float(np.linalg.norm(true.positions[a] - true.positions[b])),
            0.005,
        )
        for a, b in k
    ]
    results = [
        self_calibrate([at(flights[0], rough)], Tape(0.1), constraints=some) for some in ((), laser)
    ]
    lengths = [
        np.array(
            [np.linalg.norm(one.surveyed.positions[a] - one.surveyed.positions[b]) for a, b in k]
        )
        for one in results
    ]
    off = [np.sqrt(np.mean((some - [one.distance for one in laser]) ** 2)) for some in lengths]
    assert (
        off[1] < 0.01 < off[0]
        and results[1].position_std.mean() < 0.8 * results[0].position_std.mean()
    )


@pytest.mark.parametrize(
    "text, words",
    [
        ("a,b,distance\n0,1,3\n", "no column std"),
        ("a,b,distance,std\n0,99,3,0.01\n", "must be two of the anchors"),
        ("a,b,distance,std\n0,0,3,0.01\n", "must be two of the anchors"),
        ("a,b,distance,std\n0,1,-3,0.01\n", "is no distance"),
        ("a,b,distance,std\n0,1,three,0.01\n", "must be a finite number"),
        ("a,b,distance,std\n", "holds no distance"),
    ],
)
def test_distances_that_cannot_be_are_refused(flights, tmp_path, text, words):
    (tmp_path / "laser.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_distances(tmp_path / "laser.csv", flights[0].anchors)


def odometry_of(flight, drift=0.02, yaw=1.0, seed=0):
    """Return the OdometryPath of a Flight: its ground truth with drift, in another frame."""
    truth, rng = flight.truth, np.random.default_rng(seed)
    t = np.arange(truth.t[0], truth.t[-1], 0.05)
    p = np.stack([np.interp(t, truth.t, column) for column in truth.p.T], axis=1)
    walk = np.cumsum(drift * np.sqrt(0.05) * rng.standard_normal(p.shape), axis=0)
    return OdometryPath(
        flight.name,
        t,
        Rotation.from_euler("z", yaw).apply(p) + [5.0, -3.0, 1.0] + walk,
        max(drift, 1e-3),
    )


def ends(flight, std=0.05):
    """Return [Mark] of a Flight: its positions before take-off and after landing."""
    truth, last = flight.truth, flight.tdoa.t[-1] - flight.tdoa.t[0]
    return [
        Mark(flight.name, since, since + 2.0, tuple(truth.p[row]), std)
        for since, row in ((0.0, 0), (last - 2.0, -1))
    ]


@pytest.mark.slow
def test_a_path_laid_beside_the_filters_is_where_the_tag_was_and_takes_its_shift_from_marks(
    flights,
):
    late = LATE.inject(clean_flight(200, 40.0), np.random.default_rng(0))
    flight = EFFECTS["anchor_position"]({"1.z": 0.4, "6.x": -0.3}).inject(
        late, np.random.default_rng(0)
    )
    wrong = replace(flight, truth=replace(flight.truth, p=flight.truth.p[::-1] + 30.0))
    shifts = []
    for marks in ([], ends(flight)):
        reference = OdometryReference(None, [odometry_of(flight, drift=0.005), *marks])
        paths = [reference.prepare(each).truth for each in (replace(flight, truth=None), wrong)]
        np.testing.assert_array_equal(paths[0].p, paths[1].p)  # no ground truth is read
        path = paths[0]
        aloft = (path.t > flight.truth.t[0] + 5.0) & (path.t < flight.truth.t[-1] - 5.0)
        off = path.p[aloft] - np.stack(
            [np.interp(path.t[aloft], flight.truth.t, c) for c in flight.truth.p.T], axis=1
        )
        assert np.sqrt(np.mean((off - off.mean(axis=0)) ** 2)) < 0.04
        shifts.append(np.abs(off.mean(axis=0)).max())
    assert shifts[1] < 0.03 < shifts[0]
    with pytest.raises(InputError, match="holds no path"):
        reference.prepare(flights[1])


@pytest.mark.slow
def test_marks_on_the_floor_tell_nothing_and_those_in_the_air_judge_each_other(flights, last_week):
    on_floor = self_calibrate(flights[:1], Tape(0.05), constraints=ends(flights[0]))
    np.testing.assert_array_equal(on_floor.surveyed.positions, last_week.surveyed.positions)
    assert (
        on_floor.marks_on_floor == 2
        and on_floor.marks is None
        and "left out: 2 marks on the floor" in as_text(on_floor)
    )
    flight = at(flights[0], flights[0].anchors.positions + [0.0, 0.0, 0.2])
    in_air = self_calibrate([flight], Tape(0.3), constraints=marks_in_the_air(flights[0]))
    before, after, nearer = in_air.marks
    assert (
        after < 0.7 * before
        and nearer == 1.0
        and in_air.why_not is None
        and "nearer at 100% of them" in as_text(in_air)
    )
    for against in ((after, before, nearer), (before, after, 0.6)):
        assert "the position would suffer" in replace(in_air, marks=against).why_not


def marks_in_the_air(flight):
    """Return [Mark] of four positions of a Flight, 1 s each."""
    truth, begin = flight.truth, flight.tdoa.t[0]
    rows = [np.searchsorted(truth.t, begin + since + 0.5) for since in (8.0, 14.0, 20.0, 26.0)]
    return [
        Mark(
            flight.name,
            truth.t[row] - begin - 0.5,
            truth.t[row] - begin + 0.5,
            tuple(truth.p[row]),
            0.05,
        )
        for row in rows
    ]


@pytest.mark.slow
def test_what_blocks_an_anchor_is_said_with_its_place(flights, last_week):
    centre = flights[0].truth.p[len(flights[0].truth) // 2]
    region = EFFECTS["nlos"](
        {**dict(zip(("5.x", "5.y", "5.z"), centre.tolist())), "5.radius": 1.2, "5.delay": 0.6}
    )
    assert with_blocked(last_week, flights[:1]).blocked == ()
    (sentence,) = with_blocked(
        last_week, [region.inject(flights[0], np.random.default_rng(0))]
    ).blocked
    assert re.search("between anchor 5 and .* heard 0.[56].* m late", sentence)


def test_what_is_little_blocks_nothing():
    both = {
        "3.delay": 0.1,
        "3.start": 2.0,
        "3.end": 9.0,
        "4.delay": 0.4,
        "4.start": 1.0,
        "4.end": 8.0,
    }
    kept = with_large_delays(EFFECTS["nlos"](both, {"3.delay": 0.01, "4.delay": 0.01}))
    assert {key[0] for key in kept.values} == {key[0] for key in kept.std} == {"4"} and len(
        kept.values
    ) == 3


def test_what_a_path_may_be_off_by_shrinks_with_marks(flights):
    known, other = ([odometry_of(flights[0]), *some] for some in (ends(flights[0]), []))
    stds = []
    for some in (known, other):
        reference = OdometryReference(None, some)
        reference.prepare(flights[0])
        stds.append(reference.shift_std(flights[0].name)[0])
    assert 0.02 < stds[0] < 0.1 < 0.2 < stds[1] < 0.4


def test_paths_are_read_from_tables_and_refused_where_they_cannot_be(flights, tmp_path):
    flight, path = flights[0], odometry_of(flights[0])
    rows = [
        f"{flight.name},{t:.3f},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(path.t, path.p)
    ]
    (tmp_path / "vio.csv").write_text("\n".join(["flight,t,x,y,z", *rows, ""]))
    (read,) = read_paths(tmp_path / "vio.csv", [flight])
    np.testing.assert_allclose(read.p, path.p, atol=1e-4)
    (tmp_path / "back.csv").write_text("\n".join(["flight,t,x,y,z", *rows[::-1], ""]))
    for source, one, words in (
        ("vio.csv", flights[1], "holds no row of flight"),
        ("back.csv", flight, "do not rise"),
        ("topic", flight, "is no bag"),
    ):
        with pytest.raises(InputError, match=words):
            read_paths(tmp_path / source, [one])
    with pytest.raises(InputError, match="--drift: -1"):
        read_paths(tmp_path / "vio.csv", [flight], -1.0)


@pytest.mark.slow
def test_the_command_goes_on_from_what_it_wrote(
    flights, last_week, again, tmp_path, capsys, monkeypatch
):
    results, priors = iter([last_week, again]), []
    monkeypatch.setattr(
        self_calibration,
        "self_calibrate",
        lambda _, tape, base, *__: priors.append(base) or next(results),
    )
    monkeypatch.setattr(report, "with_blocked", lambda result, *_: result)
    write_bag(flights[0], tmp_path / "first.bag")
    first, second = tmp_path / "first", tmp_path / "second"
    assert main([str(tmp_path / "first.bag"), "--std", "0.05", "--out", str(first)]) == 0
    capsys.readouterr()
    options = [
        "--survey",
        str(first / "anchors.yaml"),
        "--effects",
        str(first / "effects.yaml"),
        "--out",
        str(second),
    ]
    assert main([str(tmp_path / "first.bag"), *options]) == 0
    written = EffectSet.from_yaml(first / "effects.yaml")
    assert not priors[0].effects and priors[1].effects == written.effects
    assert "since the last calibration" in capsys.readouterr().out
    known = [EffectSet.from_yaml(folder / "effects.yaml") for folder in (first, second)]
    assert [len(one) for one in known] == [2, 2] and known[1].covariance.keys == known[
        0
    ].covariance.keys
