# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Executables, one thin file each: options, one call, the printed result. Nothing imports them."""
