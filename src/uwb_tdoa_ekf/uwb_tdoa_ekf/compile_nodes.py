"""compile_nodes: compile what the nodes need, so that their first start takes no longer than any
other.

Compiled code is kept in the folder that NUMBA_CACHE_DIR names, by default ~/.cache/uwb_tdoa, and
used until the sources, numba or the processor change. `./dev build` and `./dev demo` call this;
after a `colcon build` call it as the user who starts the nodes. What a bias network needs is
compiled at the first start of `bias_node` with one.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from uwb_tdoa_bias.correction import corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag import TagLeverArm

from .warm_up import warm_up

if TYPE_CHECKING:
    from argparse import ArgumentParser
    from collections.abc import Sequence


def parser() -> ArgumentParser:
    """Its options: none."""
    layout = argparse.RawDescriptionHelpFormatter
    examples = "examples:\n  compile_nodes"
    return argparse.ArgumentParser(
        prog="compile_nodes", description=__doc__, epilog=examples, formatter_class=layout
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Compile what is not compiled yet; returns the exit code."""
    try:
        parser().parse_args(argv)
    except SystemExit as ended:  # argparse has said it already
        return int(ended.code or 0)
    began = time.monotonic()
    warm_up()
    corrector.warm_up(EffectSet(), None)
    corrector.warm_up(
        EffectSet((TagLeverArm(values={"z": 0.1}),)), None
    )  # a frame on /tf_static brings one, while the node runs
    print(f"both nodes are compiled; {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
