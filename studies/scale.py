# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""scale: measure how processor time and memory of the tools grow with flights, anchors and effects.

Each case runs in a separate process. Flights are simulated, 10 s in the air, 240 TDOAs a second.
The tool runs as a user would run it, with one job. Each case goes to --out as soon as it is done; a
second run skips the cases in --out.
"""

from dataclasses import dataclass
import os
import subprocess
import sys

from uwb_tdoa_bias.common.errors import Failure
from uwb_tdoa_bias.common.files import refuse_output
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

FLYING = dict(duration=10.0, start_in_air=True, imu_rate=100.0, truth_rate=50.0, protocol="tdoa3")
FLIGHTS = 1, 10, 100, 1000
ANCHORS, AMONG = (8, 16, 32, 64), 3  # flights
ADDED = 1, 3, 5  # effects
TOOLS = {
    "evaluate": ("--no-bias", "--jobs", "1"),
    "diagnose": ("--jobs", "1", "--out", "diagnosis"),
    "train": ("--model", "structured", "--jobs", "1", "--out", "model"),
}
FEWEST = {"evaluate": 1, "diagnose": 1, "train": 2}
BESIDE = {  # effects that evaluate takes out of TDOAs, in the order in which they are added
    "tag_lever_arm": {"x": 0.01, "y": 0.0, "z": 0.05},
    "anchor_delay": {str(k): 0.01 * k for k in range(8)},
    "range_scale": {"scale": 0.001},
    "pair_offset": {"0-1": 0.05, "2-3": 0.02},
    "received_power_bias": {"scale": 0.2},
}


@dataclass(frozen=True)
class Case:
    """A tool over some flights among some anchors, evaluate with some effects."""

    tool: str
    flights: int
    anchors: int = 8
    effects: int = 0

    @property
    def key(self):
        """Of its line in the file."""
        return (
            f"{self.tool}, {self.flights} flights, {self.anchors} anchors, {self.effects} effects"
        )


def add_options(add):
    """The options of the study."""
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        required=True,
        help="for flights, 0.1 MB each",
    )
    add("--only", choices=tuple(TOOLS), nargs="+", default=list(TOOLS), help="(default: all)")
    add(
        "--most",
        type=int,
        default=FLIGHTS[-1],
        metavar="N",
        help="flights of a case (default: %(default)s)",
    )


def run(args):
    """Do all cases, and print their table."""
    args.out.mkdir(parents=True, exist_ok=True)
    cases = [case for case in all_cases() if case.tool in args.only and case.flights <= args.most]
    for tool in {case.tool for case in cases}:
        measure(Case(tool, FEWEST[tool]), args.out)  # compiles, which is not to count
    done = {}
    for case in cases:
        done[case] = measure(case, args.out)
        print(
            f"{case.key}: {done[case]['cpu']:.1f} s, {done[case]['memory']:.0f} MB",
            file=sys.stderr,
            flush=True,
        )
    order = list(TOOLS)
    cases.sort(key=lambda case: (order.index(case.tool), case.anchors, case.effects, case.flights))
    print(table({case: done[case] for case in cases}))


def all_cases():
    """[Case], the cheap ones first."""
    over = [Case(tool, max(count, FEWEST[tool])) for count in FLIGHTS for tool in TOOLS]
    among = [Case(tool, AMONG, anchors) for anchors in ANCHORS for tool in TOOLS]
    effects = [Case("evaluate", FLIGHTS[1], effects=count) for count in ADDED]
    return over[: -len(TOOLS)] + effects + among + over[-len(TOOLS) :]


def measure(case, folder):
    """{"cpu": s, "memory": MB} of a Case. Raises Failure where the tool fails.

    cpu is the processor time, user and system, of the tool's process and its child processes.
    memory is the largest peak memory of a process.
    """
    flights = make_flights(case.flights, case.anchors, folder)
    command = [
        sys.executable,
        "-m",
        "uwb_tdoa_tools.commands",
        case.tool,
        *map(str, flights),
        *TOOLS[case.tool],
    ]
    if case.effects:
        some = [EFFECTS[name](values) for name, values in list(BESIDE.items())[: case.effects]]
        EffectSet(tuple(some)).to_yaml(folder / "effects.yaml")
        command = [*[word for word in command if word != "--no-bias"], "--effects", "effects.yaml"]
    refuse_output(folder / "said.txt")
    with open(folder / "said.txt", "w") as said:
        process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, cwd=folder)
        _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise Failure(
            f"{case.key}: ended with code {os.waitstatus_to_exitcode(status)}; see "
            f"{folder / 'said.txt'}."
        )
    return {"cpu": usage.ru_utime + usage.ru_stime, "memory": usage.ru_maxrss / 1024}


def make_flights(count, anchors, folder):
    """Paths of so many bags of simulated flights among so many anchors, made where they are
    missing.
    """
    room, out = ("corners" if anchors == 8 else f"random-1-{anchors}"), []
    for number in range(count):
        path = folder.absolute() / f"flights-{anchors}" / f"{number:04d}"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            write_bag(simulate(SimulationConfig(seed=number, constellation=room, **FLYING)), path)
        out.append(path)
    return out


def table(results):
    """Markdown of {Case: figures}: a row for each case, with its cost per additional flight.

    That cost is relative to the case with the next smaller number of flights.
    """
    lines = [
        (
            "| tool | flights | anchors | effects | CPU, s | s per flight more | peak memory, MB "
            "| MB per flight more |"
        ),
        "|---|" + 7 * "---:|",
    ]
    for case, of in results.items():
        fewer = [
            (other.flights, each) for other, each in results.items() if _same_but_fewer(other, case)
        ]
        slopes = ["", ""]
        if fewer:
            count, before = max(fewer, key=lambda pair: pair[0])
            slopes = [
                f"{(of[name] - before[name]) / (case.flights - count):.3f}"
                for name in ("cpu", "memory")
            ]
        lines.append(
            f"| {case.tool} | {case.flights} | {case.anchors} | {case.effects} | "
            f"{of['cpu']:.1f} | {slopes[0]} | {of['memory']:.0f} | {slopes[1]} |"
        )
    return "\n".join(lines)


def _same_but_fewer(other, case):
    return (other.tool, other.anchors, other.effects) == (
        case.tool,
        case.anchors,
        case.effects,
    ) and other.flights < case.flights
