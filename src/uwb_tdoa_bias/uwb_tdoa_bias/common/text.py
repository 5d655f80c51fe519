"""Sanitize texts of files and topics, and name the version that wrote a file."""

from __future__ import annotations

from functools import cache
import re

from .limits import LINE_LENGTH, NAME_LENGTH

# Other characters may be a command to Markdown, HTML, a shell, a file system or the mathematics of
# matplotlib.
_OTHERS = re.compile(r"[^\w .,:;+=()#-]")


def printable(text: object) -> str:
    r"""The text with what is no character to see (line ends, escape sequences, marks that turn the direction of writing, halves of
    characters) written out, as \x1b: a terminal shows it and does nothing else.
    """
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape", "surrogatepass").decode()
        for one in str(text)
    )


def line_of(text: object) -> str:
    """One printable line of a bounded length: the middle of a longer text is left out."""
    whole, half = str(text), LINE_LENGTH // 2
    line = printable(
        whole[:LINE_LENGTH] + whole[-LINE_LENGTH:] if len(whole) > 2 * LINE_LENGTH else whole
    )
    return line if len(line) <= LINE_LENGTH else f"{line[:half]} ... {line[-half:]}"


def sanitize(text: object) -> str:
    """A name that means nothing anywhere: what is no letter, digit, space or one of .,:;+=()#-
    becomes _, and its end is cut.
    """
    return _OTHERS.sub("_", str(text))[:NAME_LENGTH]


@cache
def version() -> str:
    """Its version, e.g. "0.1.0"; "unknown" where the packages are not installed."""
    from importlib import metadata  # takes a twentieth of a second

    try:
        return metadata.version("uwb_tdoa_bias")
    except metadata.PackageNotFoundError:
        return "unknown"


def written_by() -> str:
    """For the files that we write: "uwb_tdoa 0.1.0"."""
    return f"uwb_tdoa {version()}"
