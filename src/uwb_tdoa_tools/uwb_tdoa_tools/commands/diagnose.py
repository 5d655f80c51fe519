"""diagnose: from a residual to the missing effect to a smaller error."""

import json
import sys
from pathlib import Path

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig

from .. import cli
from ..readers import inputs
from ..diagnosis import diagnose
from ..diagnosis.references import GroundTruth, Nothing
from ..progress import Progress
from ..readers import read_flight

DESCRIPTION = """Find out what is wrong with the measurements of some flights, and put it right.

Finds the residuals of every channel, traces them to effects that the model lacks, says how sure it is and what else it
could be, adds what helps, and reports the error before and after on data that took no part in the fit.
Writes diagnosis.json, effects.yaml (for evaluate, bias_node and ekf_node) and report.html."""


def main(argv=None):
    """The executable."""
    parser = cli.parser(
        "diagnose",
        DESCRIPTION,
        "diagnose flight.bag --out diagnosis/",
        "diagnose 0425-traj1 0425-traj2 --survey anchor_0425.txt --holdout 0425-traj3 --out diagnosis/",
        "diagnose flight.bag --effects effects.yaml --out second/",
        "diagnose flight.bag --no-truth --out without/",
    )
    parser.add_argument("flights", nargs="+", metavar="FLIGHT", help=inputs.HELP)
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
    parser.add_argument("--effects", metavar="FILE", help="effects.yaml: what is in the model already")
    parser.add_argument("--holdout", nargs="+", default=[], metavar="FLIGHT", help="flights to judge on, not to fit")
    parser.add_argument("--no-truth", action="store_true", help="do without ground truth, even where there is one")
    parser.add_argument("--config", metavar="FILE", help="filter parameters, as for ekf_node (ekf_node.yaml)")
    parser.add_argument("--namespace", default="", help="of the topics in the bags, e.g. tag1")
    parser.add_argument("--out", metavar="DIR", required=True, help="where to write; made if it is not there")
    return cli.run(_diagnose, parser, argv)


def _diagnose(args):
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is a file; give a directory.")
    base = EffectSet.from_yaml(args.effects) if args.effects else EffectSet()
    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    flights, holdout = (
        [read_flight(path, survey, args.namespace) for path, survey in inputs.find_flights(paths, args.survey)]
        if paths
        else []
        for paths in (args.flights, args.holdout)
    )
    shared = {f.name for f in flights} & {f.name for f in holdout}
    if shared:
        raise InputError(f"--holdout: {sorted(shared)[0]} is also a FLIGHT to fit; leave it out of one of them.")
    reference = Nothing(config) if args.no_truth else GroundTruth()
    with Progress("diagnose") as progress:
        result = diagnose(flights, holdout, base, config, reference, progress)
    out.mkdir(parents=True, exist_ok=True)
    (out / "diagnosis.json").write_text(json.dumps(result.as_json(), indent=1, allow_nan=False))
    result.effects.to_yaml(out / "effects.yaml")
    (out / "report.html").write_text(result.as_html())
    print(result.as_text())
    print(f"wrote diagnosis.json, effects.yaml and report.html to {out}")


if __name__ == "__main__":
    sys.exit(main())
