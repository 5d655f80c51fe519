# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Surveying: better anchors from rough positions and flights."""
