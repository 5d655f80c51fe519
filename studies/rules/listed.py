# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Numbers of `core` and `monitoring` that stand in no table of the notebook."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
import re

import uwb_tdoa_ekf

from .catalogue import STRUCTURE
from .tuned import FOLDERS, PACKAGE
from .watching import NO_TUNING, is_number, tuned_names


def unlisted(page: str) -> list[str]:
    """Names of module-level numbers, "plane.PERIOD" or "monitoring.change.OUTLIER", that a page of
    Markdown has in no cell. What nobody chose counts as listed: STRUCTURE and NO_TUNING.
    """
    fixed = {*STRUCTURE, *(f"monitoring.{name}" for name in NO_TUNING)}
    source, out = Path(uwb_tdoa_ekf.__file__).parent, []
    for folder in FOLDERS:
        for path in sorted((source / folder).glob("*.py")):
            module = importlib.import_module(f"{PACKAGE}.{folder}.{path.stem}")
            for name in tuned_names(ast.parse(path.read_text())):
                key = f"{folder}.{path.stem}.{name}".removeprefix("core.")
                in_a_cell = re.search(rf"^\|.*`{re.escape(key)}`", page, re.MULTILINE)
                if is_number(getattr(module, name)) and key not in fixed and not in_a_cell:
                    out.append(key)
    return out
