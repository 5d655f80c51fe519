# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchor positions from a tape measure, flights, and what else is known of a hall."""

from dataclasses import replace
from importlib import import_module
import json
import re
from types import SimpleNamespace

from known_effects import SPARSE, clean_flight, sparse_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, Covariance, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.survey import main
from uwb_tdoa_tools.diagnosis import diagnose, self_calibration
from uwb_tdoa_tools.diagnosis.constraints import Distance, Mark, OdometryPath
from uwb_tdoa_tools.diagnosis.diagnose import _calibrated, _Work
from uwb_tdoa_tools.diagnosis.references import Nothing, OdometryReference
from uwb_tdoa_tools.diagnosis.report.entries import entries
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.equations import Runs, delay_effect, tdoa_std_of
from uwb_tdoa_tools.diagnosis.self_calibration.prior import with_calibration
from uwb_tdoa_tools.diagnosis.self_calibration.single import place
from uwb_tdoa_tools.diagnosis.self_calibration.solve import CLEARLY, CLEARLY_OF_RANGES, LEFT
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.surveying import report
from uwb_tdoa_tools.surveying.report import (
    as_dict,
    as_text,
    read_distances,
    read_marks,
    read_paths,
    with_blocked,
    with_large_delays,
)

# --- surveying ---

LATE = EFFECTS["anchor_delay"]({"3": 0.15})
TRUSTED = ("0", "6", "1.z", "2.z")


def at(flight, positions):
    return replace(flight, anchors=flight.anchors.at(positions))


def shaken(anchors, std, seed):
    """Return positions with tape errors of this std, m. TRUSTED coordinates are exact."""
    off = std * np.random.default_rng(seed).standard_normal(anchors.positions.shape)
    return anchors.positions + np.where(
        Tape(1.0, trusted=TRUSTED).position_std(anchors) < 0.5, 0.0, off
    )


def error(flight, **options):
    return evaluate(flight, **options)[0].row()["rmse_3d"]


@pytest.fixture(scope="module")
def flights():
    return [
        LATE.inject(sparse_flight(seed, 40.0), np.random.default_rng(0)) for seed in (200, 201, 202)
    ]


@pytest.fixture(scope="module")
def result(flights):
    measured = shaken(flights[0].anchors, 0.2, 0)
    return self_calibrate(
        [at(flight, measured) for flight in flights[:2]], Tape(0.2, trusted=TRUSTED)
    )


