from dataclasses import replace
import json

import numpy as np
import pytest
from scipy.stats import chi2
import yaml

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.effects.stamps import shifted
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.bags.files import new_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.commands.convert import main as convert
from uwb_tdoa_tools.commands.evaluate import main
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import ImuErrors, SimulationConfig, simulate

CLEAN = dict(
    duration=14.0,
    floor_time=1.0,
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


def write_odometry(path, odometry, covariance=None, space="", verdicts=()):
    """A bag with a nav_msgs/Odometry for each estimate on /odometry; covariance: 36 numbers,
    default the estimate's; space: before the topics; verdicts: one uwb/residual for each.
    """
    store = typestore()
    types = store.types

    def of(name, *values):
        package, kind = name.split("/")
        return types[f"{package}/msg/{kind}"](*values)

    with new_bag(path) as writer:
        connection = writer.add_connection(
            f"{space}/odometry", "nav_msgs/msg/Odometry", typestore=store
        )
        for k in range(len(odometry.t)):
            stamp = int(round(odometry.t[k] * 1e9))
            header = of(
                "std_msgs/Header", of("builtin_interfaces/Time", *divmod(stamp, 10**9)), "map"
            )
            pose = of(
                "geometry_msgs/Pose",
                of("geometry_msgs/Point", *odometry.p[k].tolist()),
                of("geometry_msgs/Quaternion", *odometry.q[k].tolist()),
            )
            whole = np.eye(6)
            whole[:3, :3] = odometry.covariance[k, :3, :3]
            whole = whole.ravel() if covariance is None else np.asarray(covariance, dtype=float)
            zero = of("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
            twist = of(
                "geometry_msgs/TwistWithCovariance",
                of("geometry_msgs/Twist", zero, zero),
                np.zeros(36),
            )
            message = of(
                "nav_msgs/Odometry",
                header,
                "base_link",
                of("geometry_msgs/PoseWithCovariance", pose, whole),
                twist,
            )
            writer.write(connection, stamp, store.serialize_cdr(message, connection.msgtype))
        if verdicts:
            residual = "uwb_tdoa_msgs/msg/TdoaResidual"
            connection = writer.add_connection(f"{space}/uwb/residual", residual, typestore=store)
        for verdict in verdicts:
            message = types[residual](header, 0, 1, 0.0, 1.0, 0.0, verdict)
            writer.write(connection, stamp, store.serialize_cdr(message, residual))
    return path


def report(arguments, tmp_path):
    """What `evaluate --json` writes."""
    file = tmp_path / "report.json"
    assert main([*map(str, arguments), "--json", str(file)]) == 0
    return json.loads(file.read_text())


def test_score_of_a_clean_flight(flight):
    score, result = evaluate(flight)
    row = score.row()
    assert row["rmse_3d"] < 0.1 and not row["diverged"]
    assert row["rmse_3d"] == pytest.approx(np.linalg.norm([row[f"rmse_{axis}"] for axis in "xyz"]))
    assert sum(result.counts.values()) == len(flight.tdoa) and result.counts["invalid"] == 0


def test_effects_reach_the_filter(flight):
    ids = flight.anchors.ids
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    delay = 0.4 * np.isin(ids, ids[:2])
    wrong = replace(flight, tdoa=replace(flight.tdoa, d=flight.tdoa.d + delay[b] - delay[a]))
    effects = EffectSet((AnchorDelay(dict.fromkeys(ids[:2].tolist(), 0.4)),))
    without, clean = evaluate(wrong)[0].row()["rmse_3d"], evaluate(flight)[0].row()["rmse_3d"]
    assert evaluate(wrong, effects=effects)[0].row()["rmse_3d"] == pytest.approx(clean, abs=1e-6)
    assert without > clean + 0.05


def test_no_truth_is_bad_input(flight):
    with pytest.raises(InputError, match="ground truth"):
        evaluate(replace(flight, truth=None))


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
    told = report([bag, bag, "--no-bias", "--markdown", tmp_path / "table.md"], tmp_path)
    assert [run["phases"] for run in told["runs"]] == [one["phases"]] * 2
    for name, figures in told["pooled"]["phases"].items():
        assert figures["runs"] == 2 and figures["rmse_3d"] == pytest.approx(
            one["phases"][name]["rmse_3d"]
        ), name
    for text in (capsys.readouterr().out, (tmp_path / "table.md").read_text()):
        for title in (
            "at rest before, 2 s",
            "first 3 s",
            "last 3 s",
            "at rest after",
            "whole recording",
        ):
            assert title in text


def test_a_smoothed_estimate_has_phases_too(bag, tmp_path):
    phases = report([bag, "--no-bias", "--smooth"], tmp_path)["runs"][0]["phases"]
    assert phases["at_rest_before"]["count"] > 50 and phases["at_rest_after"]["rmse_3d"] < 0.1


def test_a_recording_of_a_rover_is_judged(flight, tmp_path, capsys):
    """It never exceeds 0.3 m."""
    down = [0.0, 0.0, 1.2]
    anchors = replace(flight.anchors, positions=flight.anchors.positions - down)
    truth = replace(flight.truth, p=np.minimum(flight.truth.p, [np.inf, np.inf, 1.2]) - down)
    write_bag(replace(flight, anchors=anchors, truth=truth), tmp_path / "rover")
    (row,) = report([tmp_path / "rover", "--no-bias"], tmp_path)["runs"]
    assert (
        row["part"] == "moving"
        and row["phases"]["moving"]["count"] > 100
        and "in_the_air" not in row["phases"]
    )
    assert "moving" in capsys.readouterr().out


def test_what_was_kept_before_there_were_phases_is_refused(bag, tmp_path, capsys):
    kept = tmp_path / "kept"
    assert main([str(bag), "--no-bias", "--resume", str(kept)]) == 0
    first, line = map(json.loads, kept.read_text().splitlines())
    del first["asked"]["version of the figures"], line["result"]["phases"]
    kept.write_text(f"{json.dumps(first)}\n{json.dumps(line)}\n")
    assert main([str(bag), "--no-bias", "--resume", str(kept)]) == 2
    assert "its results were made with another version of the figures" in capsys.readouterr().err


FORGED = (
    "5",
    "{}",
    '{"row": {}, "sums": {}, "distributions": {}, "phases": {}}',
    '{"row": [], "sums": 1, "distributions": {}, "phases": {}}',
)


def test_a_result_that_somebody_has_forged_is_refused(bag, tmp_path, capsys):
    kept = tmp_path / "kept"
    options = [str(bag), "--no-bias", "--resume", str(kept)]
    assert main(options) == 0
    first, line = kept.read_text().splitlines()
    forged = [json.loads(result) for result in FORGED] + [
        json.loads(line)["result"] for _ in range(3)
    ]
    forged[-3]["row"]["rmse_3d"] = "a"
    forged[-2]["distributions"]["distance"][3] = [0, 1]
    forged[-1]["phases"]["in_the_air"] = {}
    for result in forged:
        kept.write_text(
            f"{first}\n{json.dumps({'key': json.loads(line)['key'], 'result': result})}\n"
        )
        capsys.readouterr()
        assert main(options) == 2, result
        assert "kept: holds something else than results" in capsys.readouterr().err
    kept.write_text(f"{first}\n{line}\n")
    assert main(options) == 0


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


def test_no_bias_runs_without_effects(flight, bag, tmp_path):
    effects = tmp_path / "effects.yaml"
    EffectSet((AnchorDelay({int(flight.anchors.ids[0]): 0.8}),)).to_yaml(effects)
    plain = report([bag, "--no-bias"], tmp_path)["runs"]
    spoiled = report([bag, "--effects", effects], tmp_path)["runs"]
    assert report([bag, "--effects", effects, "--no-bias"], tmp_path)["runs"] == plain
    assert spoiled[0]["rmse_3d"] > plain[0]["rmse_3d"] + 0.05


def test_parameters_reach_the_filter(bag, tmp_path):
    config = tmp_path / "ekf_node.yaml"
    config.write_text("ekf_node:\n  ros__parameters:\n    tdoa_std: 2.0\n")
    plain, other = report([bag], tmp_path), report([bag, "--config", config], tmp_path)
    assert other["runs"][0]["nis_mean"] < 0.3 * plain["runs"][0]["nis_mean"]


def test_several_flights_are_pooled(bag, tmp_path, capsys):
    told = report([bag, bag], tmp_path)
    assert len(told["runs"]) == 2
    assert told["pooled"]["rmse_3d"] == pytest.approx(told["runs"][0]["rmse_3d"])
    out = capsys.readouterr().out
    assert "2 pooled" in out and "diverged 0" in out


def test_an_interrupted_run_over_many_goes_on_where_it_was(tmp_path, capsys):
    short = simulate(
        SimulationConfig(
            seed=2,
            duration=4.0,
            start_in_air=True,
            imu_rate=100.0,
            truth_rate=50.0,
            protocol="tdoa3",
        )
    )
    bags, kept, alone = (
        [tmp_path / name for name in ("one", "two", "three")],
        tmp_path / "kept",
        ["--jobs", "1"],
    )
    for bag in bags:
        write_bag(short, bag)
    whole = report([*bags, "--no-bias", *alone], tmp_path)
    assert main([*map(str, bags[:2]), "--no-bias", "--resume", str(kept), *alone]) == 0
    first = kept.read_bytes()
    kept.write_bytes(first[:-20])  # the second was being written
    capsys.readouterr()
    assert report([*bags, "--no-bias", "--resume", kept, *alone], tmp_path) == whole
    assert "holds 1 of 3 flights; going on with the others" in capsys.readouterr().err
    assert kept.read_bytes().startswith(first)
    assert report([*bags, "--no-bias", "--resume", kept, *alone], tmp_path) == whole
    assert "holds 3 of 3 flights" in capsys.readouterr().err
    assert main([*map(str, bags), "--smooth", "--resume", str(kept)]) == 2
    assert "made with another no_bias and smooth" in capsys.readouterr().err


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


def test_recorded_odometry_without_covariance_is_judged(odometry, bag, tmp_path):
    recorded = write_odometry(tmp_path / "recorded", odometry, np.zeros(36))
    assert report([bag, "--odometry", recorded], tmp_path)["runs"][0]["rmse_3d"] < 0.1


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
    """RFC 8259 has no NaN and no Infinity, which such a run could bring in."""
    few = {name: getattr(flight.tdoa, name)[:5] for name in "tabd"}
    write_bag(replace(flight, tdoa=replace(flight.tdoa, **few)), tmp_path / "few")
    picture, file = tmp_path / "error.png", tmp_path / "report.json"
    assert main([str(tmp_path / "few"), "--plot", str(picture), "--json", str(file)]) == 1
    assert picture.exists()

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    found = json.loads(file.read_text(), parse_constant=refuse)
    assert found["runs"][0]["diverged"] is True


def test_table_beside_others(flight, bag, tmp_path):
    peers = tmp_path / "peers.csv"
    peers.write_text(
        "flight,peer,mode,rmse_x,rmse_y,rmse_z,rmse_3d,frac_gt_1m,diverged\n"
        f"{flight.name},firmware,std,0.1,0.1,0.1,0.1734,0.0,False\n"
        f"{flight.name},firmware,robust,9,9,9,15.6,0.9,True\n"
        "other,firmware,std,0.1,0.1,0.1,0.5,0.0,False\n"
    )
    assert main([str(bag), "--markdown", str(tmp_path / "table.md"), "--beside", str(peers)]) == 0
    header, rule, row = (
        line.strip("| ").split(" | ")
        for line in (tmp_path / "table.md").read_text().splitlines()[:3]
    )
    assert (
        header[0] == "flight"
        and header[-2:] == ["firmware std", "firmware robust"]
        and len(rule) == len(header)
    )
    assert row[0] == flight.name and row[-2:] == ["0.173", "diverged"]
    peers.write_text("name,error\nx,1\n")
    assert main([str(bag), "--markdown", str(tmp_path / "table.md"), "--beside", str(peers)]) == 2


def test_bad_usage(bag, tmp_path, capsys):
    assert main([]) == 2
    assert main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere: does not exist" in capsys.readouterr().err
    assert main([str(bag), str(bag), "--plot", str(tmp_path / "x.png")]) == 2
    assert "--plot: needs exactly one flight, got 2" in capsys.readouterr().err
    assert main([str(bag), "--config", str(tmp_path / "no.yaml")]) == 2
    assert main([str(bag), "--effects", str(tmp_path / "no.yaml")]) == 2
    assert main([str(bag), "--model", str(tmp_path / "no.onnx")]) == 2


def test_help_has_examples(capsys):
    assert main(["--help"]) == 0
    assert "evaluate flights/ --survey surveys/" in capsys.readouterr().out


@pytest.mark.slow
def test_a_simulated_flight_without_bias_is_consistent():
    """White TDOA noise of known size, an inertial sensor with noise and biases of the filter's kind
    and size: the NEES of the position averaged over 20 flights inside its 95 % chi-square bounds at
    90 % of the times after 3 s in the air, and the NIS of 80 % of the flights inside theirs
    (Bar-Shalom et al., sec. 5.4.2; 19 of 20 are expected, fewer than 16 happen once in 400 times to
    an honest filter).
    """
    noise = dict(accel_noise=0.05, gyro_noise=0.003, accel_bias_walk=0.01, gyro_bias_walk=1e-4)
    told = FilterConfig(
        robust="gate",
        gate=1e6,
        tdoa_std=0.1,
        tdoa_correlation_length=1.0,
        vibration_gain=0.0,
        adapt_noise=False,
        **noise,
    )
    errors = ImuErrors(
        **noise, accel_bias=told.initial_accel_bias_std, gyro_bias=told.initial_gyro_bias_std
    )
    clean = {**CLEAN, "duration": 25.0, "start_in_air": True, "noise_std": 0.1, "protocol": "tdoa3"}
    nees, nis = [], []
    for seed in range(20):
        score, result = evaluate(
            simulate(SimulationConfig(seed=seed, imu_errors=errors, **clean)), told
        )
        times = np.arange(score.first + 3.0, score.last - 0.1, 0.05)
        nees.append(score.nees[np.searchsorted(score.t, times)])
        nis.append(score.nis)
    nees = np.mean([values[: min(map(len, nees))] for values in nees], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 3 * 20) / 20
    inside = [
        np.prod(np.sign(chi2.ppf([0.025, 0.975], len(v)) / len(v) - v.mean())) < 0 for v in nis
    ]
    print(
        f"NEES {nees.mean():.2f}, {np.mean((nees > low) & (nees < high)):.0%} of the times inside; "
        f"NIS {np.mean([v.mean() for v in nis]):.3f}, {np.mean(inside):.0%} of the flights inside"
    )
    assert np.mean((nees > low) & (nees < high)) >= 0.9 and np.mean(inside) >= 0.8


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


def test_smoothing_is_better(bag, tmp_path):
    filtered, smoothed = report([bag], tmp_path), report([bag, "--smooth"], tmp_path)
    assert smoothed["runs"][0]["rmse_3d"] < 0.9 * filtered["runs"][0]["rmse_3d"]


def test_a_name_is_no_command_to_picture_table_or_terminal(flight, tmp_path, capsys):
    name, folder = "$\\frac$ <b>|\x1b[31m", tmp_path / "\x1b[2Jflights"
    folder.mkdir()
    write_bag(flight, folder / "bag")
    file = folder / "bag" / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    content["rosbag2_bagfile_information"]["custom_data"]["uwb_tdoa_tools.flight"] = json.dumps(
        {"name": name}
    )
    file.write_text(yaml.safe_dump(content))
    peers = tmp_path / "peers.csv"
    peers.write_text("flight,peer,mode,rmse_3d,diverged\nx,<script>,a|b,0.1,False\n")
    options = [
        "--plot",
        tmp_path / "error.png",
        "--markdown",
        tmp_path / "table.md",
        "--beside",
        peers,
    ]
    assert main([*map(str, [folder / "bag", *options])]) == 0
    assert (tmp_path / "error.png").stat().st_size > 10_000
    table = (tmp_path / "table.md").read_text()
    assert "| __frac_ _b____31m |" in table and "| _script_ a_b |" in table and "<" not in table
    assert main([str(folder / "none")]) == 2
    said = capsys.readouterr()
    assert (
        "\x1b" not in said.out + said.err
        and r"\x1b[2Jflights" in said.err
        and "__frac_ _b____31m" in said.out
    )


@pytest.mark.slow
def test_ground_truth_of_another_epoch_is_refused_or_aligned(flight, tmp_path, capsys):
    """It was evaluated to nan with exit code 0, and converted to a recording of 1.7e9 s."""
    other = shifted(flight, "truth", 1.7e9)
    write_bag(other, tmp_path / "epoch")
    assert main([str(tmp_path / "epoch")]) == 2
    assert (
        "on another clock than the TDOAs: its stamps go from 1700000000" in capsys.readouterr().err
    )
    assert (
        main([str(tmp_path / "epoch"), "--align", "time", "--json", str(tmp_path / "errors.json")])
        == 0
    )
    (run,) = json.loads((tmp_path / "errors.json").read_text())["runs"]
    assert "nan" not in capsys.readouterr().out and run["rmse_3d"] < 0.2
    assert (
        run["aligned"]["late"] == pytest.approx(1.7e9, abs=0.05)
        and run["aligned"]["rmse_3d_none"] is None
    )
    assert convert([str(tmp_path / "epoch"), "--out", str(tmp_path / "one")]) == 2
    assert (
        convert([str(tmp_path / "epoch"), "--align", "time", "--out", str(tmp_path / "one")]) == 0
    )
    capsys.readouterr()
    assert main([str(tmp_path / "one")]) == 0


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
