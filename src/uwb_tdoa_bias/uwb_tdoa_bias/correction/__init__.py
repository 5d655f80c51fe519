# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correction of TDOAs by effects and network, at poses that the filter reports."""
