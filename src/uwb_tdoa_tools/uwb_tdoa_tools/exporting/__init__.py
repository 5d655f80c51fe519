# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Corrections as one file for other runtimes: effects and network, traced, then printed."""
