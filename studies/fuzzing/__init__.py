# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Changed files of every kind, given to every reader: the readers, how files are changed, and the
small corpus that the changes start from.
"""
