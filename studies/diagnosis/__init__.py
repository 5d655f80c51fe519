# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of docs/notebook/diagnosis.md."""
