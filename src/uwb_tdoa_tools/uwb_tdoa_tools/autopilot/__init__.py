"""Odometry for an autopilot: what is sent, in its frames, over MAVLink or to a Crazyflie."""
