# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run nodes as processes, replay recordings to them, and record their topics."""
