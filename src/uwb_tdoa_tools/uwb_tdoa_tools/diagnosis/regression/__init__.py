# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Regress residuals on effects: tables, robust fits, selection, hold-out checks, confounding."""
