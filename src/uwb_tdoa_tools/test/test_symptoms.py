# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/symptoms.md names every finding of `check`, and no other."""

import ast
import re

from documented import ROOT
from number_faults import FAULTS

SRC = ROOT / "src"
PAGE = (ROOT / "docs" / "symptoms.md").read_text()


def rules():
    """Names of all Findings, of the streams and of `check`."""
    found = set()
    monitoring = SRC / "uwb_tdoa_ekf/uwb_tdoa_ekf/monitoring"
    for paths in (
        [monitoring / "monitor.py", monitoring / "stream_rules.py", monitoring / "survey_scale.py"],
        [monitoring / f"{kind}_rules.py" for kind in ("stamp", "inertial", "ranging")],
        (SRC / "uwb_tdoa_tools/uwb_tdoa_tools/checking").rglob("*.py"),
    ):
        for path in paths:
            for node in ast.walk(ast.parse(path.read_text())):
                if (
                    isinstance(node, ast.Call)
                    and _name(node.func) in ("Finding", "_finding_of")
                    and node.args
                ):
                    if isinstance(node.args[0], ast.Constant):
                        found.add(node.args[0].value)
    return found


def _name(node):
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def test_every_finding_of_check_is_on_the_page_and_no_other():
    table = PAGE.partition("## What `check` finds\n")[2]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    of_numbers = {
        rule for fault in FAULTS.values() for rule in fault.rules
    }  # some rules are named after what they are of
    assert len(named) == len(set(named)) and set(named) == rules() | of_numbers
