# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run a command by its name, without an installed entry point: python -m uwb_tdoa_tools.commands check flight_bag."""

from importlib import import_module
import sys

from ..main import NAMES

if __name__ == "__main__":
    name, *words = sys.argv[1:] or [""]
    if name not in NAMES:
        sys.exit(f"{name!r} is no command; expected one of: {', '.join(NAMES)}.")
    sys.exit(import_module(f"{__package__}.{name}").main(words))
