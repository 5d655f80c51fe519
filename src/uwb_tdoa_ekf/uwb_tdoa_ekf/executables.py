# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define the entry points that setup.py names."""

from uwb_tdoa_bias.common.executable import node_executable

compile_nodes = node_executable("uwb_tdoa_ekf.compile_nodes")
debias_node = node_executable("uwb_tdoa_ekf.debias_node")
ekf_node = node_executable("uwb_tdoa_ekf.ekf_node")
localization_node = node_executable("uwb_tdoa_ekf.localization_node")
