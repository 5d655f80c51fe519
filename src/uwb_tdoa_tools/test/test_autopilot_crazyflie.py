# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link to a Crazyflie, with stand-ins for the objects of cflib."""

import time
from types import SimpleNamespace

from cflib_objects import PARAMETERS, Crazyflie, cflib  # noqa: E402, F401
import numpy as np

from uwb_tdoa_tools.autopilot import crazyflie  # noqa: E402
from uwb_tdoa_tools.autopilot.crazyflie import ATTITUDE_STD, POSITION_STD, CrazyflieLink  # noqa: E402
from uwb_tdoa_tools.autopilot.estimate import Estimate  # noqa: E402
from uwb_tdoa_tools.crazyflie import BLOCKS  # noqa: E402


def link(content="pose", streams=("imu",), taken=None):
    taken = [] if taken is None else taken
    samples = SimpleNamespace(take=lambda *what: taken.append(what), restart=taken.clear)
    address = "radio://0/80/2M/E7E7E7E7E7"
    made = CrazyflieLink(address, content, streams, samples, time.time_ns)
    made.turn()
    return made, Crazyflie.made


def an_estimate(std):
    covariance = std**2 * np.eye(6)
    q = np.array([0.0, 0.0, 0.0, 1.0])
    return Estimate(0, np.arange(3.0), q, np.zeros(3), np.zeros(3), covariance, covariance)


def test_log_blocks_fit_their_packets(cflib):  # noqa: F811
    taken = []
    made, vehicle = link(streams=BLOCKS, taken=taken)
    vehicle.fully_connected.call("")
    made.turn()
    sizes = {"FP16": 2, "float": 4, "uint16_t": 2}
    for config in vehicle.configs:
        assert config.started and sum(sizes[kind] for kind in config.variables.values()) <= 26
        assert config.period % 10 == 0
    imu = next(config for config in vehicle.configs if config.name == "imu")
    imu.data_received_cb.call(1000, dict.fromkeys(imu.variables, 1.0), imu)
    made.turn()
    _, timestamp, values, arrival = taken[-1]
    assert (timestamp, values) == (1000, [1.0] * 6) and abs(arrival - time.time()) < 60.0


def test_it_sends_nothing_that_the_crazyflie_would_believe_too_much(cflib):  # noqa: F811
    made, vehicle = link()
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == []  # no link yet
    vehicle.fully_connected.call("")
    made.turn()
    vehicle.param.set_value = lambda name, value: None  # the vehicle ignores the parameter
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == []
    vehicle.values |= {POSITION_STD: 0.2, ATTITUDE_STD: 0.2}
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == [(0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0)]
    made.send(an_estimate(0.4), 0)
    assert len(vehicle.poses) == 1
    made.send(an_estimate(0.02), 0)  # smaller errors than announced are safe
    assert len(vehicle.poses) == 2


def test_a_position_needs_no_attitude(cflib):  # noqa: F811
    made, vehicle = link(content="position")
    vehicle.fully_connected.call("")
    made.turn()
    made.send(an_estimate(0.2), 0)
    made.send(an_estimate(0.2), 0)
    assert vehicle.poses == [(0.0, 1.0, 2.0)]
    assert vehicle.values == {POSITION_STD: 0.2, ATTITUDE_STD: 0.0045}


def test_a_link_that_is_lost_is_opened_again(cflib, monkeypatch):  # noqa: F811
    made, vehicle = link()
    assert "not known yet" in made.report()[0]
    vehicle.connection_failed.call("", "no radio\nTraceback ...")
    made.turn()
    assert "no link to the Crazyflie (no radio): check" in made.report()[0]
    assert vehicle.opened == 1
    monkeypatch.setattr(crazyflie, "AGAIN", 0.0)
    vehicle.connection_failed.call("", "no radio")
    made.turn()
    assert vehicle.opened == 2
    vehicle.fully_connected.call("")
    made.turn()
    assert made.report()[0] == ""
    monkeypatch.setattr(crazyflie, "CONNECTING", -1.0)
    vehicle.connection_lost.call("", "too many packets lost")
    made.turn()
    assert "too many packets lost" in made.report()[0] and vehicle.opened == 3
    made.turn()
    assert "it does not answer" in made.report()[0]


def test_log_variables_that_it_does_not_have_are_named(cflib):  # noqa: F811
    made, vehicle = link(streams=("height", "imu"))

    def add(config):
        if config.name == "height":
            raise KeyError("Variable range.zrange not in TOC")
        vehicle.configs.append(config)

    vehicle.log.add_config = add
    vehicle.fully_connected.call("")
    made.turn()
    assert "no log variables for height" in made.report()[0]
    assert [config.name for config in vehicle.configs if config.started] == ["imu"]
