"""The one exception that means: the user gave us something we cannot use."""


class InputError(ValueError):
    """Bad input. The message is one sentence that names the field, the value and the remedy."""
