# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The helpers of the tests in src become importable."""

import studies  # noqa: F401
