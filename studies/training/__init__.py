# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of docs/notebook/bias.md, and the model that is shipped."""
