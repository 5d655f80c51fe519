# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import json

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import plan
from uwb_tdoa_tools.planning import optimisation, run
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import corners

FILES = {"flyable.png", "flyable.npz", "plan_bag", "plan.json", "precision.png"}
COARSE = ["--step", "0.5"]


@pytest.fixture
def anchors(tmp_path):
    corners().to_yaml(tmp_path / "anchors.yaml")
    return str(tmp_path / "anchors.yaml")


@pytest.fixture
def square(tmp_path):
    path = tmp_path / "square.yaml"
    Anchors.from_positions([[0, 0, 0.2], [4, 0, 0.2], [4, 4, 0.2], [0, 4, 0.2]]).to_yaml(path)
    return str(path)


@pytest.fixture
def without_advice(monkeypatch):
    """Search no place for one more anchor."""
    monkeypatch.setattr(run, "advice", lambda *_: None)


@pytest.fixture
def without_pictures(monkeypatch):
    """Draw no maps."""
    monkeypatch.setattr(run, "draw_map", lambda *_: None)


def report(out):
    return json.loads((out / "plan.json").read_text())


@pytest.mark.slow
def test_a_volume(anchors, tmp_path, capsys):
    out = tmp_path / "new" / "plan"
    assert (
        plan.main(
            [
                anchors,
                "--volume",
                *COARSE,
                "--flyable",
                "pairings",
                "--out",
                str(out),
                "--json",
                str(tmp_path / "copy.json"),
            ]
        )
        == 0
    )
    assert {path.name for path in out.iterdir()} == FILES
    assert report(out) == json.loads((tmp_path / "copy.json").read_text())
    found = report(out)["map"]
    assert found["cells"] == [14, 16, 6] and 0.3 < found["flyable_share"] < 1.0
    assert sum(
        found[f"{name}_share"]
        for name in ("flyable", "two_solutions", "imprecise", "too_few", "outside")
    ) == pytest.approx(1.0)
    for name in ("precision.png", "flyable.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    volume = FlyableVolume.load(out / "flyable.npz")
    assert (
        volume.belongs_to(corners())
        and volume.contains([0.0, 0.0, 1.5])
        and not volume.contains([3.4, 3.9, 0.2])
    )
    assert found["flyable_size"] == pytest.approx(volume.flyable.sum() * 0.125)
    text = capsys.readouterr().out
    assert (
        f"{100 * found['flyable_share']:.0f} % of your room can be flown (" in text
        and str(out) in text
    )
    assert "what the anchors span; if yours is another: --room" in text


@pytest.mark.slow
def test_a_round_of_ranges_and_of_both(anchors, tmp_path, capsys):
    """Ranges have one solution. They determine more than TDOAs."""
    bounds = {}
    for protocol in ("tdoa2", "ranges", "tdoa2+ranges"):
        out = tmp_path / protocol
        options = ["--height", "1.2", "--step", "1", "--noise", "0.1", "--protocol", protocol]
        assert plan.main([anchors, *options, "--out", str(out)]) == 0
        bounds[protocol] = report(out)["map"]["bound_in_hull"]["median"]
        assert {path.name for path in out.iterdir()} == FILES
    assert bounds["tdoa2+ranges"] < bounds["ranges"] < bounds["tdoa2"]
    assert report(tmp_path / "ranges")["map"]["two_solutions_share"] == 0.0
    capsys.readouterr()
    options = ["--protocol", "ranges", "--flyable", "pairings", "--step", "1"]
    assert plan.main([anchors, *options, "--out", str(tmp_path / "no")]) == 2
    assert "ranges have none; leave it out" in capsys.readouterr().err


@pytest.mark.slow
def test_a_slice_of_known_height(square, tmp_path, capsys):
    out = tmp_path / "out"
    options = [
        "--planar",
        "--height",
        "0.2",
        "--room",
        "-1",
        "5",
        "-1",
        "5",
        "--tx-power",
        "-3",
        "--flyable",
        "pairings",
        *COARSE,
    ]
    assert plan.main([square, *options, "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == FILES
    found = report(out)
    assert list(found["map"]["bound_99_per_axis_in_hull"]) == ["x", "y"] and found["map"][
        "cells"
    ] == [12, 12, 1]
    assert FlyableVolume.load(out / "flyable.npz").contains([2.0, 2.0, 77.0])
    assert "without orientation" in capsys.readouterr().out


@pytest.mark.usefixtures("without_advice", "without_pictures")
def test_options_change_the_bound(anchors, tmp_path):
    def median(*options):
        assert plan.main([anchors, "--step", "1", *options, "--out", str(tmp_path / "o")]) == 0
        return report(tmp_path / "o")["map"]["bound_in_hull"]["median"]

    base = median()
    assert median("--protocol", "tdoa3") != pytest.approx(base, rel=1e-3)
    (tmp_path / "weak.yaml").write_text(
        "azimuth: [0,0,0,0]\nelevation_1: [0,0,0,0]\nelevation_2: [0,0,0,0]\ngain_offset: -20\n"
    )
    assert median("--antenna", str(tmp_path / "weak.yaml")) > 3 * base
    assert median("--tx-power", "-2.3") == pytest.approx(base / 2, rel=0.01)
    assert median("--noise", "0.01") < 0.2 * base


@pytest.mark.slow
def test_one_figure_of_the_room_and_an_anchor_that_makes_it_larger(
    tmp_path, capsys, request, without_pictures
):
    """Six anchors stand in one half of a room, so the other half is imprecise.

    The plan with the proposed anchor confirms the predicted figures.
    """
    half = Anchors.from_positions(
        [[0, 0, 0.2], [4, 0, 2.8], [4, 5, 0.2], [0, 5, 2.8], [0, 0, 2.8], [4, 5, 2.8]],
        [7, 3, 12, 5, 1, 9],
    )
    half.to_yaml(tmp_path / "half.yaml")
    options = [
        str(tmp_path / "half.yaml"),
        "--volume",
        "--room",
        "0",
        "8",
        "0",
        "5",
        "0",
        "3",
        "--step",
        "0.5",
        "--accuracy",
        "0.1",
    ]
    out = tmp_path / "out"
    assert plan.main([*options, "--out", str(out)]) == 0
    found, text = report(out), capsys.readouterr().out
    share, more = found["map"]["flyable_share"], found["addition"]
    assert share == pytest.approx(found["map"]["flyable_size"] / 120.0) and found["map"][
        "size"
    ] == pytest.approx(120.0)
    x, y, z = more["position"]
    assert x > 4.0 and more["gain"] > 0.05 and more["bound_after"] < more["bound_before"]
    assert np.linalg.norm(half.positions - more["position"], axis=1).min() >= 1.0
    assert (
        f"add an anchor at ({x:.2f}, {y:.2f}, {z:.2f}): {100 * share:.1f} -> "
        f"{100 * more['flyable_share']:.1f} % can be flown"
    ) in text
    Anchors.from_positions([*half.positions, more["position"]]).to_yaml(tmp_path / "half.yaml")
    request.getfixturevalue("without_advice")
    assert plan.main([*options, "--out", str(out)]) == 0
    again = report(out)["map"]
    assert again["flyable_share"] == pytest.approx(share + more["gain"], abs=0.02)
    assert again["bound_flyable"] == pytest.approx(more["bound_flyable"], abs=0.01)


def test_where_no_anchor_helps_it_says_so(anchors, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(run, "PLACES_TRIED", 4)
    monkeypatch.setattr(optimisation, "LEAST_PRECISION", 0.9)
    assert (
        plan.main([anchors, "--step", "1", "--accuracy", "5", "--out", str(tmp_path / "out")]) == 0
    )
    assert "no place that was tried for one more anchor gains 1 %" in capsys.readouterr().out
    assert report(tmp_path / "out")["addition"] is None


@pytest.mark.slow
@pytest.mark.parametrize("turned", [True, False], ids=["orientations surveyed", "not surveyed"])
@pytest.mark.usefixtures("without_advice")
def test_improve(turned, tmp_path, capsys):
    poor = corners()
    ids, orientations = (
        [7, 3, 12, 5, 1],
        poor.orientations[:5] if turned else np.full((5, 4), np.nan),
    )
    before = Anchors(ids, poor.positions[:5] * [0.5, 1, 1], orientations, "hall")
    before.to_yaml(tmp_path / "poor.yaml")
    out = tmp_path / "out"
    options = ["--fly", "-1", "1", "-2", "2", "0.6", "1.6", "--starts", "1"]
    assert (
        plan.main(
            [
                str(tmp_path / "poor.yaml"),
                "--step",
                "1",
                *options,
                "--improve",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    assert {path.name for path in out.iterdir()} == FILES | {"improved.yaml", "layout.png"}
    found, text = report(out)["improve"], capsys.readouterr().out
    assert found["after"]["worst"] < found["before"]["worst"]
    assert found["before"]["flyable_share"] == report(out)["map"]["flyable_share"]
    assert f"{100 * found['after']['flyable_share']:8.1f}" in next(
        line for line in text.splitlines() if line.startswith("flyable, %")
    )
    better = read_survey(out / "improved.yaml")
    assert set(better.ids) == set(ids) and better.frame == "hall"
    np.testing.assert_allclose(better.positions, better.positions.round(2), atol=1e-12)
    assert np.isfinite(better.orientations).all() if turned else np.isnan(better.orientations).all()
    assert [
        int(line.split()[1].strip(":")) for line in text.splitlines() if line.startswith("anchor ")
    ] == [one["id"] for one in found["placed"]]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--room", "1", "2", "3"], "room: 3 numbers"),
        (["--room", "1", "0", "0", "1"], "room: "),
        (["--step", "-1"], "step: -1"),
        (["--step", "1e-4"], "cells, more than"),
        (["--noise", "0"], "noise: 0"),
        (["--antenna", "none.yaml"], "none.yaml"),
        (["--tx-power", "99"], "tx_power_dbm: 99"),
        (["--protocol", "eq8"], "invalid choice: 'eq8'"),
        (["--flights", "nowhere"], "nowhere"),
        (["--planar", "--flights", "nowhere"], "flights: "),
        (["--improve", "--places", "none.yaml"], "none.yaml"),
        (["--improve", "--count", "3"], "count: 3"),
        (["--starts", "0", "--improve"], "starts: 0"),
        (["--fly", "1", "0", "0", "1", "0", "1", "--improve"], "is empty"),
        (["--height", "1", "--volume"], "not allowed with"),
        (["--planar", "--volume"], "planar: "),
    ],
)
def test_bad_input_is_told_in_one_sentence(options, says, anchors, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert plan.main([anchors, *COARSE, *options, "--out", "out"]) == 2
    err = capsys.readouterr().err
    assert says in err and "Traceback" not in err
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_advice", "without_pictures")
def test_with_a_height_sensor_four_anchors_at_one_height_serve_a_volume(square, tmp_path, capsys):
    """Without a height sensor they do not: the plane of the anchors mirrors every position."""
    options, out = (
        ["--volume", "--room", "0", "4", "0", "4", "0", "2", "--step", "0.5"],
        tmp_path / "o",
    )
    assert plan.main([square, *options, "--out", str(out)]) == 2
    assert "--with height" in capsys.readouterr().err
    figures = []
    for std in ("0.02", "0.2"):
        assert (
            plan.main(
                [square, *options, "--with", "height", "--height-std", std, "--out", str(out)]
            )
            == 0
        )
        figures.append(json.loads((out / "plan.json").read_text())["map"])
    assert figures[0] != figures[1]
    assert (
        plan.main([square, *options, "--with", "height", "--height-std", "0", "--out", str(out)])
        == 2
    )
    assert "height std" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("without_advice")
def test_flights_are_judged_with_the_height_that_they_hold(anchors, tmp_path, capsys):
    config = SimulationConfig(duration=20.0, tdoa_rate=200.0, imu_rate=200.0, height_noise=0.01)
    write_bag(simulate(config), tmp_path / "flight.bag")
    ratios = {}
    for options in ((), ("--with", "height")):
        arguments = [
            anchors,
            *COARSE,
            *options,
            "--flights",
            str(tmp_path / "flight.bag"),
            "--out",
            str(tmp_path / "o"),
        ]
        assert plan.main(arguments) == 0
        ratios[options] = json.loads((tmp_path / "o" / "plan.json").read_text())["flights"][-1]
        assert {path.name for path in (tmp_path / "o").iterdir()} == FILES | {"accuracy.png"}
    without, aided = ratios.values()
    assert f"{aided['achieved_over_bound']:.3f}" in capsys.readouterr().out
    assert aided["bound"] < 0.9 * without["bound"] and aided["rmse"] < without["rmse"]
    write_bag(simulate(replace(config, height_noise=None)), tmp_path / "flight.bag", force=True)
    assert plan.main(arguments) == 2
    assert "holds no height; leave out --with height" in capsys.readouterr().err
