"""Measured flights played live at their own rate beside a computer at work: what ekf_node says of
their streams, which are sound. The figures of docs/reliability.md, in a shell with the workspace
sourced (./dev shell):

    python src/uwb_tdoa_tools/test/healthy_table.py DATA --load 2 --days 0425
"""

import argparse
from contextlib import ExitStack
from pathlib import Path
import subprocess
import sys
import tempfile

from diagnostic_msgs.msg import DiagnosticArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from monitor_table import flights_of  # noqa: E402

from uwb_tdoa_tools.bags.bag import write_bag  # noqa: E402
from uwb_tdoa_tools.live.processes import Processes, own_domain, wait  # noqa: E402
from uwb_tdoa_tools.live.session import session  # noqa: E402

READY_LIMIT = 180.0  # s
NODES = ("uwb_tdoa_bias", "bias_node"), ("uwb_tdoa_ekf", "ekf_node")
SOUND = "nothing"  # is wrong with the streams


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--days", nargs="+", default=["0422", "0425", "0426", "0607"])
    parser.add_argument("--first", type=int, default=0, help="of the flights (default 0)")
    parser.add_argument("--count", type=int, help="of flights (default: all)")
    parser.add_argument(
        "--load", type=int, default=2, help="busy processes beside them (default 2)"
    )
    args = parser.parse_args()
    flights = flights_of(args.data, args.days)[args.first :][: args.count]
    print(
        "| flight | s | reports | with a warning about streams | TDOAs late | lost | what "
        "they say |"
    )
    print("|---|---|---|---|---|---|---|")
    with ExitStack() as stack:
        for _ in range(args.load):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        for flight in flights:
            print(row(flight), flush=True)


def row(flight):
    """A row of the table: a Flight played once to nodes that have just started."""
    with tempfile.TemporaryDirectory() as folder:
        write_bag(flight, Path(folder) / "flight.bag")
        reports = heard(Path(folder) / "flight.bag", Path(folder))
    troubles = [
        values["wrong with the streams"]
        for values in reports
        if values["wrong with the streams"] != SOUND
    ]
    last = reports[-1]
    lost = sum(int(text) for key, text in last.items() if key.startswith("lost on"))
    said = "; ".join(dict.fromkeys(troubles)) or SOUND
    seconds = flight.tdoa.t[-1] - flight.tdoa.t[0]
    return (
        f"| {flight.name} | {seconds:.0f} | {len(reports)} | {len(troubles)} | {last['late']} | "
        f"{lost} | {said} |"
    )


def heard(bag, folder):
    """[{key: text}], what ekf_node reports while a bag is played to it."""
    reports, hearing = [], {"ekf_node": False, "bias_node": False}

    def take(message):
        for status in message.status:
            name = status.name.strip("/")
            hearing[name] = True
            if name == "ekf_node":
                reports.append({pair.key: pair.value for pair in status.values})

    with own_domain(), session("test", []) as (node, stop), Processes(folder, stop) as processes:
        node.create_subscription(DiagnosticArray, "/diagnostics", take, 100)
        for package, name in NODES:
            processes.start(package, name)
        wait(READY_LIMIT, "the nodes", processes, node, lambda: all(hearing.values()))
        replay = processes.start("uwb_tdoa_tools", "replay", bag, may_end_with=(0,))
        wait(
            READY_LIMIT,
            "the first messages",
            processes,
            node,
            lambda: reports[-1]["TDOAs received"] != "0",
        )
        first = len(reports)
        wait(None, None, processes, node, lambda: replay.poll() is not None)
    return reports[first:]


if __name__ == "__main__":
    main()
