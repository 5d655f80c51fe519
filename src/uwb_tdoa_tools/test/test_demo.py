# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from contextlib import redirect_stdout
from dataclasses import replace
import io
import json
import shlex
from types import SimpleNamespace

import numpy as np
from programs import python
import pytest
from rosbags.highlevel import AnyReader

pytest.importorskip("rclpy")
import known_answer  # noqa: E402

from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_odometry  # noqa: E402
from uwb_tdoa_tools.commands import calibrate, check, demo, localize  # noqa: E402
from uwb_tdoa_tools.diagnosis import diagnose  # noqa: E402
from uwb_tdoa_tools.estimate import FlightEstimator  # noqa: E402
from uwb_tdoa_tools.flying import demo as flown  # noqa: E402
from uwb_tdoa_tools.flying.demo import (  # noqa: E402
    change_of_scores,
    correction_in_words,
    corrector_of,
    next_steps,
)
from uwb_tdoa_tools.scoring.evaluation import score_of  # noqa: E402
from uwb_tdoa_tools.scoring.pairs import residuals_of  # noqa: E402
from uwb_tdoa_tools.simulation import inject, simulate  # noqa: E402
from uwb_tdoa_tools.simulation.config import corners


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--rate", "0"], "argument --rate: '0' is not a number above 0"),
        (
            ["--survey", "survey.txt"],
            "--survey: needs --flight; a simulated flight has its own anchors.",
        ),
        (["--flight", "nowhere.log"], "nowhere.log: does not exist"),
        (["--effects", "a.yaml"], "--effects: needs --flight: the demo writes its own"),
        (["--model", "a.onnx"], "--model: needs --flight: the demo writes its own"),
        (["--flight", "a.log", "--seed", "2"], "--seed: belongs to the simulated hall"),
        (["--flight", "a.log", "--json", "a.json"], "--json: belongs to the simulated hall"),
    ],
)
def test_bad_usage_is_one_sentence(arguments, sentence, tmp_path, capsys):
    assert demo.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert f"demo: error: {sentence}" in capsys.readouterr().err


@pytest.mark.parametrize("given", [("a flight.log", "survey.txt"), ("flight.bag",)])
def test_the_next_commands_are_commands(given):
    for command in next_steps(*given):
        words = shlex.split(command)
        name, *rest = words[words.index("uwb_tdoa_tools") + 1 :]
        args = (
            {"calibrate": calibrate, "check": check, "localize": localize}[name]
            .parser()
            .parse_args(rest)
        )
        assert args.flights == [given[0]] and args.survey == (given[1] if len(given) > 1 else None)


class ErrorOnly:
    """A Score that holds only its error."""

    def __init__(self, error):
        self.error = error

    def row(self):
        return {"rmse_3d": self.error, "diverged": False}


def test_it_says_what_corrects_and_that_nothing_does_unless_it_is_asked_for(tmp_path):
    flight = SimpleNamespace(anchors=corners())
    nothing = corrector_of(flight, None, None)
    assert nothing is None
    assert correction_in_words(nothing).startswith(
        "nothing: neither --effects nor --model is given"
    )
    model = known_answer.write(tmp_path)
    given = correction_in_words(corrector_of(flight, None, str(model)), None, model)
    assert given == f"known_answer ({model})"


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ((0.2, 0.2), "3D RMSE 0.200 m, with nothing corrected: diagnose finds"),
        ((0.2, 0.15, 0.15), "3D RMSE raw 0.200 m, corrected 0.150 m: -25 %"),
        (
            (0.219, 0.228, 0.228),
            (
                "corrected 0.228 m: +4 %; this correction does not fit this flight: other "
                "anchors, another day"
            ),
        ),
    ],
)
def test_a_correction_that_does_harm_is_called_that(errors, said):
    text = change_of_scores([ErrorOnly(error) for error in errors])
    assert said in text and ("does not fit" in text) == (errors[1] > errors[0])


# --- the closed loop ---

LATE = 17  # one anchor of the hall is late


@pytest.fixture(scope="module", autouse=True)
def _short_flights():
    """Shorten the flights of the hall; the demo flies longer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flown, "HALL", replace(flown.HALL, duration=26.0))
        yield


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the bags of a hall."""
    return flown.record(LATE, tmp_path_factory.mktemp("recorded"))


def test_rosbags_reads_the_recordings_by_their_names(recorded):
    """AnyReader takes a folder that is named *.bag for a bag of ROS 1."""
    with AnyReader(recorded) as reader:
        assert {"/uwb/tdoa", "/imu/data"} <= {each.topic for each in reader.connections}


