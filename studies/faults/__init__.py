# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults over topics. `events` makes what is sent of a flight, `changes` and `table` put faults
into it, `play` sends it to real nodes, and `judge` compares what these publish with ground truth.
"""
