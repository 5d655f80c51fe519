import shlex
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")
import known_answer  # noqa: E402

from uwb_tdoa_tools.commands import calibrate, check, demo, localize  # noqa: E402
from uwb_tdoa_tools.flying.demo import DemoFlight, next_steps  # noqa: E402
from uwb_tdoa_tools.simulation.rooms import corners


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--rate", "0"], "--rate: 0 is not a speed; give a number above 0."),
        (
            ["--survey", "survey.txt"],
            "--survey: needs --flight; a simulated flight has its own anchors.",
        ),
        (["--flight", "nowhere.log"], "nowhere.log: does not exist"),
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
    """A Score with nothing but its error."""

    def __init__(self, error):
        self.error = error

    def row(self):
        return {"rmse_3d": self.error, "diverged": False}


def test_it_says_what_corrects_and_that_nothing_does_unless_it_is_asked_for(tmp_path):
    plain = DemoFlight(None, None, None)
    assert plain.corrector() is None and plain.correction().startswith(
        "nothing: neither --effects nor --model is given"
    )
    model = known_answer.write(tmp_path)
    given = DemoFlight(SimpleNamespace(anchors=corners()), None, str(model)).correction()
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
    text = demo._change_in_words([ErrorOnly(error) for error in errors])
    assert said in text and ("does not fit" in text) == (errors[1] > errors[0])


def figures(line):
    """The numbers in a line of the table of errors."""
    return [float(word) for word in line.split()[-6:]]


@pytest.mark.slow
def test_a_simulated_flight_through_the_real_nodes(tmp_path, capsys):
    assert demo.main(["--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert any(line.startswith("flown      by the estimate: landed ") for line in lines)
    raw, corrected, without_ros = (
        next(figures(line) for line in lines if line.startswith(name))
        for name in ("raw  ", "corrected  ", "corrected, without ROS")
    )
    assert corrected[3] < 0.6 * raw[3]  # 3D RMSE
    assert "lost or late" not in printed.err and "uwb_tdoa_tools check" in lines[-3]
    assert corrected == pytest.approx(without_ros, abs=1.01e-3)
    for name in ("flight.bag", "recorded.bag", "effects.yaml", "error.png"):
        assert (tmp_path / name).exists()
