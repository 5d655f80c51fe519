# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import json

import numpy as np
import pytest
import yaml

from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.effects.sensor import shifted
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.bags.files import new_bag
from uwb_tdoa_tools.bags.messages import messages_of, odometry_content, typestore
from uwb_tdoa_tools.commands.evaluate import main
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

CLEAN = dict(
    duration=14.0,
    floor_time=1.0,
    tdoa_rate=200.0,
    imu_rate=200.0,
    bias=False,
    multipath=False,
    outlier_probability=0.0,
)
NEEDED = {
    "flight",
    "rmse_x",
    "rmse_y",
    "rmse_z",
    "rmse_3d",
    "median_3d",
    "max_3d",
    "frac_gt_1m",
    "diverged",
}


@pytest.fixture(scope="module")
def flight():
    return simulate(SimulationConfig(seed=1, **CLEAN))


@pytest.fixture(scope="module")
def bag(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("evaluate") / "flight"
    write_bag(flight, path)
    return path


@pytest.fixture(scope="module")
def odometry(flight):
    return run_offline(flight).odometry


def write_odometry(path, odometry, space="", verdicts=()):
    """Write a bag with a nav_msgs/Odometry for each estimate on /odometry.

    space : namespace of the topics
    verdicts : one uwb/residual for each
    """
    store, residual = typestore(), "uwb_tdoa_msgs/msg/TdoaResidual"
    with new_bag(path) as writer:
        kind = "nav_msgs/msg/Odometry"
        connection = writer.add_connection(f"{space}/odometry", kind, typestore=store)
        for stamp, message in messages_of(
            "odometry", kind, odometry.t, odometry_content(odometry), "map", store
        ):
            writer.write(connection, stamp, store.serialize_cdr(message, kind))
        if verdicts:
            connection = writer.add_connection(f"{space}/uwb/residual", residual, typestore=store)
        for verdict in verdicts:
            told = store.types[residual](message.header, 0, 1, 0.0, 1.0, 0.0, verdict)
            writer.write(connection, stamp, store.serialize_cdr(told, residual))
    return path


def report(arguments, tmp_path):
    """Return the content that `evaluate --json` writes."""
    file = tmp_path / "report.json"
    assert main([*map(str, arguments), "--json", str(file)]) == 0
    return json.loads(file.read_text())


def test_report_of_one_flight(flight, bag, tmp_path, capsys):
    told = report([bag, "--no-bias"], tmp_path)
    (row,) = told["runs"]
    assert NEEDED <= set(row) and NEEDED <= set(told["pooled"])
    assert row["flight"] == flight.name
    assert row["rmse_3d"] == pytest.approx(
        evaluate(flight)[0].row()["rmse_3d"], abs=1e-4
    )  # stamps are rounded to ns
    assert told["pooled"]["rmse_3d"] == row["rmse_3d"] and told["pooled"]["diverged"] == 0
    first, *table = capsys.readouterr().out.splitlines()
    assert first == "correcting with: nothing (neither effects nor a network are in use)"
    assert table[0].split()[:5] == ["flight", "x", "y", "z", "3D"]
    assert table[1].startswith(flight.name) and f"{row['rmse_3d']:.3f}" in table[1]


@pytest.mark.slow
def test_report_of_the_phases_of_one_flight_and_of_several(bag, tmp_path, capsys):
    one = report([bag, "--no-bias"], tmp_path)["runs"][0]
    expected = [
        "at_rest_before",
        "first_3_s",
        "to_0.3_m",
        "in_the_air",
        "last_3_s",
        "at_rest_after",
        "whole",
    ]
    assert list(one["phases"]) == expected and one["part"] == "in_the_air"
    assert one["phases"]["in_the_air"]["rmse_3d"] == pytest.approx(one["rmse_3d"])
    assert (
        0.0 < one["phases"]["at_rest_before"]["rmse_3d"] < 0.1
        and one["phases"]["at_rest_after"]["nees_mean"] < 9.0
    )
    assert (
        one["phases"]["at_rest_before"]["without_estimate"]
        > 0.0
        == one["phases"]["last_3_s"]["without_estimate"]
    )
    assert 0.0 < one["ready_delay"] < 1.0
    capsys.readouterr()
    told = report([bag, bag, "--no-bias"], tmp_path)
    assert [run["phases"] for run in told["runs"]] == [one["phases"]] * 2
    for name, figures in told["pooled"]["phases"].items():
        assert figures["runs"] == 2 and figures["rmse_3d"] == pytest.approx(
            one["phases"][name]["rmse_3d"]
        ), name
    text = capsys.readouterr().out
    for title in (
        "at rest before, 2 s",
        "first 3 s",
        "last 3 s",
        "at rest after",
        "whole recording",
    ):
        assert title in text


@pytest.mark.slow
def test_corrects_with_nothing_unless_effects_or_a_network_are_given(flight, bag, tmp_path, capsys):
    known_answer = pytest.importorskip("known_answer")
    model = known_answer.write(tmp_path)
    effects = tmp_path / "effects.yaml"
    EffectSet((AnchorDelay({int(flight.anchors.ids[0]): 0.1}),)).to_yaml(effects)
    (row,) = report([bag], tmp_path)["runs"]
    assert row["rmse_3d"] == pytest.approx(evaluate(flight)[0].row()["rmse_3d"], abs=1e-4)
    assert main([str(bag), "--effects", str(effects)]) == 0
    (row,) = report([bag, "--model", model], tmp_path)["runs"]
    assert row["rmse_3d"] == pytest.approx(
        evaluate(flight, network=load_network(model))[0].row()["rmse_3d"], abs=1e-4
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("correcting")] == [
        "correcting with: nothing (neither effects nor a network are in use)",
        "correcting with: anchor_delay",
        "correcting with: known_answer",
    ]


@pytest.mark.slow
def test_no_bias_runs_without_effects(flight, bag, tmp_path):
    effects = tmp_path / "effects.yaml"
    EffectSet((AnchorDelay({int(flight.anchors.ids[0]): 0.8}),)).to_yaml(effects)
    plain = report([bag, "--no-bias"], tmp_path)["runs"]
    spoiled = report([bag, "--effects", effects], tmp_path)["runs"]
    assert report([bag, "--effects", effects, "--no-bias"], tmp_path)["runs"] == plain
    assert spoiled[0]["rmse_3d"] > plain[0]["rmse_3d"] + 0.05


def test_recorded_odometry_is_judged(odometry, bag, tmp_path):
    off = replace(odometry, p=odometry.p + [0.3, 0.0, 0.0])
    recorded = write_odometry(tmp_path / "recorded", off)
    own, judged = (
        report([bag, "--no-bias"], tmp_path)["runs"][0],
        report([bag, "--odometry", recorded], tmp_path)["runs"][0],
    )
    assert judged["rmse_x"] == pytest.approx(0.3, abs=0.05)
    assert judged["rmse_y"] == pytest.approx(own["rmse_y"], abs=1e-3)
    assert judged["nees_mean"] > own["nees_mean"]


def test_odometry_of_a_tag_is_judged_against_the_flight_of_a_bag_without_namespace(
    odometry, bag, tmp_path, capsys
):
    recorded = write_odometry(tmp_path / "recorded", odometry, space="/tag1", verdicts=(0, 1))
    assert main([str(bag), "--odometry", str(recorded)]) == 2
    assert (
        "has no message on /odometry; say which to take (--topic odometry=/tag1/odometry)."
        in capsys.readouterr().err
    )
    judged = report([bag, "--odometry", recorded, "--topic", "odometry=/tag1/odometry"], tmp_path)[
        "runs"
    ][0]
    assert judged["rmse_3d"] < 0.1


def test_odometry_of_late_tdoas_gives_exit_code_1(odometry, bag, tmp_path, capsys):
    recorded = write_odometry(tmp_path / "recorded", odometry, verdicts=(0, 2, 1, 2))
    assert main([str(bag), "--odometry", str(recorded)]) == 1
    assert "2 TDOAs came too late for that filter" in capsys.readouterr().err


def test_flights_without_truth_are_refused_in_one_sentence(flight, odometry, tmp_path, capsys):
    write_bag(replace(flight, truth=None), tmp_path / "blind")
    recorded = write_odometry(tmp_path / "recorded", odometry)
    for more in ([], ["--odometry", str(recorded)]):
        assert main([str(tmp_path / "blind"), *more]) == 2
        assert "ground truth" in capsys.readouterr().err


@pytest.mark.slow
def test_picture_and_trajectories(flight, bag, tmp_path):
    assert (
        main([str(bag), "--plot", str(tmp_path / "error.png"), "--tum", str(tmp_path / "tum")]) == 0
    )
    assert (tmp_path / "error.png").read_bytes()[:4] == b"\x89PNG"
    for name, rate in ((flight.name, 200.0), (f"{flight.name}_truth", 250.0)):
        rows = np.loadtxt(tmp_path / "tum" / f"{name}.tum")
        assert rows.shape[1] == 8 and (np.diff(rows[:, 0]) > 0.0).all()
        assert np.median(np.diff(rows[:, 0])) == pytest.approx(1.0 / rate, rel=0.2)
        np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=1e-5)


