# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What rules and constants are worth. `tuned` copies the filter so that they can be changed while it
runs, `catalogue` lists its rules, `rows` what it is run on, `watching` does the same for the rules
over streams and residuals, `work` runs variants, and `figures` prints the table.
"""
