# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults over topics.

`events` turns a flight into messages, and `changes` and `table` put faults into them. `play` sends
them to real nodes. `judge` compares the output of the nodes with ground truth.
"""
