# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of docs/notebook/checking.md, of simulated flights."""

import json

from checking_flights import QUICK, recording
from mistakes import LATENCY, MISTAKES, arriving
import numpy as np
import pytest

from studies.__main__ import main
from studies.checking.figures import table
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.readers import read_survey
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


@pytest.mark.slow
def test_mistakes_are_put_in_and_named(tmp_path, capsys):
    (tmp_path / "flights").mkdir()
    flight = simulate(SimulationConfig(seed=0, **QUICK))
    write_bag(flight, tmp_path / "flights" / "one.bag")
    (tmp_path / "surveys").mkdir()
    rows = (
        f"{k},{x},{y},{z}" for k, (x, y, z) in zip(flight.anchors.ids, flight.anchors.positions)
    )
    (tmp_path / "surveys" / "anchor_room.csv").write_text("\n".join(["id,x,y,z", *rows, ""]))
    assert len(read_survey(tmp_path / "surveys" / "anchor_room.csv")) == len(flight.anchors)
    options = [
        "--survey",
        str(tmp_path / "surveys"),
        "--jobs",
        "1",
        "--json",
        str(tmp_path / "out.json"),
    ]
    assert (
        main(
            ["checking", str(tmp_path / "flights"), *options, "--only", "nothing", "in_g", "order"]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert (
        "| nothing: no error is said | 1 | 1 |  |" in out
        and "| accelerometer in g | 1 | 1 |  |" in out
    )
    assert MISTAKES["order"].text not in out  # of TDoA3 alone
    assert [row["mistake"] for row in json.loads((tmp_path / "out.json").read_text())] == [
        "nothing",
        "in_g",
    ]


def test_what_is_said_anyway_is_not_counted_with_a_mistake():
    said = {"imu_shaking": "warning"}
    rows = [
        {"flight": "f", "live": True, "mistake": "nothing", "said": said, "named": True},
        {
            "flight": "f",
            "live": True,
            "mistake": "sign",
            "said": said | {"gap": "warning"},
            "named": False,
        },
    ]
    nothing, sign = table(rows).splitlines()[2:]
    assert nothing.endswith("| 1 | 1 | imu_shaking 1 |") and sign.endswith("| 0 | 1 | gap 1 |")


def test_messages_arrive_in_order_and_after_they_were_stamped():
    made = arriving(recording(), 0)
    assert (np.diff(made.tdoa_arrival) >= 0.0).all() and (
        made.tdoa_arrival - made.tdoa.t >= LATENCY - 1e-9
    ).all()
    assert len(made.imu_arrival) == len(made.imu)
