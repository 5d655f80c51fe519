# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the commands that the documentation shows.

A shell runs the code blocks of a page. Its PATH holds only stubs that log their arguments. The
shell expands braces, variables and loops.
"""

from pathlib import Path
import re
import shutil
import subprocess

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
LISTED = ("ls", "grep")  # real programs that the blocks need
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:\./dev|ros2|uwb-tdoa) [^`]+)`")
PLACEHOLDERS = ("PACKAGE NAME", "PKG EXE", "NAME ARGS")


def commands(page, names, folder):
    """Return [(page, [word, ...])] of the commands on a page.

    The first word is ./dev, ros2, uwb-tdoa or in `names`.

    folder : an empty working directory; it gets stubs, ./dev and a DATA like the measured flights
    """
    text = page.read_text()
    scripts = [
        block
        for language, block in BLOCK.findall(text)
        if language in ("", "sh", "bash") and _is_shell(block, names)
    ]
    scripts += [
        line for line in INLINE.findall(text) if not any(word in line for word in PLACEHOLDERS)
    ]
    notes = folder / "notes"
    notes.touch()
    stubs = folder / "stubs"
    _write_stubs(stubs, ["ros2", "uwb-tdoa", *names], notes)
    shutil.copy(stubs / "ros2", folder / "dev")
    _write_stub(folder / "dev", "./dev", notes)
    _write_data(folder / "DATA")
    script = "DATA=DATA; S='--survey DATA/surveys'; F=DATA/flights\n" + "\n".join(
        map(_without_brackets, scripts)
    )
    bash = shutil.which("bash")
    done = subprocess.run(
        [bash, "-c", script],
        cwd=folder,
        env={"PATH": str(stubs)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "syntax error" not in done.stderr, done.stderr
    found = [line.split("\0")[:-1] for line in notes.read_text().split("\n")[:-1]]
    return [(page.name, words) for words in found]


def _is_shell(block, names):
    first = [
        line.split()[0] for line in block.splitlines() if line.strip() and not line.startswith(" ")
    ]
    return any(word in ("./dev", "ros2", "uwb-tdoa", "for", *names) for word in first)


def _without_brackets(script):
    """Keep optional arguments: [--option value] becomes --option value."""
    return re.sub(r"\[(--[^\]]+)\]", r"\1", script)


def _write_stubs(folder, names, notes):
    folder.mkdir()
    for name in names:
        _write_stub(folder / name, name, notes)
    for name in LISTED:
        (folder / name).symlink_to(shutil.which(name))


def _write_stub(path, name, notes):
    path.write_text(
        f'#!{shutil.which("bash")}\nprintf "%s\\0" {name} "$@" >> {notes}\necho >> {notes}\n'
    )
    path.chmod(0o755)


def _write_data(folder):
    for name in (
        "flights/0425/TDOA2",
        "flights/0425/TDOA3",
        "flights/0426",
        "flights/0422",
        "flights/0607",
        "surveys",
    ):
        (folder / name).mkdir(parents=True)
    (folder / "util").mkdir()
    for number in (1, 3, 4):
        (folder / "util" / f"const{number}-trial1-tdoa2.csv.gz").touch()
