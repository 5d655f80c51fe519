# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""--rerun: the content that each tool writes for the viewer."""

from dataclasses import replace
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_tools import diagnosis
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import diagnose, evaluate, localize
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing import pictures
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

RATES = {"tdoa_rate": 200.0, "imu_rate": 100.0, "truth_rate": 100.0}
CLEAN = dict(floor_time=1.0, bias=False, multipath=False, outlier_probability=0.0, **RATES)
ALWAYS = {
    "world/anchors",
    "world/path",
    "world/tag",
    "world/tag/3_sigma",
    "verdict",
    "deviation/x",
    "deviation/y",
    "deviation/z",
}


@pytest.fixture(scope="module")
def flight():
    """Return a flight with a late anchor 3."""
    return AnchorDelay({"3": 0.3}).inject(
        simulate(SimulationConfig(seed=1, duration=40.0, **CLEAN))
    )


@pytest.fixture(scope="module")
def bag(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "flight.bag"
    write_bag(flight, path)
    return path


@pytest.fixture
def desk(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight.bag").symlink_to(bag)
    return tmp_path


@pytest.fixture
def viewer(monkeypatch):
    """A stand-in for the library that records its calls."""
    library = MagicMock()
    monkeypatch.setitem(sys.modules, "rerun", library)
    monkeypatch.setattr(pictures, "find_spec", lambda name: object())
    return library


def names(viewer):
    """Return the names of everything written."""
    stream = viewer.RecordingStream.return_value
    return {
        call.args[0] for call in (*stream.log.call_args_list, *stream.send_columns.call_args_list)
    }


def verdict(viewer):
    return viewer.TextDocument.call_args.args[0]


@pytest.mark.slow
def test_localize_writes_no_truth(desk, viewer):
    assert localize.main(["flight.bag", "--out", "out", "--rerun", "flight.rrd"]) in (0, 1)
    found = names(viewer)
    assert ALWAYS <= found and any(name.startswith("residual/") for name in found)
    assert not found & {"world/truth", "error", "world/before"} and "standard deviation" in verdict(
        viewer
    )
    assert str(viewer.RecordingStream.return_value.save.call_args.args[0]) == "flight.rrd"


def test_evaluate_writes_the_truth_and_the_error(desk, viewer):
    assert evaluate.main(["flight.bag", "--rerun", "flight.rrd"]) == 0
    assert ALWAYS | {"world/truth", "error"} <= names(viewer) and "rmse_3d" in verdict(viewer)


@pytest.mark.slow
def test_diagnose_writes_before_and_after_and_what_was_found(diagnosed, desk, viewer, monkeypatch):
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: diagnosed)
    assert diagnose.main(["flight.bag", "--out", "out", "--rerun", "flight.rrd"]) == 0
    assert ALWAYS | {"world/truth", "world/before", "error", "error/before"} <= names(viewer)
    assert "anchor 3" in verdict(viewer)


def test_demo_writes_what_the_nodes_said(flight, viewer, tmp_path, monkeypatch):
    pytest.importorskip("rclpy")
    from uwb_tdoa_tools.flying import demo

    nodes = demo.LivePass(dict.fromkeys(demo.MISSING, 0), FlightEstimator()(flight).odometry)
    monkeypatch.setattr(demo, "through_nodes", lambda *_: nodes)
    correction = Corrector(flight.anchors, EffectSet())
    demo.fly(flight, correction, {}, tmp_path, 1.0, tmp_path / "flight.rrd")
    assert ALWAYS | {"world/truth", "world/before", "error", "error/before"} <= names(viewer)
    assert "3D RMSE raw" in verdict(viewer)


def test_errors_are_those_of_each_path(flight, viewer, tmp_path):
    run = FlightEstimator()(flight)
    off = replace(run.odometry, p=run.odometry.p + [0.0, 0.0, 1.0])
    pictures.write_rerun(tmp_path / "flight.rrd", flight, run.odometry, None, [], flight.truth, off)
    told = [np.asarray(call.kwargs["scalars"]) for call in viewer.Scalars.columns.call_args_list]
    assert np.median(told[-2]) < 0.3 and np.median(told[-1]) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["localize", "evaluate", "diagnose"])
def test_it_is_left_out_with_a_sentence_where_it_is_not_installed(desk, capsys, monkeypatch, name):
    monkeypatch.setattr(pictures, "find_spec", lambda name: None)
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: pytest.skip("it goes on"))
    command = {"localize": localize, "evaluate": evaluate, "diagnose": diagnose}[name]
    out = [] if name == "evaluate" else ["--out", "out"]
    try:
        command.main(["flight.bag", *out, "--rerun", "flight.rrd"])
    except pytest.skip.Exception:
        pass
    assert (
        capsys.readouterr().err.count("pip install rerun-sdk") == 1
        and not (desk / "flight.rrd").exists()
    )


@pytest.mark.parametrize("name", ["localize", "evaluate", "diagnose"])
def test_it_shows_a_single_flight_in_a_folder_that_is_there(desk, capsys, name):
    command = {"localize": localize, "evaluate": evaluate, "diagnose": diagnose}[name]
    out = [] if name == "evaluate" else ["--out", "out"]
    (desk / "other.bag").symlink_to("flight.bag")
    assert command.main(["flight.bag", "other.bag", *out, "--rerun", "flight.rrd"]) == 2
    assert "--rerun: needs exactly one flight, got 2" in capsys.readouterr().err
    assert command.main(["flight.bag", *out, "--rerun", "nowhere/flight.rrd"]) == 2
    assert "its directory does not exist" in capsys.readouterr().err


def test_the_library_itself_takes_it(desk):
    pytest.importorskip("rerun")
    assert localize.main(["flight.bag", "--out", "out", "--rerun", "flight.rrd"]) in (0, 1)
    assert (desk / "flight.rrd").read_bytes().startswith(b"RRF")
    assert evaluate.main(["flight.bag", "--rerun", "judged.rrd"]) == 0
    assert (desk / "judged.rrd").stat().st_size > 10_000
