# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/symptoms.md names every finding of `check`, with its severity, and no other."""

import ast
import re

from documented import ROOT
from number_faults import FAULTS

SRC = ROOT / "src"
PAGE = (ROOT / "docs" / "symptoms.md").read_text()


def findings():
    """Return {rule: its severities} of all Findings, of the streams and of `check`.

    The set is empty if the source does not show the severity.
    """
    found = {}
    monitoring = SRC / "uwb_tdoa_ekf/uwb_tdoa_ekf/monitoring"
    for paths in (
        [monitoring / "monitor.py", monitoring / "stream_rules.py", monitoring / "survey_scale.py"],
        [monitoring / f"{kind}_rules.py" for kind in ("stamp", "inertial", "ranging")],
        (SRC / "uwb_tdoa_tools/uwb_tdoa_tools/checking").rglob("*.py"),
        (SRC / "uwb_tdoa_bias/uwb_tdoa_bias/common/sensors").glob("*.py"),
    ):
        for path in paths:
            for function in ast.walk(ast.parse(path.read_text())):
                if isinstance(function, ast.FunctionDef):
                    for rule, severities in _made_in(function):
                        found.setdefault(rule, set()).update(severities)
    return found


def _made_in(function):
    """Yield (rule, its severities) of each Finding that a function makes."""
    given = {"ERROR": {"error"}, "WARNING": {"warning"}, "NOTE": {"note"}}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and _name(node.targets[0]) == "severity":
            given.setdefault("severity", set()).update(_severities(node.value, given))
    for node in ast.walk(function):
        made = _name(node.func) if isinstance(node, ast.Call) and node.args else None
        if made in MAKERS and isinstance(node.args[0], ast.Constant):
            yield node.args[0].value, MAKERS[made](node.args, given)


def _severities(node, given):
    if isinstance(node, ast.IfExp):
        return _severities(node.body, given) | _severities(node.orelse, given)
    return given.get(_name(node), set())


def _of_mistake(arguments, _):
    """Return the severities of a Mistake. Its last argument chooses between error and warning."""
    if len(arguments) < 6:
        return {"error"}
    severe = arguments[5]
    if isinstance(severe, ast.Constant):
        return {"error"} if severe.value else {"warning"}
    return {"error", "warning"}


MAKERS = {  # {function that makes a finding: severities by its arguments}
    "Finding": lambda arguments, given: _severities(arguments[1], given),
    "MistakeTrial": lambda arguments, given: {"error"},
    "Mistake": _of_mistake,
}


def _name(node):
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def rows():
    """Yield (rules of a row, their severities) of the table."""
    table = PAGE.partition("## What `check` finds\n")[2]
    cells = [line.split("|")[1:3] for line in table.splitlines() if line.startswith("| `")]
    for names, severities in cells:
        named = re.findall(r"`(\w+)`", names)
        stated = [set(one.split(" or ")) for one in severities.strip().split(", ")]
        yield named, stated * len(named) if len(stated) == 1 else stated


def test_every_finding_of_check_is_on_the_page_and_no_other():
    named = [name for names, _ in rows() for name in names]
    of_numbers = {
        rule for fault in FAULTS.values() for rule in fault.rules
    }  # some rules are named after their subject
    assert len(named) == len(set(named)) and set(named) == findings().keys() | of_numbers


def test_the_page_states_the_severity_of_each_finding():
    made = findings()
    assert sum(bool(severities) for severities in made.values()) > 60
    for names, stated in rows():
        assert len(names) == len(stated), names
        for name, severities in zip(names, stated):
            assert severities and severities <= {"error", "warning", "note"}, name
            assert not made.get(name) or severities == made[name], (name, made[name])