@pytest.fixture(scope="module")
def loop(recorded):
    """Run the demo with these recordings. Return its folder, its output and its Diagnosis."""
    folder, printed, found = recorded[0].parent, io.StringIO(), []

    def recordings(*given):
        assert given == (LATE, folder)
        return recorded

    def undeclared(flights, **options):
        """Diagnose while no effect is declared."""
        assert [flight.name for flight in flights] == ["flight-1", "flight-2"]
        with pytest.MonkeyPatch.context() as patch:
            for module in (inject, flown):
                patch.delattr(module, "hidden_effect")
            patch.setattr(inject, "KINDS", {})
            found.append(diagnose(flights, **options))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(flown, "record", recordings)
        patch.setattr(flown, "diagnose", undeclared)
        words = ["--seed", str(LATE), "--out", str(folder), "--json", str(folder / "demo.json")]
        assert demo.main(words) == 0
    return SimpleNamespace(folder=folder, out=printed.getvalue(), diagnosis=found[0])


@pytest.fixture(scope="module")
def diagnosis(loop):
    """Return the Diagnosis of the first two recordings. No effect is declared."""
    return loop.diagnosis


@pytest.mark.slow
def test_the_diagnosis_needs_the_recordings_alone(diagnosis):
    """The diagnosis finds the effect although its declaration is removed."""
    really = inject.hidden_effect(LATE, corners())
    found = diagnosis.effects.where(lambda effect: "tdoa" in effect.channels)
    assert [effect.name for effect in found] == [really.name] == ["anchor_delay"]
    ((anchor, late),) = really.values.items()
    others = [value for key, value in found.effects[0].values.items() if key != anchor]
    by = found.effects[0].values[anchor] - (np.mean(others) if others else 0.0)
    assert by == pytest.approx(late, abs=0.01)


@pytest.mark.slow
def test_no_recording_declares_the_effect(recorded):
    words = [word.encode() for word in ("anchor_delay", "hidden", "injected")]
    for bag in recorded:
        content = b"".join(path.read_bytes() for path in bag.rglob("*") if path.is_file())
        assert not any(word in content for word in words)
        (flight,) = flown.read([bag])
        assert not {"config", "parameters"} & set(flight.meta) and not flight.extra


@pytest.mark.slow
def test_the_correction_takes_the_residual_of_the_third_flight_away(recorded, diagnosis, tmp_path):
    written = flown.write_correction(tmp_path / "bias.onnx", diagnosis)
    assert [effect.name for effect in written.effects] == ["anchor_delay"]
    (third,) = flown.read(recorded[2:])
    model = load_network(tmp_path / "bias.onnx")
    corrector = corrector_of(third, None, tmp_path / "bias.onnx")
    before, after = residuals_of(third), residuals_of(third, corrector)
    ((anchor, late),) = inject.hidden_effect(LATE, third.anchors).values.items()
    assert all(anchor in pair.split("-") for pair in before.largest(2))
    assert before.constant == pytest.approx(late * np.sqrt(2 / 8), rel=0.1)  # 2 of 8 pairs
    assert before.size > 5 * after.size and before.changing < 0.03 and after.size < 0.03
    raw, corrected = (
        score_of(third, FlightEstimator(network=one))[0].row()["rmse_3d"] for one in (None, model)
    )
    assert corrected < 0.3 * raw


@pytest.mark.slow
def test_nothing_is_written_where_nothing_helps(diagnosis, tmp_path):
    nothing = replace(diagnosis, effects=EffectSet())
    assert flown.write_correction(tmp_path / "bias.onnx", nothing) is None
    assert not list(tmp_path.iterdir())
    assert flown.added_in_words(tmp_path, None, nothing)[0].startswith("nothing: ")


@pytest.fixture(scope="module")
def sound():
    """Return a flight of the hall without a hidden effect. Its error is below 5 cm."""
    flight = simulate(replace(flown.HALL, seed=9, yaw="rotating"))
    assert rmse(flight) < 0.05
    return flight


def rmse(flight, effects=None):
    """Return the 3D RMSE of a flight, m."""
    return score_of(flight, FlightEstimator(effects=effects))[0].row()["rmse_3d"]


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind == "lever arm" else pytest.param(kind, marks=pytest.mark.slow)
        for kind in inject.KINDS
    ],
)
def test_every_kind_of_hidden_effect_costs_something(kind, sound):
    """Each effect causes an error of 0.08 to 0.7 m. Its correction at least halves the error."""
    effect = inject.KINDS[kind](np.random.default_rng(1), corners())
    raw, corrected = (rmse(effect.inject(sound), by) for by in (None, EffectSet((effect,))))
    assert 0.08 < raw < 0.7 and corrected < 0.5 * raw


