# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""An option and a file give the same setting.

The option overrides the file, or is refused with a message. Nothing is ignored silently.
"""

from dataclasses import replace
import shutil

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")  # of demo

from uwb_tdoa_bias.common.survey import read_survey  # noqa: E402
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, Covariance, EffectSet, TagLeverArm  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_bag, write_bag  # noqa: E402
from uwb_tdoa_tools.commands import (
    check,
    convert,
    debias,
    demo,
    diagnose,
    evaluate,
    inject,
    survey,
)  # noqa: E402
from uwb_tdoa_tools.estimate import with_antenna  # noqa: E402
from uwb_tdoa_tools.evaluating import Evaluator
from uwb_tdoa_tools.simulation import SimulationConfig, simulate  # noqa: E402

CLEAN = dict(
    duration=14.0,
    floor_time=1.0,
    tdoa_rate=200.0,
    imu_rate=100.0,
    bias=False,
    multipath=False,
    outlier_probability=0.0,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a folder with a bag whose anchors are wrong, and a correct survey."""
    folder = tmp_path_factory.mktemp("made")
    flight = simulate(SimulationConfig(seed=1, **CLEAN))
    flight.anchors.to_yaml(folder / "right.yaml")
    off = 0.4 * np.random.default_rng(2).standard_normal(flight.anchors.positions.shape)
    flight = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    write_bag(flight, folder / "flight.bag")
    return folder


