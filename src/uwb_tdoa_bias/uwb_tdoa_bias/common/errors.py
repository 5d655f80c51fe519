"""The two exceptions that are reported to the user in one sentence; every other one is a defect and
keeps its traceback.
"""


class InputError(ValueError):
    """Bad input.

    The message is one sentence that names the field, the value and the remedy. Exit code 2.
    """


class Failure(Exception):
    """What was asked for could not be done with good input. The message says what failed and where
    to look. Exit code 1.
    """
