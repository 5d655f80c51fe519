# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tools: read, convert, simulate, replay, record and evaluate flights; a demo of all parts."""
