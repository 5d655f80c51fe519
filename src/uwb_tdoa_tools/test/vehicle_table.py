"""Makes the table of flights over topics in docs/flying.md, in a shell with the workspace sourced
(./dev shell):

python src/uwb_tdoa_tools/test/vehicle_table.py --flights 10 --seed 9001 --load 2
"""

import argparse
from pathlib import Path
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(Path(__file__).resolve().parent))

from live_flights import hall  # noqa: E402

from uwb_tdoa_tools.flying.report import sentence  # noqa: E402
from uwb_tdoa_tools.flying.trial import Task, fly  # noqa: E402
from uwb_tdoa_tools.flying.verdict import verdict_of  # noqa: E402
from uwb_tdoa_tools.flying.world import WORLDS  # noqa: E402

LONGEST = 600.0  # s of a flight


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=10)
    parser.add_argument("--seed", type=int, default=9001, help="of the first")
    parser.add_argument("--world", choices=WORLDS, default="hall")
    parser.add_argument("--load", type=int, default=2, help="busy processes beside it")
    args = parser.parse_args()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(args.load)]
    try:
        for seed in range(args.seed, args.seed + args.flights):
            with tempfile.TemporaryDirectory() as folder:
                began = time.monotonic()
                with hall(
                    folder, f"seed:={seed}", f"world:={args.world}", "mission:=true"
                ) as flown:
                    flown.wait(lambda flown=flown: flown.verdicts, "the verdict", LONGEST)
                took, live = time.monotonic() - began, flown.verdicts[0]
            lockstep = verdict_of(fly(Task(WORLDS[args.world], seed, "place")))
            apart = [
                abs((live[name] or 0.0) - (lockstep[name] or 0.0))
                for name in ("tracking", "place", "touchdown")
            ]
            print(f"{seed}: {sentence(live)}; {took:.0f} s", flush=True)
            print(
                f"      lockstep: {sentence(lockstep)}; apart by "
                + ", ".join(f"{value:.1g}" for value in apart),
                flush=True,
            )
    finally:
        for process in busy:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
