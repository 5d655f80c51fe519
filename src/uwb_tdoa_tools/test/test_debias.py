# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""debias: maps of the position bias, from flights and from places."""

from dataclasses import replace
import json
import re

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.debias import BiasMap
from uwb_tdoa_tools import debiasing
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.debias import main
from uwb_tdoa_tools.debiasing import part_of, static_parts
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import corners

BIAS = np.array([0.1, -0.2])


@pytest.fixture
def points(tmp_path):
    """Write a CSV file of 4 x 4 places with five positions each, all with the error BIAS."""
    places = np.stack(np.meshgrid(range(4), range(4)), axis=-1).reshape(-1, 2) * 0.5
    rows = [
        [*place, *(place + BIAS + shift)]
        for place in places
        for shift in np.linspace(-0.01, 0.01, 5)
    ]
    np.savetxt(tmp_path / "points.csv", rows, "%.4f", ",", header="true_x,true_y,x,y", comments="")
    return tmp_path / "points.csv"


def test_points_become_a_map(tmp_path, points, capsys):
    corners().to_yaml(tmp_path / "anchors.yaml")
    options = ["--survey", str(tmp_path / "anchors.yaml"), "--out", str(tmp_path / "m.npz")]
    assert main(["fit", "--static", str(points), "--step", "0.5", *options]) == 0
    found = BiasMap.load(tmp_path / "m.npz")
    assert found.source == "points.csv"
    np.testing.assert_allclose(found.bias, np.tile(BIAS, (16, 1)), atol=1e-6)
    assert found.belongs_to(corners()) and not found.belongs_to(corners(8.0))
    assert "16 markers 0.5 m apart" in capsys.readouterr().out


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Write two bags of flights through the same biases, over a whole plane."""
    folder = tmp_path_factory.mktemp("flights")
    for name, speed in (("one", 1.0), ("two", 0.8)):
        config = SimulationConfig(
            seed=4,
            duration=40.0,
            imu_rate=100.0,
            truth_rate=50.0,
            start_in_air=True,
            multipath=False,
            speed=speed,
        )
        write_bag(simulate(config), folder / f"{name}.bag")
    return folder


@pytest.mark.slow
def test_flights_make_a_map_and_are_judged_by_it(tmp_path, flights, capsys):
    one, two, out = str(flights / "one.bag"), str(flights / "two.bag"), str(tmp_path / "m.npz")
    written = str(tmp_path / "written.json")
    assert main(["fit", one, "--holdout", two, "--out", out, "--json", written]) == 0
    figures = json.loads((tmp_path / "written.json").read_text())
    (row,) = figures["held out"]
    assert row["after"]["rmse_y"] < 0.95 * row["before"]["rmse_y"]
    assert row["after"]["rmse_z"] == pytest.approx(row["before"]["rmse_z"])
    assert figures["map"]["markers"] > 30 and figures["map"]["frame"] == "map"
    assert "held out" in capsys.readouterr().out

    assert main(["judge", out, two, "--json", written]) == 0
    judged = json.loads((tmp_path / "written.json").read_text())
    assert judged["runs"] == [row]
    assert judged["gain"] == pytest.approx(1.0 - row["after"]["rmse_3d"] / row["before"]["rmse_3d"])
    expected = f"better: the 3D RMSE falls by {100 * judged['gain']:.0f} % on these flights"
    assert expected in capsys.readouterr().out


def wrong_map(path, bias, anchors):
    """Write a map with one bias in the whole room."""
    cell = np.stack(np.meshgrid(range(-5, 6), range(-5, 6)), axis=-1).reshape(-1, 2)
    own = {"ids": anchors.ids, "positions": anchors.positions}
    bias = np.tile(bias, (len(cell), 1))
    BiasMap(1.0 * cell, bias, np.zeros((2, 2)), 1.0, **own).save(path)


@pytest.mark.parametrize(
    ("bias", "shift", "code", "text"),
    [
        ([-1.0, -1.0], 0.0, 1, r"harm: the 3D RMSE rises by \d+ % on these flights; do not use"),
        ([0.0, 0.0], 0.05, 0, "no gain: the 3D RMSE stays on these flights"),
        ([0.0, 0.0], 0.5, 2, "its anchors are not those that the map was made for"),
    ],
)
def test_a_map_is_judged(tmp_path, flights, capsys, bias, shift, code, text):
    moved = corners().at(corners().positions + [shift, 0.0, 0.0])
    wrong_map(tmp_path / "m.npz", bias, moved)
    assert main(["judge", str(tmp_path / "m.npz"), str(flights / "one.bag")]) == code
    assert re.search(text, "".join(capsys.readouterr()))


@pytest.mark.slow
def test_a_map_that_does_harm_where_it_took_no_part_is_not_written(
    tmp_path, flights, monkeypatch, capsys
):
    one, two, out = str(flights / "one.bag"), str(flights / "two.bag"), tmp_path / "m.npz"
    made = debiasing.fit_map
    monkeypatch.setattr(
        debiasing,
        "fit_map",
        lambda *args, **options: (m := made(*args, **options)) and replace(m, bias=-5.0 * m.bias),
    )
    assert main(["fit", one, "--holdout", two, "--out", str(out)]) == 1
    assert not out.exists()
    assert "m.npz is not written: harm: the 3D RMSE rises by" in capsys.readouterr().out


@pytest.mark.slow
def test_as_much_of_a_map_is_taken_as_flights_left_out_bear_out(tmp_path, flights, capsys):
    both, written = [str(flights / "one.bag"), str(flights / "two.bag")], tmp_path / "fit.json"
    assert main(["fit", *both, "--out", str(tmp_path / "m.npz"), "--json", str(written)]) == 0
    told = json.loads(written.read_text())["borne_out"]
    # both bags hold flights with the same name
    assert len(told["left_out"]) == 2 and told["gain"] > 0.0 and told["share"] > 0.0
    assert "expected of flights like these" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["fit", "--out", "m.npz"], "FLIGHT: there is none"),
        (["fit", "--static", "POINTS", "--step", "0", "--out", "m.npz"], "--step: 0.0"),
        (["fit", "--static", "POINTS", "--out", "m.npz"], "--survey: .* holds no anchors"),
        (["fit", "--static", "TEXT", "--out", "m.npz"], "line 3: x is .one.; it must be"),
        (["fit", "--static", "EMPTY", "--out", "m.npz"], "holds no positions"),
        (
            ["fit", "FLIGHTS/one.bag", "--holdout", "FLIGHTS", "--out", "m.npz"],
            "one.bag is also a FLIGHT",
        ),
        (["judge", "POINTS", "FLIGHTS/one.bag"], "is no position bias map"),
    ],
)
def test_what_cannot_be_used_is_refused(
    tmp_path, points, flights, monkeypatch, capsys, arguments, named
):
    monkeypatch.chdir(tmp_path)
    head = "true_x,true_y,x,y\n"
    for name, text in {"TEXT": head + "0,0,0,0\n1,1,one,1\n", "EMPTY": head}.items():
        (tmp_path / name).write_text(text)
    for name, path in {"POINTS": str(points), "FLIGHTS": str(flights)}.items():
        arguments = [argument.replace(name, path) for argument in arguments]
    assert main(arguments) == 2
    assert re.search(f"debias.* error: .*{named}", capsys.readouterr().err.splitlines()[-1])
    assert not (tmp_path / "m.npz").exists()


# --- parts ---


def flown(trajectory):
    config = SimulationConfig(
        seed=2,
        duration=6.0,
        imu_rate=100.0,
        truth_rate=50.0,
        start_in_air=True,
        place=(0.5, 0.3),
        height=1.5,
        trajectory=trajectory,
    )
    return simulate(config)


def test_part_of_a_flight_is_its_airborne_odometry_beside_the_truth():
    score, run = evaluate(flown("circle"))
    part = part_of(score, run.odometry)
    np.testing.assert_allclose(part.measured - part.true, score.error[:, :2], atol=1e-12)
    np.testing.assert_array_equal(part.covariance, score.covariance[:, :2, :2])


def test_a_recording_at_rest_is_one_place_and_one_that_moves_is_none(tmp_path):
    for name in ("hover", "circle"):
        write_bag(flown(name), tmp_path / f"{name}.bag")
    (part,) = static_parts(tmp_path / "hover.bag")
    assert len(part) > 500 and np.ptp(part.true, axis=0).max() < 1e-6
    assert np.linalg.norm((part.measured - part.true).mean(axis=0)) < 0.5
    with pytest.raises(InputError, match="never stands still"):
        static_parts(tmp_path / "circle.bag")


def test_rows_of_one_place_are_one_part(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text("true_x, true_y, x, y, note\n0,0,0.1,0,a\n1,0,1.1,0,b\n0,0,0.3,0,c\n")
    one, two = static_parts(file)
    np.testing.assert_allclose(one.measured, [[0.1, 0.0], [0.3, 0.0]])
    np.testing.assert_allclose(two.true, [[1.0, 0.0]])
    assert one.covariance is None
