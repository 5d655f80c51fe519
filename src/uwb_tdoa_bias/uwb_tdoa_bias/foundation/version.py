"""Which version of the suite this is: what is written says by which it was written."""

from __future__ import annotations

from functools import cache


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
