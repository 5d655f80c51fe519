# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Entry points that setup.py names: one for each file in commands/, and the nodes."""

from __future__ import annotations

from collections.abc import Callable

from uwb_tdoa_bias.common.executable import executable, node_executable


def __getattr__(name: str) -> Callable[..., object]:
    """Return the entry point of that name."""
    if name.endswith("_node"):
        return node_executable(f"{__package__}.{name}")
    return executable(f"{__package__}.commands.{name}")
