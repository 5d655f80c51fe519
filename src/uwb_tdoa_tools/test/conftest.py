# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Settings for the tests of this package."""

from pathlib import Path
import sys

from hypothesis import settings

# test helpers of the packages below
for package in ("uwb_tdoa_bias", "uwb_tdoa_ekf"):
    sys.path.append(str(Path(__file__).resolve().parents[2] / package / "test"))

# A busy machine is no error: the first call of a compiled function takes seconds.
# Every run tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")
