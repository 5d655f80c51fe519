"""Settings for the tests of this package."""

from hypothesis import settings

# The first call of a compiled function takes seconds, and a busy machine is no fault; every run
# tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")
