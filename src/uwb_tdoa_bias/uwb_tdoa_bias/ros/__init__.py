# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Nodes, topics, parameters, frames and diagnostics: all code that uses ROS."""
