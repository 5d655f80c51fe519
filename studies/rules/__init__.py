# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the worth of rules and constants.

`tuned` copies the filter so that they can be changed while it runs. `catalogue` lists its rules,
and `rows` lists its inputs. `watching` and `watched` do the same for the rules over streams and
residuals. `work` runs variants, and `figures` prints the table.
"""