def test_a_seed_draws_one_effect_and_seeds_draw_all_kinds():
    drawn = [inject.hidden_effect(seed, corners()) for seed in range(1, 101)]
    assert drawn[3] == inject.hidden_effect(4, corners())
    assert len({effect.label.rpartition(" over ")[2] for effect in drawn}) == len(inject.KINDS)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["the loop", "a given flight"])
def test_no_error_is_printed_if_messages_were_lost(
    recorded, diagnosis, tmp_path, capsys, monkeypatch, command
):
    outcome = {"used": 10, **dict.fromkeys(flown.MISSING, 0), "late": 1, "lost": 917}
    monkeypatch.setattr(flown, "through_nodes", lambda *_: flown.LivePass(outcome, None))
    monkeypatch.setattr(flown, "record", lambda *_: recorded)
    monkeypatch.setattr(flown, "diagnose", lambda *_, **__: diagnosis)
    figures = tmp_path / "demo.json"
    words = {
        "the loop": ["--seed", str(LATE), "--json", str(figures)],
        "a given flight": ["--flight", str(recorded[2]), "--rate", "0.6"],
    }[command]
    assert demo.main([*words, "--out", str(tmp_path)]) == 1
    printed, suggested = capsys.readouterr(), {"the loop": "0.5", "a given flight": "0.3"}[command]
    text = "none: the machine is too slow: 918 messages were lost or late; try --rate "
    assert lines_of(printed, "error") == [f"error      {text}{suggested}"]
    assert "RMSE" not in printed.out and not list(tmp_path.glob("*.png"))
    if command == "the loop":
        content = json.loads(figures.read_text())
        assert content["errors"] is content["residual_rms"] is None
        assert content["outcomes"] == [outcome]


def lines_of(printed, title):
    return [line for line in printed.out.splitlines() if line.startswith(title)]


@pytest.mark.slow
def test_the_loop_through_the_real_nodes(loop, recorded):
    for title in ("recorded", "residual", "traced to  anchor_delay", "added", "flown", "error"):
        assert len(lines_of(loop, title)) == 1, title
    assert "no message lost or late" in lines_of(loop, "flown")[0]
    assert lines_of(loop, "really     anchor_delay: 6 = 0.286 (m)")
    content = json.loads((loop.folder / "demo.json").read_text())
    errors = [row["rmse_3d"] for row in content["errors"]]
    assert errors[1] < 0.3 * errors[0]
    (third,) = flown.read(recorded[2:])
    for name, model in (("without", None), ("with", load_network(loop.folder / "bias.onnx"))):
        live = read_odometry(loop.folder / name / "recorded_bag")
        offline = FlightEstimator(network=model)(third).odometry
        n = len(live.t)
        assert n > len(offline) - 5  # the nodes wait for messages after the last TDOA
        for field in ("t", "p", "q"):
            np.testing.assert_array_equal(getattr(live, field), getattr(offline, field)[:n])
    assert (loop.folder / "demo.png").stat().st_size > 10_000


# --- a measured flight ---


def figures(line):
    """Return the numbers in a line of the table of errors."""
    return [float(word) for word in line.split()[-6:]]


@pytest.mark.slow
def test_a_given_flight_through_the_real_nodes(recorded, diagnosis, tmp_path, capsys):
    diagnosis.effects.to_yaml(tmp_path / "effects.yaml")
    words = ["--flight", str(recorded[2]), "--effects", str(tmp_path / "effects.yaml")]
    assert demo.main([*words, "--rate", "20", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    raw, corrected, without_ros = (
        next(figures(line) for line in lines if line.startswith(name))
        for name in ("raw  ", "corrected  ", "corrected, without ROS")
    )
    assert corrected[3] < 0.6 * raw[3]  # 3D RMSE
    assert "lost or late" not in printed.err and "uwb_tdoa_tools check" in lines[-3]
    assert corrected == pytest.approx(without_ros, abs=1.01e-3)
    for name in ("flight_bag", "recorded_bag", "error.png"):
        assert (tmp_path / "out" / name).exists()


def test_the_set_up_is_no_time_of_the_demo():
    """`./dev` compiles in processes of its own, and then becomes the demo."""
    done = python(
        "-c",
        "import os, subprocess, sys\n"
        "subprocess.run([sys.executable, '-c', 'for _ in range(10**7): pass'])\n"
        "before = sum(os.times()[2:4])\n"
        "from uwb_tdoa_tools.flying.demo import processor_time\n"
        "print(before, sum(os.times()[:4]) - processor_time())",
    )
    of_set_up, left_out = map(float, done.stdout.split())
    assert of_set_up > 0.05 and left_out == pytest.approx(of_set_up, abs=0.02)
