import shlex

import pytest

pytest.importorskip("rclpy")
from uwb_tdoa_tools.commands import calibrate, check, demo, localize  # noqa: E402
from uwb_tdoa_tools.live.demo import next_steps  # noqa: E402


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--rate", "0"], "--rate: 0 is not a speed; give a number above 0."),
        (["--survey", "survey.txt"], "--survey: needs --flight; a simulated flight has its own anchors."),
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
        args = {"calibrate": calibrate, "check": check, "localize": localize}[name].parser().parse_args(rest)
        assert args.flights == [given[0]] and args.survey == (given[1] if len(given) > 1 else None)


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
