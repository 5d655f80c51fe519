# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run a command by its name, without an installed entry point: python -m uwb_tdoa_tools.commands check flight.bag."""

from importlib import import_module
import sys

_, name, *words = sys.argv
sys.exit(import_module(f"{__package__}.{name}").main(words))
