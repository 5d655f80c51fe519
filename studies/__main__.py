"""`./dev study NAME ...`: make the figures of the documentation anew."""

import argparse
import sys

from studies import (
    aids,
    calibrating,
    crazyflie,
    fuzz,
    localizing,
    moved_anchors,
    noise,
    ranges,
    recalibrating,
    rover,
    scale,
    situations,
    surveying,
)
from studies.checking import figures as checking
from studies.checking import in_flight
from studies.closed_loop import experiment
from studies.debiasing import measured, set_up
from studies.diagnosis import figures
from studies.diagnosis import ranges as diagnosed_ranges
from studies.faults import figures as faults
from studies.faults import flown
from studies.rules import figures as rules
from studies.training import compare, default, spin, splits
from uwb_tdoa_tools import cli

STUDIES = {
    "aids": aids,
    "calibrating": calibrating,
    "checking": checking,
    "closed-loop": experiment,
    "compare-models": compare,
    "crazyflie": crazyflie,
    "debias-measured": measured,
    "debias-set-up": set_up,
    "default-model": default,
    "diagnose-ranges": diagnosed_ranges,
    "diagnosis": figures,
    "faults": faults,
    "fly-faults": flown,
    "fuzz": fuzz,
    "in-flight": in_flight,
    "localizing": localizing,
    "moved-anchors": moved_anchors,
    "noise": noise,
    "random-splits": splits,
    "ranges": ranges,
    "recalibrating": recalibrating,
    "rover": rover,
    "rules": rules,
    "scale": scale,
    "situations": situations,
    "spin": spin,
    "surveying": surveying,
}
DESCRIPTION = """Make the figures of the documentation anew. Nothing here is needed to use the suite. DATA is a folder
of measured flights: flights/, util/, surveys/.

  aids             height, pressure and velocity on measured flights, and their faults (docs/aids.md)
  calibrating      surveys shaken, calibrated without ground truth, judged on other flights (docs/calibration.md)
  checking         mistakes put into flights, and what check says of them (docs/connect.md)
  closed-loop      the flights of Zhao et al. by networks and by effects (docs/flying.md)
  compare-models   bias models side by side on flights that took no part in training (docs/bias.md)
  crazyflie        measured logs put through the radio link of a Crazyflie (docs/connect.md)
  debias-measured  bias maps of positions on measured flights (docs/debiasing.md)
  debias-set-up    a simulated copy of the set-up of Grasso et al. (docs/debiasing.md)
  default-model    the model that bias_node ships
  diagnose-ranges  errors put into simulated distances to anchors, and what diagnose makes of them (docs/sensors.md)
  diagnosis        effects put into flights, and found again (docs/diagnosis.md)
  faults           faults of streams, surveys, nodes and clocks, played to the real nodes over topics (docs/reliability.md)
  fly-faults       faults of streams while a simulated vehicle flies by the estimate (docs/reliability.md)
  fuzz             changed files of every kind, given to every reader (docs/reliability.md)
  in-flight        the same mistakes played to ekf_node, and what it says of them (docs/connect.md)
  localizing       what localize says of flights, against their ground truth (docs/localizing.md)
  moved-anchors    anchors that were moved or exchanged, and who names them (docs/localizing.md)
  noise            whether covariances are honest after a calibration (docs/calibration.md)
  random-splits    bias models trained on flights drawn at random, and judged on the others (docs/bias.md)
  ranges           simulated distances to anchors against the bound of plan (docs/sensors.md)
  recalibrating    surveys that start from the last one, after something changed (docs/calibration.md)
  rover            a simulated rover on wheels, and what diagnose finds on it (docs/rover.md)
  rules            rules and constants of the filter, switched off or changed one at a time (docs/notebook/rules.md)
  scale            processor time and memory over flights, anchors and effects (docs/speed.md)
  situations       where a tag can be and what can happen to it, simulated (docs/reliability.md)
  spin             the error of a TDOA over the yaw of the tag (docs/bias.md)
  surveying        surveys shaken, and made better from flights alone (docs/calibration.md)
"""


def main(argv=None):
    """The executable. Returns the exit code."""
    return cli.run(lambda args: STUDIES[args.study].run(args), parser(), argv)


def parser():
    """The studies, each with its options."""
    made = cli.parser(
        "study",
        DESCRIPTION,
        "./dev study aids worth DATA/flights/0425 --survey DATA/surveys",
        "./dev study calibrating --data DATA --draws 3",
        "./dev study checking DATA/flights DATA/util --survey DATA/surveys --only nothing",
        "./dev study closed-loop --out paper/",
        (
            "./dev study compare-models --train DATA/flights/0425 --test 0426 DATA/flights/0426 "
            "--survey DATA/surveys --out out/"
        ),
        "./dev study compare-models --simulated 20 --out out/",
        "./dev study crazyflie DATA/flights/0425/TDOA2 DATA/flights/0422 --survey DATA/surveys",
        "./dev study debias-measured --data DATA --diagnosed bench/ --out measured/",
        "./dev study debias-set-up --out set_up/",
        "./dev study default-model DATA/flights --survey DATA/surveys --out default.onnx",
        "./dev study diagnose-ranges --flights 5",
        "./dev study diagnosis bank --out bench/",
        "./dev study diagnosis measured --data DATA --out bench/",
        (
            "./dev study diagnosis undeclared --cases src/uwb_tdoa_tools/test/undeclared.py --out "
            "bench/"
        ),
        "./dev study faults --only '^velocity' --json faults.json --out faults.md",
        "./dev study fly-faults --flights 6",
        "./dev study fuzz --count 20000",
        (
            "./dev study in-flight DATA/flights/0426/0426-traj5 --survey DATA/surveys --only "
            "nothing sign"
        ),
        "./dev study localizing DATA/flights DATA/util --survey DATA/surveys --mistakes",
        "./dev study moved-anchors DATA/flights --survey DATA/surveys --draws 10 --json moved.json",
        "./dev study noise --data DATA --split const1",
        "./dev study random-splits DATA/flights/0426 --survey DATA/surveys --out splits.jsonl",
        "./dev study ranges --flights 5",
        "./dev study recalibrating --data DATA --only const1",
        "./dev study rover --seeds 20",
        "./dev study rover --diagnose 4",
        "./dev study rules --data DATA --results rules.jsonl",
        "./dev study scale --out scale/",
        "./dev study situations --resume situations.jsonl",
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
