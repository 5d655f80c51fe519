# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scoring: errors of estimates against ground truth."""
