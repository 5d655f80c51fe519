# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev study NAME ...`: reproduce the figures of the documentation."""

import argparse
import sys

from studies import (
    arm64,
    calibrating,
    crazyflie,
    demo,
    deviations,
    domains,
    drives,
    export_cost,
    first_map,
    localizing,
    lockstep,
    monitor,
    moved_anchors,
    moved_anchors_live,
    next_flight,
    noise,
    odd_messages,
    parameters,
    plans,
    ranges,
    recalibrating,
    rover,
    scale,
    sensors,
    situations,
    survey_ranges,
    surveying,
    two_errors,
    two_machines,
    vehicle_code,
    warehouse,
)
from studies.bench import soak, suite
from studies.checking import figures as checking, in_flight
from studies.closed_loop import experiment
from studies.debiasing import measured, set_up
from studies.diagnosis import figures, ranges as diagnosed_ranges
from studies.faults import figures as faults, flown
from studies.fuzzing import figures as fuzz
from studies.rules import figures as rules
from studies.training import compare, spin, splits
from uwb_tdoa_tools import cli

STUDIES = {
    "arm64": arm64,
    "bench": suite,
    "calibrating": calibrating,
    "checking": checking,
    "closed-loop": experiment,
    "compare-models": compare,
    "crazyflie": crazyflie,
    "debias-measured": measured,
    "debias-set-up": set_up,
    "demo": demo,
    "deviations": deviations,
    "diagnose-ranges": diagnosed_ranges,
    "diagnosis": figures,
    "domains": domains,
    "drives": drives,
    "export-cost": export_cost,
    "faults": faults,
    "first-map": first_map,
    "fly-faults": flown,
    "fuzz": fuzz,
    "in-flight": in_flight,
    "localizing": localizing,
    "lockstep": lockstep,
    "monitor": monitor,
    "moved-anchors": moved_anchors,
    "moved-anchors-live": moved_anchors_live,
    "next-flight": next_flight,
    "noise": noise,
    "odd-messages": odd_messages,
    "parameters": parameters,
    "plans": plans,
    "random-splits": splits,
    "ranges": ranges,
    "recalibrating": recalibrating,
    "rover": rover,
    "rules": rules,
    "scale": scale,
    "sensors": sensors,
    "situations": situations,
    "soak": soak,
    "spin": spin,
    "survey-ranges": survey_ranges,
    "surveying": surveying,
    "two-errors": two_errors,
    "two-machines": two_machines,
    "vehicle-code": vehicle_code,
    "warehouse": warehouse,
}
DESCRIPTION = """Make the figures of the documentation anew. Nothing here is needed to use the suite. DATA is a folder
of measured flights: flights/, util/, surveys/.

  arm64            the off-line filter on an emulated 64-bit Arm, value by value (docs/notebook/speed.md)
  bench            what the suite costs on this machine (docs/notebook/measured.md)
  calibrating      surveys shaken, calibrated without ground truth, judged on other flights (docs/notebook/calibration.md)
  checking         mistakes put into flights, and what check says of them (docs/notebook/checking.md)
  closed-loop      the flights of Zhao et al. by networks and by effects (docs/notebook/flying.md)
  compare-models   bias models side by side on flights that took no part in training (docs/notebook/bias.md)
  crazyflie        measured logs put through the radio link of a Crazyflie (docs/notebook/connect.md)
  debias-measured  bias maps of positions on measured flights (docs/notebook/debiasing.md)
  debias-set-up    a simulated copy of the set-up of Grasso et al. (docs/notebook/debiasing.md)
  demo             the loop of the demo over seeds (docs/demo.md)
  deviations       deviations of anchor positions against their errors (docs/notebook/diagnosis.md)
  diagnose-ranges  errors put into simulated distances to anchors, and what diagnose makes of them (docs/notebook/ranges.md)
  diagnosis        effects put into flights, and found again (docs/notebook/diagnosis.md)
  domains          effects beyond where they were seen (docs/notebook/reliability.md)
  drives           a rover on wheels, by which sensors the filter uses (docs/notebook/auxiliary_sensors.md)
  export-cost      a TDOA corrected by an exported file and by compiled effects (docs/notebook/export.md)
  faults           faults of streams, surveys, nodes and clocks, played to the real nodes (docs/notebook/reliability.md)
  first-map        first maps of unknown anchors in simulated halls, and their errors (docs/notebook/first_map.md)
  fly-faults       faults of streams while a simulated vehicle flies by the estimate (docs/notebook/reliability.md)
  fuzz             changed files of every kind, given to every reader (docs/notebook/reliability.md)
  in-flight        the same mistakes played to ekf_node, and what it says of them (docs/notebook/checking.md)
  localizing       what localize says of flights, against their ground truth (docs/notebook/localizing.md)
  lockstep         replays that follow the nodes, at several rates (docs/notebook/reliability.md)
  monitor          what the monitor of ekf_node names in flight (docs/notebook/reliability.md)
  moved-anchors    anchors that were moved or exchanged, and who names them (docs/notebook/localizing.md)
  moved-anchors-live  some of these recordings, played to the real nodes (docs/notebook/localizing.md)
  next-flight      whether a planned flight settles what a diagnosis left open (docs/notebook/diagnosis.md)
  noise            whether covariances are honest after a calibration (docs/notebook/calibration.md)
  odd-messages     messages that no driver should send, to every node (docs/notebook/reliability.md)
  parameters       what each parameter of the filter is worth (docs/notebook/parameters.md)
  plans            random rooms and halls against an independent solver, and against a rerun (docs/notebook/planning.md)
  random-splits    bias models trained on flights drawn at random, and judged on the others (docs/notebook/bias.md)
  ranges           simulated distances to anchors against the bound of plan (docs/notebook/ranges.md)
  recalibrating    surveys that start from the last one, after something changed (docs/notebook/calibration.md)
  rover            a simulated rover on wheels, and what diagnose finds on it (docs/notebook/rover.md)
  rules            rules and constants of the filter, switched off or changed one at a time (docs/notebook/rules.md)
  scale            processor time and memory over flights, anchors and effects (docs/notebook/speed.md)
  sensors          height, pressure and velocity on measured flights, and their faults (docs/notebook/auxiliary_sensors.md)
  situations       where a tag can be and what can happen to it, simulated (docs/notebook/reliability.md)
  soak             both nodes for hours: memory and lost messages (docs/notebook/reliability.md)
  spin             the error of a TDOA over the yaw of the tag (docs/notebook/bias.md)
  survey-ranges    errors of ranges that are not of the anchors, and what survey makes of them (docs/notebook/ranges.md)
  surveying        surveys shaken, and made better from flights alone (docs/notebook/calibration.md)
  two-errors       vibration that is rectified, and late anchors near the floor (docs/notebook/measured.md)
  two-machines     who hears whom on two machines, takes root (docs/notebook/ros.md)
  vehicle-code     what exported C costs on an emulated Cortex-M4F (docs/notebook/export.md)
  warehouse        starts, slow tags and walks in halls, and their cost (docs/notebook/warehouse.md)
"""


