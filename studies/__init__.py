# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Studies that reproduce the figures of the documentation.

Not installed: `./dev study NAME` runs it from the repository.

A study is a module with `add_options(add)` and `run(args)`, and a line in `__main__`. `table` draws
its trials, runs them in parallel and prints its rows. A study whose question is settled leaves; its
result stays in docs/notebook, with the commit that has the script.
"""

from pathlib import Path
import sys

# Flights, faults and mistakes with which the tests work, too.
for package in ("uwb_tdoa_tools", "uwb_tdoa_ekf", "uwb_tdoa_bias"):
    sys.path.append(str(Path(__file__).resolve().parents[1] / "src" / package / "test"))
