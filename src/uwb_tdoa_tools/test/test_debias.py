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
from uwb_tdoa_tools.simulation.rooms import corners

# --- debias ---


BIAS = np.array([0.1, -0.2, 0.05])


@pytest.fixture
def survey(tmp_path):
    corners().to_yaml(tmp_path / "anchors.yaml")
    return ["--survey", str(tmp_path / "anchors.yaml")]


@pytest.fixture
def points(tmp_path):
    """Write a CSV file of 4 x 4 x 3 places with five positions each, all with the error BIAS."""
    places = (
        np.stack(np.meshgrid(range(4), range(4), range(3), indexing="ij"), axis=-1).reshape(-1, 3)
        * 0.5
    )
    rows = [
        (*place, *(place + BIAS + shift))
        for place in places
        for shift in np.linspace(-0.01, 0.01, 5)
    ]
    text = "\n".join(",".join(f"{value:.4f}" for value in row) for row in rows)
    (tmp_path / "points.csv").write_text(f"true_x,true_y,true_z,x,y,z\n{text}\n")
    return tmp_path / "points.csv"


def test_points_become_a_map(tmp_path, points, survey, capsys):
    assert (
        main(
            [
                "fit",
                "--static",
                str(points),
                "--step",
                "0.5",
                *survey,
                "--out",
                str(tmp_path / "m.npz"),
            ]
        )
        == 0
    )
    found = BiasMap.load(tmp_path / "m.npz")
    assert (
        len(found.at) == 48
        and (found.count == 5).all()
        and found.source == "points.csv"
        and not found.planar
    )
    np.testing.assert_allclose(found.bias_at(np.array([[0.8, 0.6, 0.6]])), BIAS[None], atol=1e-6)
    assert found.belongs_to(corners()) and not found.belongs_to(corners(8.0))
    assert "48 markers 0.5 m apart" in capsys.readouterr().out


