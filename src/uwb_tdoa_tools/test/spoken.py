"""What the nodes say on /diagnostics when something is wrong, read from their sources."""

import ast
from pathlib import Path

SRC = Path(__file__).resolve().parents[2]
FOLDERS = ("uwb_tdoa_bias/uwb_tdoa_bias", "uwb_tdoa_ekf/uwb_tdoa_ekf")
LEVELS = {"WARN", "ERROR"}
# functions that give sentences
SAYING = {
    "trouble",
    "unknown_frame",
    "several_publishers",
    "_sentence",
    "_no_start",
    "_axis_alarms",
    "trouble_at",
    "lost",
    "side_unknown",
    "unsure",
}
LEAST = 7  # characters that tell one sentence from another


def sentences():
    """{what is always in a sentence: file} of warnings and errors: texts beside a level, texts of
    functions that are known to give sentences, and what is put into sentences.
    """
    found = {}
    for folder in FOLDERS:
        for path in sorted(
            set((SRC / folder).rglob("*.py")) - set((SRC / folder / "effects").glob("*.py"))
        ):
            for text in map(_fixed, _texts(ast.parse(path.read_text()))):
                if len(text) > LEAST:
                    found[text] = path.name
    return found


def rules():
    """Names of all Findings, of the streams and of `check`."""
    found = set()
    folders = "uwb_tdoa_ekf/uwb_tdoa_ekf/streams", "uwb_tdoa_tools/uwb_tdoa_tools/checking"
    for paths in (
        [SRC / "uwb_tdoa_ekf/uwb_tdoa_ekf/monitoring/monitor.py"],
        *((SRC / folder).rglob("*.py") for folder in folders),
    ):
        for path in paths:
            for node in ast.walk(ast.parse(path.read_text())):
                if (
                    isinstance(node, ast.Call)
                    and _name(node.func) in ("Finding", "_says")
                    and node.args
                ):
                    if isinstance(node.args[0], ast.Constant):
                        found.add(node.args[0].value)
    return found


def _texts(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Tuple) and len(node.elts) >= 2 and _name(node.elts[0]) in LEVELS:
            yield node.elts[1]
        elif isinstance(node, ast.Assign) and _name(node.targets[0]) in ("refused", "what"):
            yield node.value
        elif isinstance(node, ast.Assign) and _name(node.targets[0]) == "reasons":
            yield from getattr(node.value, "values", ())
        elif isinstance(node, ast.FunctionDef) and node.name in SAYING:
            for inner in ast.walk(node):
                if isinstance(inner, ast.Return) and inner.value is not None:
                    value = (
                        inner.value.elt if isinstance(inner.value, ast.ListComp) else inner.value
                    )
                    yield value.elts[0] if isinstance(value, ast.Tuple) and value.elts else value
                elif isinstance(inner, ast.Call) and _name(inner.func) == "append":
                    yield inner.args[0]


def _name(node):
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def _fixed(node):
    """The beginning of a text up to its colon; of one that begins with a value the longest part
    that stays.
    """
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    texts = [
        part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else ""
        for part in parts
    ]
    begin = texts[0].partition(":")[0]
    fixed = (
        begin if len(begin) > LEAST else max((text.partition(":")[0] for text in texts), key=len)
    )
    return fixed.strip(" ,'(")
