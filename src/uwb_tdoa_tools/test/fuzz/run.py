"""Fuzz the readers for as long as you like, in a shell with the workspace sourced (./dev shell):

    python src/uwb_tdoa_tools/test/fuzz/run.py --seconds 600                 # each target for 10 minutes
    python src/uwb_tdoa_tools/test/fuzz/run.py yaml csv --seconds 60
    python src/uwb_tdoa_tools/test/fuzz/run.py yaml --repeat finding         # one input again

With atheris (pip install atheris) it follows the coverage of our code, and stops a target that takes more than 10 s or
2 GB; without, it changes the corpus blindly. Every target runs in a process of its own. What is no return and no
InputError is a finding: its input is kept in --out, and the exit code is 1. The executions are added up in
--out/executions.json. What the fuzzer found to reach new code stays in --out/corpus and is taken up again.
"""

import argparse
from collections import Counter
import json
from pathlib import Path
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback

sys.path.insert(0, str(Path(__file__).resolve().parent))

try:
    import atheris
except ImportError:
    atheris = None
LIMITS = ["-timeout=10", "-rss_limit_mb=2048", "-max_len=65536", "-print_final_stats=1", "-verbosity=0"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="default: all")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target (default: 60)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="default: out/fuzz")
    parser.add_argument("--repeat", type=Path, help="run one target on this input")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        return child(args.targets[0], args.seconds, args.out)
    if args.repeat:
        return repeat(args.targets[0], args.repeat)
    return parent(args.targets or names(), args.seconds, args.out)


def names():
    import targets

    targets.clean_up()
    return list(targets.TARGETS)


def repeat(name, path):
    import targets

    try:
        targets.run(name, path.read_bytes())
    finally:
        targets.clean_up()


def parent(targets, seconds, out):
    """Run each in a process, add up executions, and tell the findings."""
    (out / "findings").mkdir(parents=True, exist_ok=True)
    file, findings = out / "executions.json", 0
    for name in targets:
        command = [sys.executable, "-W", "ignore", __file__, name, "--child", "--seconds", str(seconds), "--out", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        said = done.stdout + done.stderr
        counts = re.findall(r"(?:number_of_executed_units:|executions:) +(\d+)", said)
        total = Counter(json.loads(file.read_text()) if file.exists() else {})
        total[name] += sum(map(int, counts))
        file.write_text(json.dumps(total, indent=1) + "\n")
        if done.returncode:
            findings += 1
            (out / "findings" / f"{name}.log").write_text(said)
        state = f"FINDING, see {out / 'findings' / name}.log" if done.returncode else "nothing"
        print(f"{name:22s} {counts[-1] if counts else '?':>9s} executions: {state}", flush=True)
    print(f"{sum(json.loads(file.read_text()).values())} executions so far")
    return 1 if findings else 0


def child(name, seconds, out):
    corpus = out / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    if atheris is None:
        return blind(name, seconds, out)
    ours, compiled = ["uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"], ["uwb_tdoa_tools.readers.usd_scan"]
    ours += ["yaml"] if name == "yaml" else []  # followed there, it need not be slow elsewhere
    with atheris.instrument_imports(include=ours, exclude=compiled):  # numba cannot compile what is followed
        import targets
    tempfile.tempdir = str(targets.FOLDER)  # of the readers too
    for seed in targets.seeds(name):
        (corpus / f"seed_{seed.name}").write_bytes(seed.read_bytes())
    options = [*LIMITS, f"-max_total_time={int(seconds)}", f"-artifact_prefix={out}/findings/{name}-", str(corpus)]
    atheris.Setup([sys.argv[0], *options], lambda data: targets.run(name, data))
    try:
        atheris.Fuzz()
    finally:
        targets.clean_up()


def blind(name, seconds, out):
    import targets

    chance, seeds, count = random.Random(), [path.read_bytes() for path in targets.seeds(name)], 0
    until = time.monotonic() + seconds
    try:
        while time.monotonic() < until:
            data = changed(chance.choice(seeds), chance)
            count += 1
            try:
                targets.run(name, data)
            except Exception:
                traceback.print_exc()
                (out / "findings" / f"{name}-blind").write_bytes(data)
                return 1
    finally:
        print(f"executions: {count}")
        targets.clean_up()
    return 0


def changed(data, chance):
    """The data with some bytes changed, left out, put in or repeated."""
    data = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 4, 8))):
        what, at = chance.randrange(4), chance.randrange(len(data) + 1)
        if what == 0 and at < len(data):
            data[at] = chance.randrange(256)
        elif what == 1:
            del data[at : at + chance.choice((1, 2, 8, 64))]
        elif what == 2:
            data[at:at] = chance.randbytes(chance.choice((1, 2, 8)))
        else:
            start = chance.randrange(len(data) + 1)
            data[at:at] = data[start : start + chance.choice((1, 4, 16, 64))]
    return bytes(data)


if __name__ == "__main__":
    sys.exit(main())
