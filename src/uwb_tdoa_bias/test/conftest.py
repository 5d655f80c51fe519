# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Settings for the tests of this package."""

from hypothesis import settings

# The first call of a compiled function takes seconds; every run tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")
