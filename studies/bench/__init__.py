# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the suite costs on this machine: figures of the compiled core, of whole recordings, and of
the live nodes.
"""
