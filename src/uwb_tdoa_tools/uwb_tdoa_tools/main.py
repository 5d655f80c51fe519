# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command `uwb-tdoa`: every tool as a subcommand, and completion for a shell.

uwb-tdoa check flight_bag
eval "$(uwb-tdoa --completion)"          # in ~/.bashrc or ~/.zshrc
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator, Sequence
from importlib import import_module
import os
from pathlib import Path
import sys

from uwb_tdoa_bias.common.errors import written_by
from uwb_tdoa_bias.common.executable import executable

from .command_lines import COMMAND, RUN

FOLDER = Path(__file__).parent / "commands"
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("[a-z]*.py")))
# zsh runs completions that were written for bash
SCRIPT = """# Completion of {command} for bash and zsh:  eval "$({command} --completion)"
if [ -n "${{ZSH_VERSION-}}" ]; then autoload -U +X compinit bashcompinit && compinit && bashcompinit; fi
_{function}() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} words=
  if [ "$COMP_CWORD" = 1 ]; then words="{names}"; else
    case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}}" in
{values}
      *) case "${{COMP_WORDS[1]}} $word" in
{options}
      esac ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _{function} {command}
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand with the rest of the command line, and return its exit code.

    argv : default: sys.argv[1:].
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    os.environ[RUN] = (
        COMMAND  # for command lines that are printed to be copied, and other processes
    )
    if arguments and arguments[0] in NAMES:
        start = executable(f"{__package__}.commands.{arguments[0]}")
        return int(start(arguments[1:]) or 0)
    try:
        args = parser().parse_args(arguments or ["--help"])
    except SystemExit as stop:  # argparse has printed the help or the error
        return int(stop.code or 0)
    assert args.completion
    print(completion(), end="")
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line without a subcommand."""
    width = max(map(len, NAMES))
    commands = "\n".join(f"  {name:{width}}  {_purpose(name)}" for name in NAMES)
    made = argparse.ArgumentParser(
        prog=COMMAND,
        usage=f"{COMMAND} COMMAND ...",
        description=f"Localization from UWB time differences of arrival.\n\ncommands:\n{commands}",
        epilog=f"`{COMMAND} COMMAND --help` shows the options of a command, with examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--version", action="version", version=f"{COMMAND} of {written_by()}")
    add = made.add_mutually_exclusive_group(required=True).add_argument
    add("command", nargs="?", metavar="COMMAND", choices=NAMES, help="one of these commands")
    add("--completion", action="store_true", help="print the completion for bash and zsh")
    return made


def _purpose(name: str) -> str:
    """Return the first line of the docstring of a command, without importing it."""
    text = ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text("utf-8"))) or ""
    return text.partition("\n")[0]


def completion() -> str:
    """Return the completion of subcommands, options and their values, as a script for a shell."""
    values, options = [], []
    for name in NAMES:
        known: dict[str, str] = {}
        for action in _actions(import_module(f"{__package__}.commands.{name}").parser()):
            choices = " ".join(map(str, action.choices or ()))
            known |= dict.fromkeys(action.option_strings, choices)
        values += [
            f'      "{name} {option}") words="{choices}" ;;'
            for option, choices in known.items()
            if choices
        ]
        options.append(f'        "{name} -"*) words="{" ".join(known)}" ;;')
    return SCRIPT.format(
        command=COMMAND,
        function=COMMAND.replace("-", "_"),
        names=" ".join(NAMES),
        values="\n".join(values),
        options="\n".join(options),
    )


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the options of a parser, and of its own subcommands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for part in action.choices.values():
                yield from _actions(part)


if __name__ == "__main__":
    sys.exit(main())
