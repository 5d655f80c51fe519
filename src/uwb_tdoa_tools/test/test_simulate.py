import json

import pytest

from uwb_tdoa_tools.commands import simulate
from uwb_tdoa_tools.simulation import SimulationConfig

SHORT = ["--duration", "20", "--trajectory", "circle"]


def test_list_names_everything(capsys):
    assert simulate.main(["--list"]) == 0
    out = capsys.readouterr().out
    for name in ("rising_circle", "spin", "corners", "planar", "random-SEED"):
        assert name in out


def test_writes_bag_json_and_plot(tmp_path, capsys):
    bag, report, picture = (
        tmp_path / "flight.bag",
        tmp_path / "flight.json",
        tmp_path / "flight.png",
    )
    assert (
        simulate.main([*SHORT, "--out", str(bag), "--json", str(report), "--plot", str(picture)])
        == 0
    )
    assert (bag / "metadata.yaml").is_file()
    content = json.loads(report.read_text())
    assert content["imu_samples"] == 20_000 and content["config"]["trajectory"] == "circle"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(bag) in capsys.readouterr().out


def test_an_existing_bag_is_kept_unless_forced(tmp_path, capsys):
    bag = tmp_path / "flight.bag"
    assert simulate.main([*SHORT, "--out", str(bag)]) == 0
    before = {path: path.read_bytes() for path in bag.iterdir()}
    assert simulate.main([*SHORT, "--seed", "1", "--out", str(bag)]) == 2
    assert {path: path.read_bytes() for path in bag.iterdir()} == before
    assert "simulate: error: " in capsys.readouterr().err
    assert simulate.main([*SHORT, "--seed", "1", "--out", str(bag), "--force"]) == 0
    assert {path: path.read_bytes() for path in bag.iterdir()} != before


def test_options_reach_the_configuration(tmp_path):
    report, anchors = tmp_path / "r.json", tmp_path / "a.yaml"
    SimulationConfig().complete()[0].anchors.to_yaml(anchors)
    options = (
        "--protocol tdoa3 --seed 4 --noise 0.02 --shared-noise --no-bias --no-outliers "
        "--no-multipath"
    )
    options += " --perfect-imu --yaw rotating --height 1.1 --speed 0.8 --start-in-air"
    options += " --height-noise 0.02 --pressure-noise 0.3 --velocity-noise 0.1"
    options += f" --anchors {anchors} --json {report}"
    assert simulate.main([*SHORT, *options.split()]) == 0
    content = json.loads(report.read_text())
    config = content["config"]
    assert {
        k: config[k]
        for k in ("protocol", "seed", "noise_std", "shared_noise", "bias", "multipath", "yaw")
    } == {
        "protocol": "tdoa3",
        "seed": 4,
        "noise_std": 0.02,
        "shared_noise": True,
        "bias": False,
        "multipath": False,
        "yaw": "rotating",
    }
    assert (config["height"], config["speed"], config["outlier_probability"]) == (1.1, 0.8, 0.0)
    assert [config[f"{stream}_noise"] for stream in ("height", "pressure", "velocity")] == [
        0.02,
        0.3,
        0.1,
    ]
    assert config["start_in_air"] and content["parameters"]["take_off"] is None
    assert set(config["imu_errors"].values()) == {0.0}
    assert content["bias_std"] == content["multipath_std"] == content["outliers"] == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--duration", "3"], "duration: 3 s"),
        (["--constellation", "nowhere"], "constellation: 'nowhere'"),
        (["--speed", "nan"], "speed: nan"),
        (["--anchors", "missing.yaml"], "missing.yaml"),
        (["--plot", "picture.docx"], "plot: picture.docx"),
        (["--json", "no/such/place.json"], "no/such/place.json"),
        (["--trajectory", "loop"], "invalid choice: 'loop'"),
        (["--constellation", "six", "--anchors", "a.yaml"], "not allowed with"),
    ],
)
def test_bad_input_is_told_in_one_sentence(options, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert simulate.main([*options, "--out", "flight.bag"]) == 2
    err = capsys.readouterr().err
    assert says in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