def test_a_run_that_never_starts_has_a_picture_and_a_report_in_strict_json(flight, tmp_path):
    """RFC 8259 has no NaN and no Infinity. Such a run could contain them."""
    few = {name: values[:5] for name, values in vars(flight.tdoa).items()}
    write_bag(replace(flight, tdoa=replace(flight.tdoa, **few)), tmp_path / "few")
    picture, file = tmp_path / "error.png", tmp_path / "report.json"
    assert main([str(tmp_path / "few"), "--plot", str(picture), "--json", str(file)]) == 1
    assert picture.exists()

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    found = json.loads(file.read_text(), parse_constant=refuse)
    assert found["runs"][0]["diverged"] is True


def test_bad_usage(bag, tmp_path, capsys):
    assert main([]) == 2
    assert main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere: does not exist" in capsys.readouterr().err
    assert main([str(bag), str(bag), "--plot", str(tmp_path / "x.png")]) == 2
    assert "--plot: needs exactly one flight, got 2" in capsys.readouterr().err
    assert main([str(bag), "--config", str(tmp_path / "no.yaml")]) == 2
    assert main([str(bag), "--effects", str(tmp_path / "no.yaml")]) == 2
    assert main([str(bag), "--model", str(tmp_path / "no.onnx")]) == 2


