# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""fuzz: changed files of every kind, given to every reader. A reader returns, or raises InputError,
within 5 s and 500 MB.

Bytes, words and lines of the small files in studies/corpus are changed. Seed and number determine
each file, so that --seed and --first repeat it. One process reads the files of a kind, one after the
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
import shutil
import signal
import tempfile
import time
import traceback

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.errors import Failure, InputError
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_bias.common.flight import Flight, Tdoas
from uwb_tdoa_bias.common.safe_yaml import parse_yaml
from uwb_tdoa_bias.common.survey import NamedAnchors, read_named_anchors
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf import launching
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import BiasMap
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.bags.bag import read_bag
from uwb_tdoa_tools.cli import OutputFolder
from uwb_tdoa_tools.planning.optimisation import AnchorPlaces
from uwb_tdoa_tools.planning.precision import antenna_from_yaml
from uwb_tdoa_tools.readers import (
    load_profile,
    read_by_profile,
    read_usd_log,
    read_util_csv,
)
from uwb_tdoa_tools.readers.profile import Profile, parse_columns
from uwb_tdoa_tools.readers.suggest import suggest
from uwb_tdoa_tools.simulation.config import Walls
from uwb_tdoa_tools.surveying.report import read_distances, read_marks

from . import table

SECONDS, MEGABYTES = 5.0, 500  # processor time and memory of one file
CORPUS = Path(__file__).parent / "corpus"
ANCHORS = Anchors(
    [0, 1, 5], [[0.1, 0.2, 0.3], [4.0, 0.0, 3.0], [4.0, 5.0, 0.2]], np.full((3, 4), np.nan)
)
MINUTE = Tdoas(np.array([0.0, 60.0]), np.zeros(2, int), np.ones(2, int), np.ones(2))
COLUMNS = "time=t:ms,anchor_a=from,anchor_b=to,tdoa=d:mm"
COLUMNS += ",gyro_x=gx,gyro_y=gy,gyro_z=gz,accel_x=ax,accel_y=ay,accel_z=az"
_FOLDER = tempfile.TemporaryDirectory(prefix="fuzz_")  # until this process ends


def _by_profile(path, profile):
    return read_by_profile([path], profile, NamedAnchors(ANCHORS))


def _metadata(path):
    """Read a bag with this metadata.yaml."""
    shutil.copy(CORPUS / "bag_mcap" / "small", path.parent / "small.mcap")
    return read_bag(path.parent)


TARGETS = {  # {kind: reads a file}
    "yaml": lambda path: parse_yaml(path.read_bytes(), "input"),
    "effects": EffectSet.from_yaml,
    "config": FilterConfig.from_yaml,
    "antenna": lambda path: antenna_from_yaml(path).gain(np.eye(3)),
    "places": AnchorPlaces.from_yaml,
    "walls": lambda path: Walls.from_yaml(path).between(np.zeros((1, 3)), np.ones((1, 3))),
    "survey": read_named_anchors,
    "log": lambda path: read_usd_log(path, ANCHORS),
    "log_salvaged": lambda path: read_usd_log(path, ANCHORS, salvage=True),
    "csv": lambda path: read_util_csv(path, ANCHORS),
    "csv_salvaged": lambda path: read_util_csv(path, ANCHORS, salvage=True),
    "bag_mcap": lambda path: read_bag(path, anchors=ANCHORS),
    "bag_sqlite": read_bag,
    "bag_metadata": _metadata,
    "bag_ros_1": lambda path: _by_profile(path, load_profile("uwb_msgs")),
    "ulog": lambda path: _by_profile(path, load_profile("px4")),
    "columns": lambda path: _by_profile(path, Profile.of_columns(parse_columns(COLUMNS))),
    "profile": lambda path: _by_profile(CORPUS / "bag_ros_1" / "plain", load_profile(path)),
    "suggestion": lambda path: suggest([path]),
    "marks": lambda path: read_marks(path, [Flight("monday", ANCHORS, MINUTE)]),
    "distances": lambda path: read_distances(path, ANCHORS),
    "tags": lambda path: launching.tags(path, {}),
    "flyable": FlyableVolume.load,
    "bias_map": BiasMap.load,
    "model": Network,
}
# whose corpus a kind starts from, if not its own
SEEDS = {"log_salvaged": "log", "csv_salvaged": "csv", "suggestion": "bag_ros_1"}
NAMES = {  # of the file, where the name matters
    "bag_mcap": "input.mcap",
    "bag_sqlite": "input.db3",
    "bag_metadata": "metadata.yaml",
    "bag_ros_1": "input.bag",
    "suggestion": "input.bag",
    "profile": "profile.yaml",
}
FLIGHTS = "log", "csv", "bag", "columns"  # beginnings of kinds whose readers return a Flight
TEXTS = (
    *("yaml", "effects", "config", "antenna", "places", "walls", "survey", "csv", "csv_salvaged"),
    *("bag_metadata", "columns", "profile", "marks", "distances", "tags"),
)
WORDS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-0", "-1", "1e400", "9" * 400),
    *("0x10", "65536", "4294967296", "18446744073709551616", "", " ", "true", "~", "1_0", "\u0661"),
    *("x" * 5000, "$\\frac$", "\x1b[2J", "<b>", "{", "[[[[", "&a", "*a", "!!int"),
)
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
NUMBERS += (2**63 - 1, 2**64 - 1, 0x7FF0 << 48, 0x7FF8 << 48)


def add_options(add):
    """add : add_argument of a parser."""
    add("kinds", nargs="*", metavar="KIND", help=f"these alone, of {', '.join(TARGETS)}")
    add("--count", type=int, default=1000, metavar="N", help="files of each kind (default: 1000)")
    add("--first", type=int, default=0, metavar="N", help="number of the first (default: 0)")
    add("--seed", type=int, default=0, metavar="N", help="of the changes (default: 0)")
    words = "for the files of findings (default: out/fuzz)"
    add("--out", type=OutputFolder, default="out/fuzz", metavar="DIR", help=words)


