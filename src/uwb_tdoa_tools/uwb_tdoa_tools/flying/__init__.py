# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly a simulated vehicle in closed loop by its estimate alone.

from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.vehicle import WORLDS
result = fly(Task(WORLDS["hall"], seed=3))
"""
