# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the studies share: the options of trials, trials in parallel, and Markdown tables."""

from itertools import islice
import json

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.cli import OutputFile, as_json


def add_options(add, draws=None, first=0, jobs=None):
    """Add the common options.

    add : add_argument of a parser
    draws, first : defaults of --draws and --first; without draws the study has no seeds
    jobs : default of --jobs; None: one for each core
    """
    if draws is not None:
        words = "trials of each row (default %(default)s)"
        add("--draws", type=parallel.whole_number, default=draws, metavar="N", help=words)
        words = "of the first trial (default %(default)s)"
        add("--first", type=int, default=first, metavar="SEED", help=words)
    words = f"trials at once (default: {jobs or 'one for each core'})"
    add("--jobs", type=parallel.whole_number, default=jobs, metavar="N", help=words)
    add("--json", type=OutputFile, metavar="FILE", help="write the result of each trial")


def add_only(add):
    """Add the option that `chosen` reads."""
    words = "rows with one of these in their name (default: all)"
    add("--only", nargs="+", default=[""], metavar="WORD", help=words)


def chosen(args, names):
    """The names that contain a word of --only. Raises InputError if there is none."""
    found = [name for name in names if any(word in name for word in args.only)]
    if not found:
        words = " or ".join(args.only)
        raise InputError(f"--only: no row has {words} in its name; they are: {'; '.join(names)}.")
    return found


def seeds(args):
    """The seeds of --draws and --first."""
    return range(args.first, args.first + args.draws)


def results(function, items, args, unit="trial"):
    """Yield function(item) of every item, in order, and keep all of them in the file of --json."""
    done = []
    for result in parallel.over(function, items, args.jobs, unit=unit):
        done.append(result)
        keep(args, done)  # now: an interrupted study keeps what it has
        yield result


def keep(args, done):
    """Write the results so far to the file of --json, if there is one."""
    if args.json:
        write_text(args.json, json.dumps(as_json(done), indent=1))


def trials(function, names, args):
    """Yield (name, [function((name, seed)) of each seed]) of every name."""
    items = [(name, seed) for name in names for seed in seeds(args)]
    done = results(function, items, args)
    for name in names:
        yield name, list(islice(done, args.draws))


def head(*columns, texts=1):
    """The head of a table whose first `texts` columns are texts, and the others numbers."""
    return f"{line(columns)}\n|{'---|' * texts}{'---:|' * (len(columns) - texts)}"


def line(cells):
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"
