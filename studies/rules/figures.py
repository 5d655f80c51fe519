# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""rules: measure the worth of each rule and each constant of the filter's core. With --watch: of
the rules over streams and residuals.

Each rule is switched off, and each constant is halved and doubled, one at a time. The study then
compares the errors on recordings, flights of `fly`, starts and faults. The filter is compiled once:
see `studies/rules/tuned.py`.
"""

from __future__ import annotations

from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable
import json
import math
import os
from pathlib import Path
import pickle
import subprocess
import sys

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_tools.outputs import OutputFile, OutputFolder

from . import tuned, watching, work
from .worth import NOTICED, Worth, noise_of, worth


def add_options(add: Callable) -> None:
    """The options of the study."""
    add("--data", required=True, type=Path, metavar="DATA", help="folder of measured flights")
    add(
        "--results",
        required=True,
        type=OutputFile,
        metavar="FILE",
        help="results are written there, JSON",
    )
    add(
        "--cache",
        type=OutputFolder,
        metavar="DIR",
        default=Path("rules"),
        help="copy and inputs go there",
    )
    add("--full", action="store_true", help="all rows, not those of the screen alone")
    add("--watch", action="store_true", help="rules over streams and residuals instead")
    add("--only", nargs="+", metavar="WORD", default=[""], help="variants with one of these words")
    add("--rows", nargs="+", metavar="WORD", default=[], help="rows with one of these words")
    add("--stop", action="store_true", help="leave a variant when it is decided")
    add("--table", action="store_true", help="run nothing: print what FILE holds")


def run(args: Namespace) -> None:
    """Run the variants, and print the table."""
    cache = Path(args.cache).absolute()
    cache.mkdir(parents=True, exist_ok=True)
    made = tuned.copy_to(cache)
    if not args.table:
        _work(args, cache, made)
    if not Path(args.results).exists():
        raise InputError(f"{args.results} is not there: run the study without --table first.")
    found = read(Path(args.results))
    print(table_of_watch(found) if args.watch else table(found))


def _work(args: Namespace, cache: Path, made: tuned.Tuned) -> None:
    job = {
        "tuned": made,
        "data": args.data.absolute(),
        "cache": cache,
        "results": Path(args.results).absolute(),
        "screen": not args.full,
        "watch": args.watch,
        "stop": args.stop,
        "only": args.only,
        "rows": args.rows,
    }
    path = cache / f"job {os.getpid()}.pickle"
    write_bytes(path, pickle.dumps(job))
    before = [str(made.folder), *sys.path]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in before if part)}
    try:
        subprocess.run([sys.executable, "-m", work.__name__, str(path)], env=env, check=True)
    finally:
        path.unlink()


Figures = dict[str, dict[str, dict[str, list]]]  # of each variant and row: spans, or findings


def read(path: Path) -> Figures:
    """{variant: {row: {span: figures}}} of a file of results."""
    found: Figures = defaultdict(dict)
    for key, result in json.loads(path.read_text()).items():
        variant, row = key.split(" | ", 1)
        found[variant][row] = result["said"] if "said" in result else result["figures"]
    return dict(found)


def table(found: Figures) -> str:
    """Markdown: each rule, those that change least first; then each constant."""
    base = found.get(work.BASE, {})
    noise = noise_of(base, (rows for name, rows in found.items() if name.startswith(work.NUDGED)))
    each = {
        name: worth(base, rows, noise)
        for name, rows in found.items()
        if name != work.BASE and not name.startswith(work.NUDGED)
    }
    lines = [
        "| rule | rows | changed | 3D RMSE, mean | NEES beyond 3 | largest loss | largest gain |",
        "|---|---:|---:|---:|---:|---|---|",
    ]
    of_rules = {name: one for name, one in each.items() if not _scaled(name)}
    for name, one in sorted(
        of_rules.items(), key=lambda item: (item[1].changed, abs(item[1].mean))
    ):
        same = " (same to the bit)" if one.same else ""
        lines.append(
            f"| {name}{same} | {one.rows} | {one.changed} | {one.mean:+.2%} | {one.nees:+.2f} | "
            f"{_largest(one.worse)} | {_largest(one.better)} |"
        )
    texts = {name: _most(one) for name, one in each.items() if _scaled(name)}
    return "\n".join([*(lines if of_rules else []), *constants(texts)])


def constants(texts: dict[str, str]) -> list[str]:
    """Lines of Markdown: each constant, and what its half and its double change."""
    if not texts:
        return []
    lines = ["", "| constant | halved | doubled |", "|---|---|---|"]
    for name in sorted({_scaled(variant) for variant in texts}):
        cells = [texts.get(f"{name} x {factor:g}", "") for factor in work.FACTORS]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return lines


def _scaled(variant: str) -> str:
    """Name of the constant that a variant scales, "" for a rule."""
    name, _, factor = variant.rpartition(" x ")
    return name if factor in [f"{one:g}" for one in work.FACTORS] else ""


def _most(one: Worth) -> str:
    """The largest change, and of how many rows."""
    if not one.changes:
        return f"- ({one.rows})"
    row, share = max(one.changes.items(), key=lambda item: abs(item[1]))
    return f"{_percent(share)}: {row} ({one.changed} of {one.rows})"


def _percent(share: float) -> str:
    if math.isinf(share):
        return "lost" if share > 0.0 else "found"
    return f"x {1.0 + share:.0f}" if share >= 9.0 else f"{share:+.0%}"


def _largest(of: tuple[float, str]) -> str:
    share, row = of
    return f"{_percent(share)}: {row}" if abs(share) > NOTICED else ""


def table_of_watch(found: Figures) -> str:
    """Markdown: changes of the findings without each rule; then with each constant changed."""
    base = found.get(work.BASE, {})
    lines = ["| rule | rows | changed | which |", "|---|---:|---:|---|"]
    texts, made = {}, []
    for name, rows in found.items():
        changes = {
            row: watching.differs(base[row], said) for row, said in rows.items() if row in base
        }
        which = [
            f"{row}: {', '.join(f'`{rule}` {kind}' for rule, kind in one.items())}"
            for row, one in changes.items()
            if one
        ]
        if _scaled(name):
            texts[name] = (
                f"{which[0]} ({len(which)} of {len(rows)})" if which else f"- ({len(rows)})"
            )
        elif name != work.BASE:
            made.append((len(which), name, len(changes), "; ".join(which[:3])))
    lines += [f"| {name} | {rows} | {count} | {some} |" for count, name, rows, some in sorted(made)]
    return "\n".join([*(lines if made else []), *constants(texts)])
