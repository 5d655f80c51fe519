# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Odometry for an autopilot: what is sent, in its frames, over MAVLink or to a Crazyflie."""
