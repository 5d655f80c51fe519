# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The compiled filter: states, prediction, robust updates, hypotheses and initialization.

It uses no ROS and no files. docs/notebook/constants.md lists what each constant is worth.
"""
