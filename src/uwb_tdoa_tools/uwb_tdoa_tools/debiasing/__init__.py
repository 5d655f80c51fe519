# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit bias maps of positions, and evaluate them on flights."""
