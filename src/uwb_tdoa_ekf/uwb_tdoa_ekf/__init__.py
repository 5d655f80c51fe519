# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate the state of a tag: error-state filter, robust weights, initialization, time ordering.

Only the nodes use ROS.
"""
