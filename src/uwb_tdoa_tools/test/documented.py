# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages of the documentation, their code blocks, and the commands that a shell makes of them.

The shell expands braces, variables and loops. Every program is a function that notes its words.
"""

from importlib import import_module
from pathlib import Path
import re
import shutil
from tempfile import TemporaryDirectory

from programs import run as run_program

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
NODES = {
    "anchors_node": "uwb_tdoa_bias.anchors_node",
    "autopilot_node": "uwb_tdoa_tools.autopilot_node",
    "bias_node": "uwb_tdoa_bias.bias_node",
    "calibration_node": "uwb_tdoa_tools.calibration_node",
    "debias_node": "uwb_tdoa_ekf.debias_node",
    "ekf_node": "uwb_tdoa_ekf.ekf_node",
    "localization_node": "uwb_tdoa_ekf.localization_node",
    "vehicle_node": "uwb_tdoa_tools.vehicle_node",
}
TOOLS = {
    path.stem: f"uwb_tdoa_tools.commands.{path.stem}"
    for path in sorted((ROOT / "src/uwb_tdoa_tools/uwb_tdoa_tools/commands").glob("[a-z]*.py"))
}
EXECUTABLES = {**NODES, **TOOLS, "compile_nodes": "uwb_tdoa_ekf.compile_nodes"}
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:\./dev|ros2|uwb-tdoa) [^`]+)`")
PLACEHOLDERS = ("PACKAGE NAME", "PKG EXE", "NAME ARGS")
DATA = "DATA=DATA; S='--survey DATA/surveys'; F=DATA/flights\n"  # variables of the pages
# of each program; a list of files, as `ls | grep` makes it, is one file
NOTE = r"""exec 3>&1 >/dev/null
note() { printf '%s\0' "$@" >&3; echo >&3; }
ls() { :; }
grep() { echo FILE; }
"""


def section(page, heading):
    """Return the text below a heading of a page of docs/."""
    text = (ROOT / "docs" / page).read_text()
    level = re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE).group(1)
    below = text.partition(f"{level} {heading}\n")[2]
    return re.split(rf"^#{{2,{max(2, len(level))}}} ", below, flags=re.MULTILINE)[0]


def blocks(text, *languages):
    """Return the contents of the fenced blocks of some languages, or of those without one."""
    return [content for name, content in FENCED.findall(text) if name in (languages or ("",))]


def commands(script):
    """Return [[program, word, ...]] of the programs that a script runs.

    The program is ./dev, ros2, uwb-tdoa, or one of ours. Other programs do not run.
    """
    names = {"dev": "./dev", **{name: name for name in ("ros2", "uwb-tdoa", *EXECUTABLES)}}
    names.pop("export")  # in a shell, this is its own command
    functions = [f'{name}() {{ note {told} "$@"; }}\n' for name, told in names.items()]
    lines = NOTE + "".join(functions) + script.replace("./dev ", "dev ")
    with TemporaryDirectory() as folder:  # some scripts write files
        bash = shutil.which("bash")
        done = run_program(bash, "-c", lines, cwd=folder, env={"PATH": "/nowhere"}, timeout=60)
    assert "syntax error" not in done.stderr, done.stderr
    return [line.split("\0")[:-1] for line in done.stdout.split("\n")[:-1]]


def of_pages():
    """Return [(path of a page, [program, word, ...])] of the commands on all pages."""
    scripts = [DATA]
    for page in PAGES:
        text = page.read_text()
        lines = [one for one in INLINE.findall(text) if not any(p in one for p in PLACEHOLDERS)]
        shell = [one for one in blocks(text, "", "sh", "bash") if _is_shell(one)]
        shown = "\n".join([f"note --page {page.relative_to(ROOT)}", *shell, *lines])
        scripts.append(re.sub(r"\[(--[^\]]+)\]", r"\1", shown))  # with optional arguments
    found = []
    for first, *words in commands("\n".join(scripts)):
        if first == "--page":
            page = words[0]
        else:
            found.append((page, [first, *words]))
    return found


def _is_shell(block):
    first = {line.split()[0] for line in block.splitlines() if re.match(r"\S", line)}
    return bool(first & {"./dev", "ros2", "uwb-tdoa", "for", *EXECUTABLES})


def tools(script):
    """Return [(executable, arguments)] of the lines `./dev run ...` of a script."""
    return [(words[3], words[4:]) for words in commands(script) if words[1] == "run"]


def main(name, words):
    """Run an executable in this process and return its exit code."""
    return import_module(EXECUTABLES[name]).main(words)


def run(script, codes=(0,)):
    """Run the commands of a script in this process. Each must end with one of the exit codes."""
    for name, words in tools(script):
        assert main(name, words) in codes, (name, words)
