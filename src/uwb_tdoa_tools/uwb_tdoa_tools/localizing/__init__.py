# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Localizing: trajectories of recordings without ground truth, and how reliable they are."""
