# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Settings for the tests of this package."""

from pathlib import Path
import sys

from hypothesis import settings

# helpers that lie beside the tests of the packages below
for package in ("uwb_tdoa_bias", "uwb_tdoa_ekf"):
    sys.path.append(str(Path(__file__).resolve().parents[2] / package / "test"))

# The first call of a compiled function takes seconds, and a busy machine is no fault; every run
# tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")