def run(args):
    """Print a table, a row for each kind, and every finding. Returns 1 if there is one."""
    unknown = sorted({*args.kinds} - {*TARGETS})
    if unknown:
        raise InputError(f"KIND: {', '.join(unknown)} is none of {', '.join(TARGETS)}.")
    found = 0
    numbers = "files", "read", "refused", "slowest, s", "largest, MB", "findings"
    cli.show(table.head("kind", *numbers))
    for kind in args.kinds or TARGETS:
        last = args.first + args.count
        outcomes, slowest, largest, findings = fuzz(kind, args.seed, args.first, last)
        counts = outcomes.total(), outcomes["read"], outcomes["refused"]
        cells = f"{slowest:.2f}", f"{largest:.0f}", len(findings)
        cli.show(table.line([kind, *counts, *cells]))
        for number, what in findings.items():
            name = f"{kind}-{args.seed}-{number}"
            args.out.mkdir(parents=True, exist_ok=True)
            write_bytes(args.out / name, changed(kind, args.seed, number))
            cli.show(f"{name}: {what}")
        found += len(findings)
    return int(found > 0)


def seeds(kind):
    """Paths of the corpus of a kind."""
    return sorted((CORPUS / SEEDS.get(kind, kind)).iterdir())


def read(kind, data):
    """Give a file with the data to the reader of a kind."""
    path = Path(_FOLDER.name) / kind / NAMES.get(kind, "input")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    result = TARGETS[kind](path)
    if kind.startswith(FLIGHTS):
        for stream, columns in {
            "tdoa": "tabd",
            "imu": ("t", "gyro", "accel"),
            "truth": "tp",
        }.items():
            part = getattr(result, stream)
            for name in columns if part is not None else ():
                assert np.isfinite(getattr(part, name)).all(), (stream, name)


def changed(kind, seed, number):
    """The content of a file: one of the corpus, changed once or several times."""
    chance = random.Random(f"{kind} {seed} {number}")
    data = chance.choice(seeds(kind)).read_bytes()
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        as_text = kind in TEXTS and chance.random() < 0.6
        data = (_with_changed_text if as_text else _with_changed_bytes)(data, chance)
    return data


def _with_changed_bytes(data, chance):
    data, at = bytearray(data), chance.randrange(len(data) + 1)
    what, size = chance.randrange(5), chance.choice((1, 2, 4, 8))
    if what == 0:
        number = chance.choice(NUMBERS) & (1 << 8 * size) - 1
        data[at : at + size] = number.to_bytes(size, chance.choice(("little", "big")))
    elif what == 1:
        del data[at : at + size]
    elif what == 2:
        data[at:at] = chance.randbytes(size)
    elif what == 3:
        start = chance.randrange(len(data) + 1)
        data[at:at] = data[start : start + 8 * size]
    else:
        del data[at:]
    return bytes(data)


def _with_changed_text(data, chance):
    text = data.decode("utf-8", "replace")
    words, lines = list(re.finditer(r"[-+.\w]+", text)), text.splitlines(keepends=True) or [""]
    at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    what = chance.randrange(4)
    if what == 0 and words:
        word = chance.choice(words)
        text = text[: word.start()] + chance.choice(WORDS) + text[word.end() :]
        return text.encode("utf-8", "surrogatepass")
    if what == 1:
        lines[at:at] = [lines[other]] * chance.choice((1, 3, 100))
    elif what == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        del lines[at]
    return "".join(lines).encode("utf-8", "surrogatepass")


def fuzz(kind, seed, first, end):
    """(Counter of outcomes, slowest in s, largest in MB, {number: finding}) of some files.

    If several findings are at the same place of the code, the first is kept.
    """
    outcomes, slowest, largest, findings, number = Counter(), 0.0, 0.0, {}, first
    fork = multiprocessing.get_context("fork")
    while number < end:
        ours, theirs = fork.Pipe(duplex=False)
        reader = fork.Process(target=_read, args=(theirs, kind, seed, number, end))
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
        except EOFError:
            reader.join()
        if reader.exitcode > 0:
            raise Failure(f"{kind}: its corpus cannot be read; see above.")
        if number < end:
            findings[number] = outcome = f"ended by {signal.Signals(-reader.exitcode).name}"
            outcomes[outcome] += 1
            slowest = max(slowest, SECONDS if reader.exitcode == -signal.SIGPROF else 0.0)
            number += 1
    return outcomes, slowest, largest, findings


def _read(pipe, kind, seed, first, end):
    """Read files, and send (outcome, s, MB) of each.

    Ends this process where one takes too long, even within a library.
    """
    for path in seeds(kind):
        read(kind, path.read_bytes())  # time to import and compile does not count
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    most = _kilobytes("VmData") + (MEGABYTES << 10) << 10
    resource.setrlimit(resource.RLIMIT_DATA, (most, resource.RLIM_INFINITY))
    for number in range(first, end):
        data = changed(kind, seed, number)
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before, began = _kilobytes("VmRSS"), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            read(kind, data)
            outcome = "read"
        except InputError:
            outcome = "refused"
        except Exception as error:  # a MemoryError, too
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = f"{type(error).__name__} in {last.name}, {last.filename}, line {last.lineno}"
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        megabytes = max(0.0, _kilobytes("VmHWM") - before) / 1024.0
        pipe.send((outcome, time.process_time() - began, megabytes))


def _kilobytes(name):
    return int(re.search(rf"{name}:\s+(\d+)", Path("/proc/self/status").read_text())[1])
