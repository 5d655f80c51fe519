# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define what a link to an autopilot can do, whatever it speaks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.errors import InputError

if TYPE_CHECKING:
    from .estimate import Estimate


def missing(protocol: str, error: ImportError, package: str) -> InputError:
    """Return the error of a protocol that needs a package which cannot be imported."""
    name = (error.name or package).partition(".")[0]
    return InputError(
        f"protocol: {protocol} needs the Python package {name}; install it with "
        f"`pip install {package}`."
    )


class Link:
    """A link to an autopilot. This one leads to nobody: odometry goes out on a topic alone."""

    def send(self, estimate: Estimate, resets: int) -> None:
        """Send an estimate, which is in the frames of ROS.

        Parameters
        ----------
        estimate : Estimate
            What the autopilot is to use.
        resets : int
            Number of jumps so far (Gate.resets).
        """

    def turn(self) -> None:
        """Take what came from the autopilot, and answer it; called many times per second."""

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return (sentence on what is wrong with the link or "", {key: value} for /diagnostics)."""
        return "", {}

    def close(self) -> None:
        """End the link."""
