# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The entry points of setup.py."""

from .common.executable import node_executable

anchors_node = node_executable("uwb_tdoa_bias.anchors_node")
bias_node = node_executable("uwb_tdoa_bias.bias_node")
