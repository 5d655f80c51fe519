# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The objects of cflib that our link uses, without a radio."""

import sys
from types import ModuleType, SimpleNamespace

import pytest

from uwb_tdoa_tools.autopilot.crazyflie import ATTITUDE_STD, POSITION_STD

PARAMETERS = {POSITION_STD: 0.01, ATTITUDE_STD: 0.0045}  # defaults of the firmware


class Caller(list):
    """Stand-in for cflib.utils.callbacks.Caller."""

    add_callback = list.append

    def call(self, *arguments):
        for callback in list(self):
            callback(*arguments)


class LogConfig:
    def __init__(self, name, period):
        self.name, self.period, self.variables = name, period, {}
        self.data_received_cb, self.started = Caller(), False

    def add_variable(self, name, kind):
        self.variables[name] = kind

    def start(self):
        self.started = True


class Crazyflie:
    """Stand-in for a Crazyflie: cf.log, cf.param, cf.extpos and the callbacks.

    made : the last instance
    """

    def __init__(self):
        Crazyflie.made = self
        self.fully_connected, self.connection_failed = Caller(), Caller()
        self.connection_lost, self.disconnected = Caller(), Caller()
        self.link, self.opened, self.poses, self.configs = None, 0, [], []
        self.values = dict(PARAMETERS)
        self.log = SimpleNamespace(add_config=self.configs.append)
        self.param = SimpleNamespace(
            get_value=lambda name: str(self.values[name]), set_value=self.values.__setitem__
        )
        self.extpos = SimpleNamespace(
            send_extpose=lambda *pose: self.poses.append(pose),
            send_extpos=lambda *place: self.poses.append(place),
        )

    def open_link(self, uri):
        self.opened, self.link = self.opened + 1, SimpleNamespace(close=lambda: None)


@pytest.fixture
def cflib(monkeypatch):
    modules = {
        "cflib": {},
        "cflib.crtp": {"init_drivers": lambda: None},
        "cflib.crazyflie": {"Crazyflie": Crazyflie},
        "cflib.crazyflie.log": {"LogConfig": LogConfig},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["cflib"].crtp = sys.modules["cflib.crtp"]