@pytest.fixture
def desk(made, tmp_path, monkeypatch):
    """A working directory with copies of the made files."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rmse(words, monkeypatch):
    """Return the 3D RMSE of `evaluate`, m."""
    results, judge = [], Evaluator.__call__
    with monkeypatch.context() as patch:
        patch.setattr(
            Evaluator, "__call__", lambda self, one: results.append(judge(self, one)) or results[-1]
        )
        assert evaluate.main(words) == 0
    return results[0].row["rmse_3d"]


# --- --survey, and the anchors of a bag ---


@pytest.mark.slow
def test_evaluate_takes_the_survey(desk, monkeypatch, capsys):
    own, given = (
        rmse(["flight.bag", "--no-bias"], monkeypatch),
        rmse(["flight.bag", "--no-bias", "--survey", "right.yaml"], monkeypatch),
    )
    assert given < 0.5 * own
    assert "right.yaml count here, whatever anchors the bag holds" in capsys.readouterr().err


@pytest.mark.slow
def test_convert_and_inject_put_the_survey_into_the_bag(desk):
    right = read_survey("right.yaml").positions
    assert convert.main(["flight.bag", "--survey", "right.yaml", "--out", "new.bag"]) == 0
    assert (
        inject.main(
            [
                "flight.bag",
                "--survey",
                "right.yaml",
                "--effect",
                "anchor_delay",
                "--value",
                "0=0.1",
                "--out",
                "late.bag",
            ]
        )
        == 0
    )
    for bag in ("new.bag", "late.bag"):
        np.testing.assert_allclose(read_bag(bag).anchors.positions, right, atol=1e-9)
    assert not np.allclose(read_bag("flight.bag").anchors.positions, right, atol=0.01)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (check, ["flight.bag"]),
        (survey, ["flight.bag", "--out", "out"]),
        (diagnose, ["flight.bag", "--out", "out"]),
        (debias, ["fit", "flight.bag", "--out", "map.npz"]),
    ],
)
def test_every_tool_reads_the_recording_with_the_survey(desk, monkeypatch, command, words):
    """The tool reads the recording with the anchors of the survey."""
    seen = []
    module = {
        check: "uwb_tdoa_tools.checking.recording",
        debias: "uwb_tdoa_tools.readers.inputs",
    }.get(command, "uwb_tdoa_tools.readers.inputs")
    name = "_read_bag" if command is check else "read_flight"
    monkeypatch.setattr(
        f"{module}.{name}",
        lambda *args: (
            seen.append(args[2] if command is check else args[1]) or pytest.fail("enough")
        ),
    )
    with pytest.raises(BaseException, match="enough"):
        command.main([*words, "--survey", "right.yaml"])
    assert [str(one) for one in seen] == ["right.yaml"]


# --- other options, and files that say the same ---


@pytest.mark.slow
def test_a_parameter_counts_before_the_config(desk, monkeypatch):
    parameters = {"/**": {"ros__parameters": {"tdoa_std": 5.0}}}
    (desk / "ekf_node.yaml").write_text(yaml.safe_dump(parameters))
    words = ["flight.bag", "--survey", "right.yaml", "--no-bias"]
    plain = rmse(words, monkeypatch)
    of_file = rmse([*words, "--config", "ekf_node.yaml"], monkeypatch)
    both = rmse([*words, "--config", "ekf_node.yaml", "-p", "tdoa_std:=0.25"], monkeypatch)
    assert of_file != plain == both


def test_the_arm_of_an_effect_counts_before_that_of_a_bag(desk):
    flight = replace(read_bag("flight.bag"), meta={"antenna": [0.1, 0.0, 0.0]})
    own = EffectSet((TagLeverArm({"x": 0.0, "y": 0.2, "z": 0.0}),))
    assert with_antenna(own, flight) is own
    assert with_antenna(EffectSet(), flight).effects[0].values == {"x": 0.1, "y": 0.0, "z": 0.0}


def refused(command, words, sentence, capsys):
    assert command.main(words) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    "more",
    [
        ("--effects", "e.yaml"),
        ("--config", "c.yaml"),
        ("--model", "default"),
        ("-p", "loss:=huber"),
        ("--without", "height"),
        ("--smooth",),
        ("--no-bias",),
    ],
)
def test_options_of_the_estimate_are_refused_with_a_recorded_odometry(desk, capsys, more):
    sentence = f"{more[0]}: has no part in an odometry that was recorded"
    refused(evaluate, ["flight.bag", "--odometry", "flight.bag", *more], sentence, capsys)


KNOWN = {
    "marks": ["m.yaml"],
    "distances": ["d.csv"],
    "odometry": ["/vio"],
    "plan_flight": ["-3", "3", "-3", "3", "0", "3"],
}


@pytest.mark.parametrize(
    "reference, option",
    [(reference, option) for reference, some in diagnose.UNUSED.items() for option in some],
)
def test_options_that_a_reference_does_not_use_are_refused(desk, capsys, reference, option):
    name = option.replace("_", "-")
    sentence = f"--{name}: no part of it is used with --reference {reference}"
    refused(
        diagnose,
        ["flight.bag", "--reference", reference, f"--{name}", *KNOWN[option], "--out", "out"],
        sentence,
        capsys,
    )


@pytest.mark.parametrize(
    "more",
    [("--std", "0.2"), ("--height-std", "0.1"), ("--trusted", "0"), ("--trusted-std", "0.01")],
)
def test_options_of_the_tape_are_refused_with_a_calibration(desk, capsys, more):
    keys = (("anchor_position", "0.x"), ("anchor_delay", "0"))
    effects = (
        EFFECTS["anchor_position"]({"0.x": 0.0}, {"0.x": 0.1}),
        AnchorDelay({"0": 0.0}, {"0": 0.1}),
    )
    EffectSet(effects, Covariance(keys, 0.01 * np.eye(2))).to_yaml("effects.yaml")
    sentence = (
        f"{more[0]}: effects.yaml says how well each anchor is known, by its last calibration"
    )
    refused(
        survey, ["flight.bag", "--effects", "effects.yaml", *more, "--out", "out"], sentence, capsys
    )


@pytest.mark.parametrize("more", [("--topic", "uwb/tdoa=/x"), ("--namespace", "tag1")])
def test_topics_do_not_go_with_columns(desk, capsys, more):
    (desk / "a.csv").write_text("t,a,b,d\n0,1,2,0.1\n")
    words = [
        "a.csv",
        "--columns",
        "time=t,anchor_a=a,anchor_b=b,tdoa=d",
        "--survey",
        "right.yaml",
        *more,
        "--out",
        "new.bag",
    ]
    refused(
        convert,
        words,
        f"{more[0]}: says where topics are in bags, and --columns is of CSV files",
        capsys,
    )


def test_a_survey_does_not_go_with_a_simulated_demo(desk, capsys):
    refused(demo, ["--survey", "right.yaml", "--out", "out"], "--survey: needs --flight", capsys)
