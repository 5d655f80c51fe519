# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the processor time, memory and latency of the suite on this machine.

There are figures of the compiled core, of whole recordings, and of the live nodes.
"""
