# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the input of ekf_node and its own state."""