def main(argv=None):
    """The executable. Returns the exit code."""
    return cli.run(lambda args: STUDIES[args.study].run(args), parser(), argv)


def parser():
    """The studies, each with its options."""
    made = cli.parser(
        "study",
        DESCRIPTION,
        "./dev study arm64 --folder arm64/",
        (
            "./dev study arm64 --folder arm64/ --flights DATA/flights/0426/0426-traj5 "
            "--survey DATA/surveys"
        ),
        "./dev study deviations DATA",
        "./dev study domains DATA",
        "./dev study drives",
        "./dev study lockstep LOG SURVEY --from 10 --seconds 5",
        "./dev study monitor DATA --days 0426 0607",
        "./dev study export-cost",
        "./dev study two-errors DATA",
        "./dev study two-machines",
        "./dev study vehicle-code",
        './dev study warehouse --only "ten minutes" --seeds 20',
        "./dev study sensors worth DATA/flights/0425 --survey DATA/surveys",
        "./dev study bench --json bench.json",
        "./dev study bench --only core --peer libpeer.so",
        "./dev study bench --only offline --model network.onnx",
        "./dev study calibrating --data DATA --draws 3",
        "./dev study checking DATA/flights DATA/util --survey DATA/surveys --only nothing",
        "./dev study closed-loop --out paper/",
        (
            "./dev study compare-models --train DATA/flights/0425 --test 0426 DATA/flights/0426 "
            "--survey DATA/surveys --out out/"
        ),
        "./dev study compare-models --simulated 20 --out out/",
        "./dev study crazyflie DATA/flights/0425/TDOA2 DATA/flights/0422 --survey DATA/surveys",
        "./dev study demo --seeds 2",
        "./dev study debias-measured --data DATA --diagnosed bench/ --out measured/",
        "./dev study debias-set-up --out set_up/",
        "./dev study diagnose-ranges --flights 5",
        "./dev study survey-ranges --flights 5",
        "./dev study diagnosis bank --out bench/",
        "./dev study diagnosis measured --data DATA --out bench/",
        (
            "./dev study diagnosis undeclared --cases src/uwb_tdoa_tools/test/undeclared.py --out "
            "bench/"
        ),
        "./dev study faults --only '^velocity' --json faults.json --out faults.md",
        "./dev study first-map --halls 20",
        "./dev study fly-faults --flights 6",
        "./dev study fuzz --count 20000",
        (
            "./dev study in-flight DATA/flights/0426/0426-traj5 --survey DATA/surveys --only "
            "nothing sign"
        ),
        "./dev study localizing DATA/flights DATA/util --survey DATA/surveys --mistakes",
        "./dev study moved-anchors DATA/flights --survey DATA/surveys --draws 10 --json moved.json",
        "./dev study moved-anchors-live --draws 3",
        "./dev study next-flight --cases 2",
        "./dev study noise --data DATA --split const1",
        "./dev study odd-messages 10000",
        "./dev study parameters --data DATA",
        "./dev study plans --json plans.json",
        "./dev study random-splits DATA/flights/0426 --survey DATA/surveys --out splits.json",
        "./dev study ranges --flights 5",
        "./dev study recalibrating --data DATA --only const1",
        "./dev study rover --seeds 20",
        "./dev study rover --diagnose 4",
        "./dev study rules --data DATA --results rules.json",
        "./dev study scale --out scale/",
        "./dev study situations",
        "./dev study soak --minutes 60",
        "./dev study spin --out spin.png",
        "./dev study surveying --data DATA --draws 5 --only const1",
    )
    names = made.add_subparsers(dest="study", required=True, metavar="NAME")
    for name, study in STUDIES.items():
        form = argparse.RawDescriptionHelpFormatter
        study.add_options(
            names.add_parser(name, description=study.__doc__, formatter_class=form).add_argument
        )
    return made


if __name__ == "__main__":
    sys.exit(main())