def test_parameters_on_the_command_line_are_those_of_a_file(bag, tmp_path):
    file = tmp_path / "filter.yaml"
    file.write_text("ekf_node: {ros__parameters: {tdoa_std: 0.1, adapt_noise: false}}")
    one = report([bag, "--config", file, "-p", "loss:=huber"], tmp_path)
    other = report(
        [bag, "-p", "adapt_noise:=false", "-p", "tdoa_std:=0.1", "-p", "loss:=huber"], tmp_path
    )
    assert one["runs"][0] == other["runs"][0] != report([bag], tmp_path)["runs"][0]


@pytest.mark.parametrize(
    "text",
    ["tdoa_std=0.1", "sdt:=0.1", "tdoa_std:=[", "tdoa_std:=much", "adapt_noise:=1", ":=", ""],
)
def test_a_bad_parameter_is_told(bag, text, capsys):
    assert main([str(bag), "-p", text]) == 2
    assert "error" in capsys.readouterr().err


@pytest.mark.slow
def test_smoothing_is_better(bag, tmp_path):
    filtered, smoothed = report([bag], tmp_path), report([bag, "--smooth"], tmp_path)
    assert smoothed["runs"][0]["rmse_3d"] < 0.9 * filtered["runs"][0]["rmse_3d"]


@pytest.mark.slow
def test_a_name_is_no_command_to_picture_or_terminal(flight, tmp_path, capsys):
    name, folder = "$\\frac$ <b>|\x1b[31m", tmp_path / "\x1b[2Jflights"
    folder.mkdir()
    write_bag(flight, folder / "bag")
    file = folder / "bag" / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    content["rosbag2_bagfile_information"]["custom_data"]["uwb_tdoa_tools.flight"] = json.dumps(
        {"name": name}
    )
    file.write_text(yaml.safe_dump(content))
    assert main([*map(str, [folder / "bag", "--plot", tmp_path / "error.png"])]) == 0
    assert (tmp_path / "error.png").stat().st_size > 10_000
    assert main([str(folder / "none")]) == 2
    said = capsys.readouterr()
    assert (
        "\x1b" not in said.out + said.err
        and r"\x1b[2Jflights" in said.err
        and "__frac_ _b____31m" in said.out
    )


@pytest.mark.slow
def test_what_is_found_of_the_ground_truth_is_told_with_the_error_of_each(flight, tmp_path, capsys):
    write_bag(shifted(flight, "truth", 0.4), tmp_path / "late")
    errors = {}
    for how in ("none", "time", "frame"):
        assert (
            main([str(tmp_path / "late"), "--align", how, "--json", str(tmp_path / "errors.json")])
            == 0
        )
        (run,) = json.loads((tmp_path / "errors.json").read_text())["runs"]
        assert run["rmse_3d"] == run["aligned"][f"rmse_3d_{how}"]
        errors[how] = run["rmse_3d"]
        out, err = capsys.readouterr()
        assert (
            "its stamps 0.4" in out
            and "--align time" in out
            and ("judge with --align time" in err) == (how == "none")
        )
    assert errors["time"] < 0.5 * errors["none"] and errors["frame"] <= errors["time"] + 0.01