@pytest.mark.slow
def test_anchors_come_nearer_to_where_they_are_and_say_how_near(flights, result):
    true, found = flights[0].anchors.positions, result
    free = result.given_std > 0.1
    off, before = (found.surveyed.positions - true)[free], (result.given.positions - true)[free]
    assert np.sqrt(np.mean(off**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert 0.3 < np.sqrt(np.mean((off / found.position_std[free]) ** 2)) < 1.5
    assert result.improved[free].mean() > 0.5 and not result.improved[~free].any()
    assert np.abs((found.surveyed.positions - true)[~free]).max() < 0.02


@pytest.mark.slow
def test_a_flight_that_took_no_part_gains(flights, result):
    other, found = flights[2], result
    before = error(at(other, result.given.positions))
    effects, config = (
        EffectSet((delay_effect(found.surveyed, found.delays),)),
        FilterConfig(tdoa_std=found.tdoa_std),
    )
    after = evaluate(at(other, found.surveyed.positions), config, effects=effects)[0].row()
    assert after["rmse_3d"] < 0.5 * before and after["rmse_3d"] < 1.2 * error(other)
    assert found.tdoa_std < 0.25 and 0.5 < after["nees_mean"] < 6.0  # white noise of 0.05 m


def test_the_noise_beside_a_calibration_is_that_of_the_flights_without_their_ground_truth(flights):
    late = EffectSet((LATE,))
    bare = [replace(flight, truth=None) for flight in flights[:1]]
    assert (
        tdoa_std_of(flights[:1], late) == tdoa_std_of(bare, late) < tdoa_std_of(bare, EffectSet())
    )


def test_an_anchor_of_which_nothing_is_known_is_placed(flights):
    true = flights[0].anchors.positions
    lost = true.copy()
    lost[5] = 0.0
    placed = place([at(flight, lost) for flight in flights[:1]], [5]).positions
    assert np.linalg.norm(placed[5] - true[5]) < 0.3
    np.testing.assert_array_equal(np.delete(placed, 5, axis=0), np.delete(true, 5, axis=0))


def marks_file(path, flight, places=3, changes=()):
    """Write marks from the ground truth of a Flight, 2 s each, within a millimetre."""
    begin, truth, marks = flight.tdoa.t[0], flight.truth, []
    for first in np.linspace(5.0, 30.0, places):
        inside = (truth.t >= begin + first) & (truth.t <= begin + first + 2.0)
        place = [float(round(value, 4)) for value in truth.p[inside].mean(axis=0)]
        marks.append(
            {
                "flight": flight.name,
                "from": float(first),
                "to": float(first + 2.0),
                "position": place,
                "std": 0.01,
            }
        )
    marks[0].update(changes)
    path.write_text(json.dumps({"marks": marks}))
    return path


@pytest.fixture
def solved(result, monkeypatch):
    """Replace the self-calibration of the command by a ready one, solved.result.

    solved.tapes holds the tapes that the command passes.
    """
    seen = SimpleNamespace(result=result, tapes=[])

    def instead(flights, tape, *_):
        seen.tapes.append(tape)
        return seen.result

    monkeypatch.setattr(self_calibration, "self_calibrate", instead)
    monkeypatch.setattr(report, "with_blocked", lambda result, *_: result)
    return seen


@pytest.mark.slow
def test_nothing_is_applied_where_something_else_is_wrong_too(
    flights, result, solved, tmp_path, capsys
):
    """Below, that is found of a flight."""
    solved.result = replace(result, before=0.1, left=1.1 * LEFT, marks=None)
    assert "something else is wrong too" in solved.result.why_not
    write_bag(flights[0], tmp_path / "flight.bag")
    assert main([str(tmp_path / "flight.bag"), "--out", str(tmp_path / "out")]) == 1
    assert "nothing is applied, anchors stay as given" in capsys.readouterr().out
    kept = read_survey(tmp_path / "out" / "anchors.yaml").positions
    np.testing.assert_allclose(kept, result.given.positions, atol=1e-9)
    assert np.abs(kept - result.surveyed.positions).max() > 0.01
    assert not len(EffectSet.from_yaml(tmp_path / "out" / "effects.yaml"))


@pytest.mark.slow
def test_a_survey_of_another_room_is_named_before_anything_is_estimated(
    flights, solved, tmp_path, monkeypatch, capsys
):
    flight = sparse_flight(203, 20.0)
    monkeypatch.chdir(tmp_path)
    for name, std in (("rough", 0.1), ("other", 0.6)):
        write_bag(at(flight, shaken(flight.anchors, std, 3)), f"{name}.bag")
    main(["rough.bag", "--out", "out"])
    assert "does not fit" not in "".join(capsys.readouterr()) and len(solved.tapes) == 1
    assert main(["other.bag", "--out", "nothing"]) == 1
    printed = capsys.readouterr()
    assert "ERROR: the survey does not fit" in printed.out
    assert "stopped, and nothing is written: the survey does not fit other, as said" in printed.err
    assert len(solved.tapes) == 1 and not (tmp_path / "nothing").exists()
    (std,) = re.findall(r"survey improves them with --std ([0-9.]+) \(m, ", printed.err)
    main(["other.bag", "--std", std, "--out", "out"])
    assert len(solved.tapes) == 2


def test_flights_that_are_too_short_are_refused():
    with pytest.raises(
        InputError, match="s in the air, or in motion on the floor, together; 30 s are needed"
    ):
        self_calibrate([sparse_flight(203, 20.0)], Tape())


@pytest.mark.slow
def test_marks_hold_the_frame_where_no_anchor_is_trusted(flights, tmp_path):
    flight = flights[0]
    away = flight.anchors.positions + [0.2, -0.15, 0.1]  # a common shift, which TDOAs do not show
    moved = [at(flight, away)]
    marks = read_marks(marks_file(tmp_path / "marks.yaml", flight, 6), moved)
    with_marks, without = (
        self_calibrate(moved, Tape(0.3), constraints=some).surveyed.positions
        for some in (marks, ())
    )
    off = [
        np.abs((found - flight.anchors.positions).mean(axis=0)).max()
        for found in (with_marks, without)
    ]
    assert off[0] < 0.05 < 0.1 < off[1]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"flight": "tuesday"}, "no flight 'tuesday'"),
        ({"flight": ["monday"]}, "no flight .'monday'."),
        ({"to": 1e4}, "must lie"),
        ({"position": [1.0, 2.0]}, "three coordinates"),
        ({"position": "here"}, "write it as"),
        ({"std": 0.0}, "a std above 0"),
        ({"height": 1.0}, "must be as"),
    ],
)
def test_marks_that_cannot_be_are_refused(flights, tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        read_marks(marks_file(tmp_path / "marks.yaml", flights[0], changes=changes), flights)


def test_words_name_what_is_better_and_what_is_not(result):
    text = as_text(result)
    assert text.count("\n") >= 9 and "coordinates are known better than before" in text
    assert (
        json.loads(json.dumps(as_dict(result), allow_nan=False))["anchors"]["0"]["improved"]
        == [False] * 3
    )


@pytest.mark.parametrize(
    "options, words",
    [
        ({"std": 0.0}, "--std: 0 must be above 0"),
        ({"trusted": ("77",)}, "there is no anchor '77'"),
        ({"trusted": ("1.w",)}, "has no axis 'w'"),
        ({"trusted": ("1.xy",)}, "has no axis 'xy'"),
        ({"trusted": ("1.",)}, "has no axis ''"),
        ({"unknown": tuple("01234")}, "3 of 8 anchors are left"),
    ],
)
def test_a_tape_that_does_not_fit_is_refused(flights, options, words):
    with pytest.raises(InputError, match=words.replace("(", r"\(")):
        tape = Tape(**options)
        tape.position_std(flights[0].anchors), tape.unknown_rows(flights[0].anchors)


@pytest.mark.slow
def test_the_command_writes_surveys_that_are_read(flights, solved, tmp_path, capsys):
    measured = shaken(flights[0].anchors, 0.1, 1)
    write_bag(flights[0], tmp_path / "flight.bag")
    at(flights[0], measured).anchors.to_yaml(tmp_path / "tape.yaml")
    out = tmp_path / "out"
    words = [
        "--survey",
        str(tmp_path / "tape.yaml"),
        "--height-std",
        "0.03",
        "--trusted",
        *TRUSTED,
        "--out",
        str(out),
    ]
    assert main([str(tmp_path / "flight.bag"), *words]) == 0
    assert solved.tapes == [Tape(0.1, 0.03, trusted=[*TRUSTED])]
    assert re.search(r"next: .*evaluate .*flight\.bag --survey", capsys.readouterr().out)
    found = [read_survey(out / name).positions for name in ("anchors.yaml", "anchors.csv")]
    np.testing.assert_allclose(*found, atol=1e-4)
    assert (out / "survey.png").stat().st_size > 5000 and np.abs(found[0] - measured).max() > 0.01
    assert (
        main([str(tmp_path / "flight.bag"), *words[:-2], "--out", str(tmp_path / "tape.yaml")]) == 2
    )


TAG = 0.25  # m, offset of all ranges


@pytest.fixture(scope="module")
def ranged():
    """Return two flights with ranges only, with delays of anchors and of the tag."""
    flown = dict(
        duration=40.0,
        floor_time=1.0,
        trajectory="sines",
        imu_rate=200.0,
        truth_rate=100.0,
        range_noise=0.1,
    )
    flights = [
        simulate(SimulationConfig(seed=seed, bias=False, multipath=False, **flown))
        for seed in (400, 401)
    ]
    late = EFFECTS["anchor_delay"]({str(i): TAG + 0.03 * (-1) ** i for i in flights[0].anchors.ids})
    flights = [
        replace(late.inject(flight, np.random.default_rng(0)), tdoa=Tdoas(*np.empty((4, 0))))
        for flight in flights
    ]
    return [at(flight, shaken(flight.anchors, 0.1, 1)) for flight in flights], flights


@pytest.fixture(scope="module")
def by_ranges(ranged):
    """Return the self-calibration of the first flight with ranges."""
    return self_calibrate(ranged[0][:1], Tape(0.1, trusted=TRUSTED))


@pytest.mark.slow
def test_ranges_tell_of_anchors_and_of_the_delay_of_the_tag(ranged, by_ranges):
    (given, true), found = ranged, by_ranges
    assert found.why_not is None and found.tdoa_std is None
    assert np.mean(found.delays) == pytest.approx(TAG, abs=0.06)
    effects = EffectSet((delay_effect(found.surveyed, found.delays),))
    none = FilterConfig(range_offset_std=0.0)
    before, after = (
        error(given[1], config=none),
        error(at(given[1], found.surveyed.positions), effects=effects, config=none),
    )
    assert after < 0.3 * before and after < 0.6 * error(true[1], config=none)
    assert error(at(given[1], found.surveyed.positions), effects=effects) < error(given[1])
    assert "TDOAs" not in as_text(found)


def test_another_tag_needs_no_parameter_by_hand(ranged, by_ranges):
    """The filter estimates the difference between another tag and the tag of the survey."""
    (_, same), _ = ranged
    found = by_ranges
    none, other = FilterConfig(range_offset_std=0.0), without_offset(same, 0.15)

    def left(flight, config=None):
        return error(at(flight, found.anchors.positions), effects=found.effects, config=config)

    assert left(other) < 1.1 * left(same) < 1.2 * left(same, none) and left(
        other, none
    ) > 1.5 * left(other)


def test_only_tdoas_place_an_anchor(ranged):
    with pytest.raises(InputError, match="--unknown 3: only TDOAs place an anchor"):
        self_calibrate(ranged[0][:1], Tape(0.1, unknown=("3",)))


def test_tdoas_know_nothing_of_the_delay_of_the_tag(flights, result):
    assert abs(np.mean(result.delays)) < 0.05 and result.prior.common == 0.0


@pytest.mark.slow
def test_survey_of_a_recording_of_ranges(ranged, by_ranges, solved, tmp_path, capsys):
    solved.result = by_ranges
    bag, out = tmp_path / "ranged.bag", tmp_path / "out"
    write_bag(ranged[0][0], bag)
    assert main([str(bag), "--trusted", *TRUSTED, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "wrote anchors.yaml, anchors.csv, effects.yaml, ekf_node.yaml, survey.json" in said
    assert FilterConfig.from_yaml(out / "ekf_node.yaml") == FilterConfig()
    told = json.loads((out / "survey.json").read_text())
    delay, std = told["tag_delay"]
    assert (
        told["tdoa_std"] is None
        and f"all ranges are {100 * delay:.1f} +- {100 * std:.1f} cm too long" in said
    )


# --- the last calibration, distances, and the path of other odometry ---


@pytest.fixture(scope="module")
def last_week(flights):
    return self_calibrate(flights[:1], Tape(0.05))


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


# --- the self-calibration that all tools share ---

DELAYS = {"1": 0.3, "4": -0.2, "6": 0.25}
SEVERAL_LATE = EFFECTS["anchor_delay"](DELAYS)


def flight_with(*effects, seed=100, seconds=40.0, make=sparse_flight):
    flight = make(seed, seconds)
    for effect in effects:
        flight = effect.inject(flight, np.random.default_rng(0))
    return flight


def all_tdoas(seed, seconds):
    """Return a flight with all TDOAs of its protocol, and few inertial samples."""
    return clean_flight(seed, seconds, rates={**SPARSE, "tdoa_rate": None})


@pytest.fixture(scope="module")
def late_flights():
    """Return two flights with late anchors."""
    return [flight_with(SEVERAL_LATE, seed=seed, make=all_tdoas) for seed in (100, 101)]


@pytest.fixture(scope="module")
def diagnosed_late(late_flights):
    """Return the Diagnosis of the two flights, and its arguments and result of `self_calibrate`."""
    calls = []

    def noted(*given):
        calls.append((given, self_calibrate(*given)))
        return calls[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("uwb_tdoa_tools.diagnosis.diagnose"), "self_calibrate", noted)
        diagnosis = diagnose(late_flights, reference=Nothing())
    ((given, found),) = calls
    return diagnosis, given, found


@pytest.fixture(scope="module")
def late(diagnosed_late):
    """Return the self-calibration of the two flights."""
    return diagnosed_late[2]


@pytest.fixture(scope="module")
def diagnosis(diagnosed_late):
    return diagnosed_late[0]


@pytest.mark.slow
def test_delays_of_several_anchors_are_told_well_enough_from_the_innovations_alone(late):
    assert late.why_not is None and late.explained > 0.5 and late.left < LEFT
    given, errors = EffectSet(late.found(late.shifts)), []
    for seed in (102, 103, 104):
        other = flight_with(SEVERAL_LATE, seed=seed, seconds=30.0, make=all_tdoas)
        shifted = replace(other, anchors=late.anchors)
        cases = (other, EffectSet()), (other, given), (shifted, late.effects)
        errors.append([evaluate(one, effects=e)[0].row()["rmse_3d"] for one, e in cases])
    before, corrected, moved = np.mean(errors, axis=0)
    assert corrected < 0.4 * before and corrected < 0.09
    # shifts in effects.yaml give the same result as shifts in the anchors
    assert moved == pytest.approx(corrected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect, change",
    [
        (EFFECTS["anchor_delay"]({"3": 0.28}), r"anchor 3 is later than it was by \+2[678]\."),
        (EFFECTS["anchor_position"]({"3.x": 0.3, "3.y": -0.2}), r"anchor 3 has moved by \+"),
    ],
)
def test_one_late_anchor_is_no_moved_one(effect, change):
    flights = [flight_with(effect, seed=seed) for seed in (100, 101)]
    found = self_calibrate(flights, Tape(std=0.03))
    assert found.why_not is None and len(found.changes) == 1
    assert re.match(change, found.changes[0].as_text())


@pytest.mark.slow
def test_who_asks_makes_no_difference(late_flights, diagnosed_late, late, diagnosis):
    """A diagnosis and a survey call the same function with the same flights."""
    flights, *others, _, _ = diagnosed_late[1]
    assert others == [Tape(), EffectSet(), None, []]
    for one, other in zip(flights, late_flights, strict=True):
        assert one.anchors is other.anchors and one.tdoa is other.tdoa and one.imu is other.imu
    written = {effect.name: effect.values for effect in diagnosis.effects.effects}
    for effect in late.found(late.shifts):
        assert written[effect.name] == pytest.approx(effect.values, abs=1e-12)
    np.testing.assert_array_equal(
        diagnosis.effects.covariance.matrix, late.effects.covariance.matrix
    )


@pytest.mark.slow
def test_what_is_applied_is_found_with_its_evidence_and_the_same_in_all_flights(late, diagnosis):
    added = [finding for finding in diagnosis.findings if finding.added]
    assert [finding.effect.name for finding in added] == ["anchor_position", "anchor_delay"]
    assert added[1].evidence == pytest.approx(
        {"slow_before": late.before, "slow_left": late.left}, abs=1e-4
    )
    assert added[1].explained == late.explained
    assert "pair_offset" in [other.effect for other in added[1].alternatives]
    shares = [(one.share, one.std) for one in added[1].shares]
    assert len(shares) == 2 and all(abs(share - 1.0) < 0.3 and std < 0.2 for share, std in shares)
    assert [entry.differing for entry in entries(diagnosis)[:2]] == ["", ""]


def test_the_noise_that_the_filter_is_told_asks_for_no_functions_of_the_place():
    flight, config = flight_with(SEVERAL_LATE), FilterConfig()
    anchors = flight.anchors
    about = anchors, np.zeros(len(anchors)), np.full(4 * len(anchors), 0.1)
    with_all, alone = (
        Runs([flight], EffectSet(), config).equations(*about, functions=functions)
        for functions in (True, False)
    )
    n = len(alone.vector)
    assert n == 4 * len(anchors) < len(with_all.vector)
    np.testing.assert_allclose(alone.gram, with_all.gram[:n, :n], rtol=1e-9, atol=1e-6)
    assert alone.tdoa_std(config) == pytest.approx(with_all.tdoa_std(config), rel=1e-9)


@pytest.mark.slow
def test_a_delay_of_one_flight_is_no_delay_of_the_other():
    short = {"seconds": 28.0, "make": all_tdoas}
    found = self_calibrate([flight_with(SEVERAL_LATE, **short), flight_with(seed=101, **short)])
    one, other = (share.share for share in found.shares["anchor_delay"])
    assert one - other > 1.0


def why_not_of(flight):
    """Return the reason why `diagnose` does not apply the self-calibration of a flight."""
    reference = Nothing()
    return _calibrated(
        _Work(reference, EffectSet(), None, lambda what: None, map),
        (reference.prepare(flight),),
        EffectSet(),
    )


@pytest.mark.slow
def test_nothing_is_a_finding_in_a_flight_of_which_nothing_is_wrong():
    assert "of what is slow in the innovations" in why_not_of(flight_with())


def test_flights_that_are_too_short_say_so():
    assert why_not_of(flight_with(SEVERAL_LATE, seconds=20.0)).endswith(
        "30 s are needed: record motion for longer"
    )


@pytest.mark.slow
def test_nothing_is_applied_if_something_else_is_wrong_too():
    blocked = {"2.x": 1.0, "2.y": 0.0, "2.z": 1.0, "2.radius": 1.5, "2.delay": 1.5}
    other = (
        EFFECTS["nlos"](blocked),
        SEVERAL_LATE,
        EFFECTS["noise_correlation"]({"std": 0.2, "time": 1.0}),
    )
    assert "something else is wrong too" in why_not_of(flight_with(*other))


@pytest.mark.slow
@pytest.mark.parametrize("ratio, applied", [(0.95, False), (1.05, True)])
def test_slow_errors_of_ranges_ask_for_a_smaller_fall(late, ratio, applied):
    """The rule for ranges does not depend on the size of the remaining errors.

    For TDOAs, this size decides.
    """
    for left in (0.5 * LEFT, 2.0 * LEFT):
        before = ratio * CLEARLY_OF_RANGES * left
        found = replace(late, before=before, left=left, marks=None)
        assert (found.why_not is None) == (left < LEFT)
        assert (replace(found, tdoa_std=None).why_not is None) == applied


@pytest.mark.slow
@pytest.mark.parametrize(
    "before, left, marks, applied",
    [
        (0.1, 0.9 * LEFT, None, True),
        (0.1, 1.1 * LEFT, None, False),
        # the tape error was larger than the remaining errors
        (1.2 * CLEARLY * LEFT, 1.1 * LEFT, None, True),
        (0.1, 1.1 * LEFT, (0.2, 0.1, 0.8), True),  # the marks decide
        (0.1, 0.9 * LEFT, (0.2, 0.1, 0.7), False),
        (0.1, 0.9 * LEFT, (0.1, 0.2, 0.8), False),
    ],
)
def test_one_rule_says_whether_it_is_applied(late, before, left, marks, applied):
    found = replace(late, before=before, left=left, marks=marks)
    assert (found.why_not is None) == applied
    assert (
        found.anchors is (found.surveyed if applied else found.given)
        and len(found.effects) == 2 * applied
    )


def test_what_is_found_is_added_to_what_was_known():
    known = Covariance((("anchor_delay", "1"),), np.eye(1))
    base = EffectSet((AnchorDelay({"1": 0.1, "2": 0.2}, {"1": 0.01, "2": 0.01}),), known)
    found = (
        AnchorPosition({"1.x": 0.5}, {"1.x": 0.1}),
        AnchorDelay({"1": 0.05, "3": 0.3}, {"1": 0.02, "3": 0.02}),
    )
    delay, position = with_calibration(base, found, None).effects
    assert delay.values == pytest.approx({"1": 0.15, "2": 0.2, "3": 0.3}) and delay.std == {
        "1": 0.02,
        "2": 0.01,
        "3": 0.02,
    }
    assert (
        position.values == {"1.x": 0.5} and with_calibration(base, found, None).covariance is known
    )
