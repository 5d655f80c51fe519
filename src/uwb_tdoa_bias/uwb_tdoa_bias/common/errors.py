# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The two exceptions that programs report to the user in one sentence.

Every other exception is a defect and keeps its traceback.
"""


class InputError(ValueError):
    """Bad input.

    The message is one sentence that names the field, the value and the remedy. Exit code 2.
    """


class Failure(Exception):
    """A task that failed with good input.

    The message names what failed and where to look. Exit code 1.
    """
