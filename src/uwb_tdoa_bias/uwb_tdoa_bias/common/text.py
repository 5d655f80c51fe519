# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sanitize texts of files and topics, and name the version that wrote a file."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
import re

from .limits import LINE_LENGTH, NAME_LENGTH

# Other characters can be commands to Markdown, HTML, a shell, a file system or the mathematics of
# matplotlib.
_OTHERS = re.compile(r"[^\w .,:;+=()#-]")


def printable(text: object) -> str:
    r"""Return a text in which all invisible characters are escaped, e.g. as \x1b.

    Invisible are line ends, escape sequences, marks that turn the writing direction, and halves of
    characters. A terminal displays the result and does nothing else.
    """
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape", "surrogatepass").decode()
        for one in str(text)
    )


def line_of(text: object) -> str:
    """Return one printable line of at most LINE_LENGTH characters; the middle is left out."""
    whole, half = str(text), LINE_LENGTH // 2
    line = printable(
        whole[:LINE_LENGTH] + whole[-LINE_LENGTH:] if len(whole) > 2 * LINE_LENGTH else whole
    )
    return line if len(line) <= LINE_LENGTH else f"{line[:half]} ... {line[-half:]}"


def sanitize(text: object) -> str:
    """Return a name without special meaning in any program.

    Characters other than letters, digits, space and .,:;+=()#- become _. The name is cut to
    NAME_LENGTH.
    """
    return _OTHERS.sub("_", str(text))[:NAME_LENGTH]


@cache
def version() -> str:
    """Return the version of the packages, e.g. "0.1.0"; "unknown" if they are not installed.

    colcon installs a distribution for each package, pip installs one for all.
    """
    from importlib import metadata  # the import takes 0.05 s

    for name in ("uwb_tdoa_bias", "uwb-tdoa"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def written_by() -> str:
    """Return the program and version for the head of written files: "uwb_tdoa 0.1.0"."""
    return f"uwb_tdoa {version()}"
