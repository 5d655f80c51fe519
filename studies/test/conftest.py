"""The helpers of the tests in src become importable."""

import studies  # noqa: F401