def test_a_planar_network_needs_no_heights(tmp_path, points, survey):
    flat = tmp_path / "flat.csv"
    flat.write_text(
        "".join(
            ",".join(np.array(line.split(","))[[0, 1, 3, 4]]) + "\n"
            for line in points.read_text().split()
        )
    )
    options = [
        "--planar",
        "--interpolator",
        "network",
        "--step",
        "0.5",
        "--out",
        str(tmp_path / "m.npz"),
    ]
    assert main(["fit", "--static", str(flat), *survey, *options]) == 0
    found = BiasMap.load(tmp_path / "m.npz")
    assert found.planar and found.interpolator == "network" and (found.count == 15).all()
    np.testing.assert_allclose(found.bias, np.tile(BIAS[:2], (16, 1)), atol=1e-6)


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Write two bags of flights through the same biases."""
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
    fitted = [
        "fit",
        one,
        "--holdout",
        two,
        "--out",
        out,
        "--json",
        str(tmp_path / "fit.json"),
        "--jobs",
        "1",
    ]
    assert main(fitted) == 0
    figures = json.loads((tmp_path / "fit.json").read_text())
    (row,) = figures["held out"]
    assert row["after"]["rmse_3d"] < 0.8 * row["before"]["rmse_3d"]
    assert figures["map"]["markers"] > 30 and figures["map"]["frame"] == "map"
    assert "held out" in capsys.readouterr().out

    assert main(["judge", out, two, "--json", str(tmp_path / "judge.json")]) == 0
    judged = json.loads((tmp_path / "judge.json").read_text())
    assert judged["runs"] == [row] and judged["gain"] == pytest.approx(
        1.0 - row["after"]["rmse_3d"] / row["before"]["rmse_3d"]
    )
    assert (
        f"better: the 3D RMSE falls by {100 * judged['gain']:.0f} % on these flights"
        in capsys.readouterr().out
    )


def wrong_map(path, bias, anchors):
    """Write a map with one bias in the whole room."""
    cell = np.stack(
        np.meshgrid(*[np.arange(-5, 6)] * 2, np.arange(4), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    whole = np.tile(bias, (len(cell), 1))
    zero = np.zeros_like(whole)
    own = {"ids": anchors.ids, "positions": anchors.positions}
    BiasMap(
        cell, 1.0 * cell, whole, zero, np.full(len(cell), 9), np.zeros((3, 3)), 1.0, **own
    ).save(path)


def test_harm_is_said_and_counts_as_failure(tmp_path, flights, capsys):
    wrong_map(tmp_path / "m.npz", [1.0, -1.0, 0.5], corners())
    assert main(["judge", str(tmp_path / "m.npz"), str(flights / "one.bag")]) == 1
    said = capsys.readouterr().out
    assert re.search(
        r"harm: the 3D RMSE rises by \d+ % on these flights; do not use", said
    ) and re.search(r"after: it rises by \d+ %", said)


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
    assert (
        main(
            [
                "fit",
                one,
                "--holdout",
                two,
                "--out",
                str(out),
                "--json",
                str(tmp_path / "fit.json"),
                "--jobs",
                "1",
            ]
        )
        == 1
    )
    assert not out.exists() and json.loads((tmp_path / "fit.json").read_text())["written"] is False
    assert "m.npz is not written: harm: the 3D RMSE rises by" in capsys.readouterr().out


def test_a_map_is_refused_among_other_anchors(tmp_path, flights, capsys):
    wrong_map(tmp_path / "m.npz", [0.1, 0.0, 0.0], corners(8.0))
    assert main(["judge", str(tmp_path / "m.npz"), str(flights / "one.bag")]) == 2
    assert "its anchors are not those that the map was made for" in capsys.readouterr().err
    moved = corners().at(corners().positions + [0.05, 0.0, 0.0])
    wrong_map(tmp_path / "m.npz", [0.0, 0.0, 0.0], moved)
    assert main(["judge", str(tmp_path / "m.npz"), str(flights / "one.bag")]) == 0
    assert "no gain: the 3D RMSE stays on these flights" in capsys.readouterr().out


@pytest.mark.slow
def test_as_much_of_a_map_is_taken_as_flights_left_out_bear_out(tmp_path, flights, capsys):
    both, out = [str(flights / "one.bag"), str(flights / "two.bag")], str(tmp_path / "m.npz")
    assert (
        main(["fit", *both, "--out", out, "--json", str(tmp_path / "fit.json"), "--jobs", "1"]) == 0
    )
    told = json.loads((tmp_path / "fit.json").read_text())["borne_out"]
    assert (
        len(told["left_out"]) == 2 and told["gain"] > 0.0 and told["share"] > 0.0
    )  # both bags hold flights with the same name
    assert "expected of flights like these" in capsys.readouterr().out
    whole = BiasMap.load(out)
    half = whole.scaled(0.5)
    np.testing.assert_allclose(half.bias, 0.5 * whole.bias)
    added = np.linalg.eigvalsh(half.added - 0.25 * whole.added)
    assert added.min() > -1e-9 and added.max() > 0.0  # the remaining bias is uncertain


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["fit", "--out", "m.npz"], "FLIGHT: there is none"),
        (["fit", "--static", "POINTS", "--step", "0", "--out", "m.npz"], "--step: 0.0"),
        (
            ["fit", "--static", "nowhere.csv", "--out", "m.npz"],
            "nowhere.csv: cannot be read .No such file",
        ),
        (["fit", "--static", "POINTS", "--out", "m.npz"], "--survey: .* holds no anchors"),
        (["fit", "--static", "SHORT", "--out", "m.npz"], "has no column true_z"),
        (
            ["fit", "--static", "TEXT", "--planar", "--out", "m.npz"],
            "line 3: x is .one.; it must be",
        ),
        (["fit", "--static", "EMPTY", "--planar", "--out", "m.npz"], "holds no positions"),
        (
            ["fit", "FLIGHTS/one.bag", "--holdout", "FLIGHTS", "--out", "m.npz"],
            "one.bag is also a FLIGHT",
        ),
        (["judge", "POINTS", "FLIGHTS/one.bag"], "is no position bias map"),
        (["fit"], "required: --out"),
        ([], "required: COMMAND"),
    ],
)
def test_what_cannot_be_used_is_refused(
    tmp_path, points, flights, monkeypatch, capsys, arguments, named
):
    monkeypatch.chdir(tmp_path)
    head = "true_x,true_y,x,y\n"
    texts = {"SHORT": head + "0,0,0,0\n", "TEXT": head + "0,0,0,0\n1,1,one,1\n", "EMPTY": head}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    named_paths = {"POINTS": str(points), "FLIGHTS": str(flights)}
    for name, path in named_paths.items():
        arguments = [argument.replace(name, path) for argument in arguments]
    assert main(arguments) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("debias") and "error: " in error
    assert re.search(named, error)
    assert not (tmp_path / "m.npz").exists()


def test_help_shows_every_command(capsys):
    assert main(["--help"]) == 0
    assert "debias fit --static points.csv" in capsys.readouterr().out


# --- fits ---


CONFIG = SimulationConfig(
    seed=2,
    duration=6.0,
    imu_rate=100.0,
    truth_rate=50.0,
    start_in_air=True,
    place=(0.5, 0.3),
    height=1.5,
)


def config(**fields):
    return SimulationConfig(**{**vars(CONFIG), **fields})


def test_part_of_a_flight_is_its_airborne_odometry_beside_the_truth():
    flight = simulate(config(trajectory="circle"))
    score, run = evaluate(flight)
    part = part_of(score, run.odometry)
    assert len(part) == len(score.t)
    np.testing.assert_allclose(part.measured - part.true, score.error, atol=1e-12)
    np.testing.assert_array_equal(part.covariance, score.covariance)


def test_a_recording_at_rest_is_one_place(tmp_path):
    write_bag(simulate(config(trajectory="hover")), tmp_path / "still.bag")
    (part,) = static_parts(tmp_path / "still.bag")
    assert len(part) > 500 and np.ptp(part.true, axis=0).max() < 1e-6
    assert np.linalg.norm((part.measured - part.true).mean(axis=0)) < 0.5


def test_a_recording_that_moves_holds_no_place(tmp_path):
    write_bag(simulate(config(trajectory="circle")), tmp_path / "round.bag")
    with pytest.raises(InputError, match="never stands still"):
        static_parts(tmp_path / "round.bag")


def test_rows_of_one_place_are_one_part(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text(
        "true_x, true_y, true_z, x, y, z, note\n0,0,1,0.1,0,1,a\n1,0,1,1.1,0,1,b\n0,0,1,0.3,0,1,c\n"
    )
    one, two = static_parts(file)
    np.testing.assert_allclose(one.measured, [[0.1, 0.0, 1.0], [0.3, 0.0, 1.0]])
    np.testing.assert_allclose(two.true, [[1.0, 0.0, 1.0]])
    assert one.covariance is None
