"""Flights in closed loop: a simulated vehicle whose controller knows its position, velocity and
attitude from the estimate alone.

from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.world import WORLDS
flown = fly(Task(WORLDS["hall"], seed=3))
"""
