# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Settings for the tests of this package."""

from pathlib import Path
import sys

from hypothesis import settings

# `finite_differences` lies with the tests of uwb_tdoa_bias.
sys.path.append(str(Path(__file__).resolve().parents[2] / "uwb_tdoa_bias" / "test"))

# The first call of a compiled function takes seconds; every run tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")
