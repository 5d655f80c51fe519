# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""fuzz: changed files of every kind, given to every reader. A reader returns, or raises InputError,
within 5 s and 500 MB.

The small files of the fuzz corpus are changed by their structure. Seed and number determine each
file, so that --seed and --first repeat it. One process reads the files of a kind, one after the
other. A file that takes too long ends the process, and a new process continues with the next file.
Memory is the peak that a file adds to the process. Findings are kept in --out: the file, named by
kind, seed and number.
"""

from collections import Counter
import multiprocessing
from pathlib import Path
import random
import re
import resource
import signal
import tempfile
import time
import traceback

from tqdm import tqdm

from studies.fuzzing import mutations, targets
from uwb_tdoa_bias.common.errors import Failure, InputError
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_tools.outputs import OutputFolder

SECONDS, MEGABYTES = 5.0, 500  # processor time and memory of one file


def add_options(add):
    """add : add_argument of a parser."""
    add("kinds", nargs="*", metavar="KIND", help=f"these alone, of {', '.join(targets.TARGETS)}")
    add("--count", type=int, default=1000, metavar="N", help="files of each kind (default: 1000)")
    add("--first", type=int, default=0, metavar="N", help="number of the first (default: 0)")
    add("--seed", type=int, default=0, metavar="N", help="of the changes (default: 0)")
    add(
        "--out",
        type=OutputFolder,
        default="out/fuzz",
        metavar="DIR",
        help="for the files of findings (default: out/fuzz)",
    )


def run(args):
    """Print a table, a row for each kind, and every finding. Returns 1 if there is one."""
    unknown = sorted({*args.kinds} - {*targets.TARGETS})
    if unknown:
        raise InputError(f"KIND: {', '.join(unknown)} is none of {', '.join(targets.TARGETS)}.")
    found = 0
    print(
        "| kind | files | read | refused | slowest, s | largest, MB | findings "
        "|\n|---|---:|---:|---:|---:|---:|---:|"
    )
    for kind in args.kinds or targets.TARGETS:
        outcomes, slowest, largest, findings = fuzz(
            kind, args.seed, args.first, args.first + args.count
        )
        counts = f"{outcomes.total()} | {outcomes['read']} | {outcomes['refused']}"
        print(
            f"| {kind} | {counts} | {slowest:.2f} | {largest:.0f} | {len(findings)} |", flush=True
        )
        for number, what in findings.items():
            name = f"{kind}-{args.seed}-{number}"
            args.out.mkdir(parents=True, exist_ok=True)
            write_bytes(args.out / name, changed(kind, args.seed, number))
            print(f"{name}: {what}", flush=True)
        found += len(findings)
    return int(found > 0)


def changed(kind, seed, number):
    """The content of a file."""
    chance = random.Random(f"{kind} {seed} {number}")
    return mutations.changed(kind, chance.choice(targets.seeds(kind)).read_bytes(), chance)


def fuzz(kind, seed, first, end):
    """(Counter of outcomes, slowest in s, largest in MB, {number: finding}) of some files.

    If several findings are at the same place of the code, the first is kept.
    """
    outcomes, slowest, largest, findings, number = Counter(), 0.0, 0.0, {}, first
    with tqdm(total=end - first, desc=kind, leave=False) as bar:
        while number < end:
            ours, theirs = multiprocessing.get_context("fork").Pipe(duplex=False)
            reader = multiprocessing.get_context("fork").Process(
                target=_read, args=(theirs, kind, seed, number, end)
            )
            reader.start()
            theirs.close()
            try:
                while True:
                    outcome, seconds, megabytes = ours.recv()
                    slowest, largest = max(slowest, seconds), max(largest, megabytes)
                    outcomes[outcome] += 1
                    if outcome not in ("read", "refused") and outcomes[outcome] == 1:
                        findings[number] = outcome
                    number += 1
                    bar.update()
            except EOFError:
                reader.join()
            if reader.exitcode > 0:
                raise Failure(f"{kind}: its corpus cannot be read; see above.")
            if number < end:
                outcome = f"ended by {signal.Signals(-reader.exitcode).name}"
                findings[number], slowest = (
                    outcome,
                    max(slowest, SECONDS if reader.exitcode == -signal.SIGPROF else 0.0),
                )
                outcomes[outcome] += 1
                number += 1
    return outcomes, slowest, largest, findings


def _read(pipe, kind, seed, first, end):
    """Read files, and send (outcome, s, MB) of each.

    Ends this process where one takes too long, even within a library.
    """
    tempfile.tempdir = str(targets.FOLDER)  # of the readers, too
    for path in targets.seeds(kind):
        targets.TARGETS[kind](path.read_bytes())  # time to import and compile does not count
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    resource.setrlimit(
        resource.RLIMIT_DATA,
        (_kilobytes("VmData") + (MEGABYTES << 10) << 10, resource.RLIM_INFINITY),
    )
    for number in range(first, end):
        data = changed(kind, seed, number)
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before, began = _kilobytes("VmRSS"), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            targets.TARGETS[kind](data)
            outcome = "read"
        except InputError:
            outcome = "refused"
        except Exception as error:  # a MemoryError, too
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = f"{type(error).__name__} in {last.name}, {last.filename}, line {last.lineno}"
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        pipe.send(
            (outcome, time.process_time() - began, max(0.0, _kilobytes("VmHWM") - before) / 1024.0)
        )


def _kilobytes(name):
    return int(re.search(rf"{name}:\s+(\d+)", Path("/proc/self/status").read_text())[1])
