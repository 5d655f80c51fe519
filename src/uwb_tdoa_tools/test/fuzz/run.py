"""Fuzz the readers for as long as you like, in a shell with the workspace sourced (./dev shell):

    python src/uwb_tdoa_tools/test/fuzz/run.py --seconds 600                 # each target for 10 minutes
    python src/uwb_tdoa_tools/test/fuzz/run.py yaml csv --seconds 60
    python src/uwb_tdoa_tools/test/fuzz/run.py yaml --repeat finding         # one input again

Files of the corpus are changed by their structure (`mutations.py`). With atheris (pip install atheris) it follows the coverage of our
code, too. Every target runs in a process of its own, which is watched: an execution that takes more than SECONDS of processor time
ends it, and memory beyond MEGABYTES more than at the start is refused. What is no return and no InputError is a finding, once for each
place: its input is kept in --out/findings, and the exit code is 1. Executions are added up in --out/executions.json. What atheris
found to reach new code stays in --out/corpus and is taken up again.
"""

import argparse
from collections import Counter
import json
from pathlib import Path
import random
import re
import resource
import signal
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
SECONDS, MEGABYTES = 5.0, 500
LIMITS = [f"-timeout={SECONDS:g}", "-rss_limit_mb=2048", "-max_len=65536", "-print_final_stats=1", "-verbosity=0"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="default: all")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target (default: 60)")
    parser.add_argument("--seed", type=int, help="of the changes; default: another one each time")
    parser.add_argument("--blind", action="store_true", help="without atheris, though it is installed")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="default: out/fuzz")
    parser.add_argument("--repeat", type=Path, help="run one target on this input")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        return child(args.targets[0], args.seconds, args.out, args.seed, args.blind or atheris is None)
    if args.repeat:
        return repeat(args.targets[0], args.repeat)
    return parent(args.targets or names(), args)


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


def parent(targets, args):
    """Run each in a process, again where it was ended, add up executions, and tell the findings."""
    out, findings = args.out, args.out / "findings"
    findings.mkdir(parents=True, exist_ok=True)
    file = out / "executions.json"
    for name in targets:
        until, count, seed = time.monotonic() + args.seconds, 0, random.randrange(2**32) if args.seed is None else args.seed
        while (left := until - time.monotonic()) > 1.0:
            command = [
                sys.executable,
                "-W",
                "ignore",
                __file__,
                name,
                "--child",
                "--seconds",
                str(left),
                "--out",
                str(out),
                "--seed",
                str(seed),
            ]
            done = subprocess.run(command + ["--blind"] * args.blind, capture_output=True, text=True, errors="replace")
            said, seed = done.stdout + done.stderr, seed + 1
            count += sum(map(int, re.findall(r"(?:number_of_executed_units:|executions:) +(\d+)", said)))
            if done.returncode:
                last = out / f"{name}-last"
                if done.returncode < 0 and last.exists():
                    last.rename(findings / f"{name}-{signal.Signals(-done.returncode).name}-{seed}")
                (findings / f"{name}.log").write_text(said)
            if "executions:" in said and done.returncode == 0:
                break
        total = Counter(json.loads(file.read_text()) if file.exists() else {})
        total[name] += count
        file.write_text(json.dumps(total, indent=1) + "\n")
        found = len(list(findings.glob(f"{name}-*")))
        print(f"{name:22s} {count:9d} executions: {f'{found} FINDINGS in {findings}' if found else 'nothing'}", flush=True)
    print(f"{sum(json.loads(file.read_text()).values())} executions so far")
    return int(any(findings.iterdir()))


def child(name, seconds, out, seed, blindly):
    if blindly:
        return blind(name, seconds, out, random.Random(seed))
    corpus = out / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    ours, compiled = ["uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"], ["uwb_tdoa_tools.readers.usd_scan"]
    ours += ["yaml"] if name == "yaml" else []  # followed there, it need not be slow elsewhere
    with atheris.instrument_imports(include=ours, exclude=compiled):  # numba cannot compile what is followed
        import targets
    import mutations

    def mutate(data, most, number):
        chance = random.Random(number)
        return (mutations.changed(name, data, chance) if chance.random() < 0.5 else atheris.Mutate(data, most))[:most]

    tempfile.tempdir = str(targets.FOLDER)  # of the readers too
    for path in targets.seeds(name):
        (corpus / f"seed_{path.name}").write_bytes(path.read_bytes())
    options = [*LIMITS, f"-max_total_time={int(seconds)}", f"-artifact_prefix={out}/findings/{name}-", str(corpus)]
    atheris.Setup([sys.argv[0], *options], lambda data: targets.run(name, data), custom_mutator=mutate)
    try:
        atheris.Fuzz()
    finally:
        targets.clean_up()


def blind(name, seconds, out, chance):
    """Changes of the corpus, each of which has SECONDS and MEGABYTES; findings are kept, and it goes on."""
    import mutations
    import targets

    tempfile.tempdir, seeds, count, seen = str(targets.FOLDER), [path.read_bytes() for path in targets.seeds(name)], 0, set()
    for data in seeds:
        targets.run(name, data)  # what is compiled and imported does not count
    watch()
    last, until = out / f"{name}-last", time.monotonic() + seconds
    try:
        while time.monotonic() < until:
            data = mutations.changed(name, chance.choice(seeds), chance)
            last.write_bytes(data)
            count += 1
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            try:
                targets.run(name, data)
            except Exception as error:  # also a MemoryError
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                place = [
                    type(error).__name__,
                    *(f"{frame.name}_{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)[-2:]),
                ]
                if (key := "-".join(place)) not in seen:
                    seen.add(key)
                    traceback.print_exc()
                    (out / "findings" / f"{name}-{re.sub('[^-.a-zA-Z0-9_]', '_', key)}").write_bytes(data)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            if count % 1000 == 0:
                print("executions: 1000\n", end="", flush=True)
    finally:
        print(f"executions: {count % 1000}", flush=True)
        targets.clean_up()
    return 0


def watch():
    """From now on this process ends when the timer of `blind` rings, even within a library, and has so much more memory."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    used = int(re.search(r"VmData:\s+(\d+)", Path("/proc/self/status").read_text())[1]) << 10
    resource.setrlimit(resource.RLIMIT_DATA, (used + (MEGABYTES << 20), resource.RLIM_INFINITY))


if __name__ == "__main__":
    sys.exit(main())
