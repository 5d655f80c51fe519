# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The main use case on a measured flight, at eight times real time.

The nodes over topics are compared with the offline engine and with ground truth.
"""

import numpy as np
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")
import known_answer  # noqa: E402

from uwb_tdoa_bias.correction.network import load_network  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag  # noqa: E402
from uwb_tdoa_tools.calibrating import between  # noqa: E402
from uwb_tdoa_tools.live.run import run_live  # noqa: E402
from uwb_tdoa_tools.readers import read_flight  # noqa: E402
from uwb_tdoa_tools.scoring.evaluation import evaluate  # noqa: E402
from uwb_tdoa_tools.scoring.metrics import Score  # noqa: E402

SECONDS = 16.0
VERDICTS = ("used", "rejected", "late", "invalid", "startup", "waiting")


@pytest.mark.slow
def test_measured_flight_through_the_nodes_is_the_offline_run(shared_data, tmp_path):
    log, survey = shared_data / "flights/0426/0426-traj7", shared_data / "surveys/anchor_0426.txt"
    bag = tmp_path / "flight.bag"
    whole = read_flight(log, survey)
    write_bag(between(whole, -np.inf, whole.imu.t[0] + SECONDS), bag)
    flight = read_bag(bag)
    model = known_answer.write(tmp_path)
    offline, _ = evaluate(flight, network=load_network(model))
    expected = offline.row()["rmse_3d"]
    assert expected < 0.35
    live = run_live(bag, tmp_path, 8.0, {"model_file": str(model)})
    row = Score("live", read_odometry(live.recorded), flight.truth).row()
    assert row["rmse_3d"] == pytest.approx(expected, abs=1e-3)
    counts = {name: int(live.ekf[name]) for name in VERDICTS}
    assert counts["late"] == counts["invalid"] == 0
    assert sum(counts.values()) == len(flight.tdoa)  # every message is accounted for
