# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Learn the systematic error of TDOAs from flights with ground truth."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from .. import cli, options, parallel
from ..choices import MODELS
from ..cli import OutputFolder, option

MOST = 300_000  # TDOAs; what they take: docs/notebook/speed.md


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "train",
        (
            "Learn the systematic error of TDOAs from flights with ground truth. Writes to --out: "
            "training.png, the\n"
            "learning curve; training.json, all figures; and the model. Without measured attitude a "
            "flight counts as level, at\n"
            "yaw 0. What differs between days or vehicles is best trained apart. Every flight is left "
            "out once: the hold-out\n"
            "gain scales a network, and is printed as the gain to expect.\n\n"
            "models:\n"
            "  paper    model.onnx, for bias_node and evaluate --model: the network of Zhao et al. "
            "(RA-L 2021), for many\n"
            "           flights. It needs no orientations of anchors if one is unknown.\n"
            "  physics  effects.yaml, for both nodes, evaluate --effects and export: the effects that "
            "diagnose can name,\n"
            "           for few flights. Of several constellations, those that carry over."
        ),
        "train flights/0425 --survey surveys/ --model physics --out model/",
        "train a_bag b_bag c_bag --validation c --model paper --out model/ --seed 1",
        options=[
            *options.recordings(),
            option("--model", choices=MODELS, required=True, help="what to train"),
            options.most(MOST),
            options.align(),
            option("--out", metavar="DIR", type=OutputFolder, required=True, help="where to write"),
            option(
                "--validation",
                metavar="NAME",
                nargs="+",
                help="flights to validate on (default: one in five)",
            ),
            option(
                "--name", help="of the model, goes into every corrected message (default: the kind)"
            ),
            option(
                "--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)"
            ),
            options.JOBS,
        ],
    )


def _train(args: Namespace) -> None:
    from ..readers import inputs
    from ..scoring.evaluation import with_aligned_truth
    from ..scoring.metrics import gain_in_words
    from ..training import models

    reading = options.reading_of(args)
    # As many for folds as for flights: with another number, joblib restarts all processes.
    jobs, over = parallel.workers_for(args, len(reading.find(args.flights)), 2)
    several = reading.flights(args.flights, args.most, jobs)
    inputs.require_tdoas(several, "train")
    aligned = parallel.over(partial(with_aligned_truth, align=args.align), several, jobs)
    flights = {flight.name: flight for flight in aligned}
    names = models.split(list(flights), args.seed, args.validation)
    for what, some in zip(("training on", "validating on"), names):
        cli.show(f"{what:13s} {', '.join(some)}")
    training, validation = ([flights[name] for name in some] for some in names)
    name = args.name or args.model
    recipe = models.Recipe(args.model, args.seed)
    with cli.Progress("train", what=f"training on {len(training)} flights, then without each"):
        result, shrinkage = models.train_shrunk(
            recipe, training, validation, name, progress=cli.show, map_function=over
        )
    args.out.mkdir(parents=True, exist_ok=True)
    models.save(result, args.out)
    label, x, of_training, of_validation = result.curve
    models.plot_curve(label, x, of_training, of_validation, args.out / "training.png")
    for name, (before, after) in result.errors.items():
        cli.show(
            f"{name:26s} error of the TDOAs {before:.3f} m, after correction {after:.3f} m "
            "(root mean square)"
        )
    curve = {label: x, "training": of_training, "validation": of_validation}
    cli.show(shrinkage.as_text())
    if result.model:
        widened, subtracted = map(gain_in_words, shrinkage.parts)
        cli.show(
            f"of that, by a larger deviation alone it {widened}; by what is taken out it {subtracted}"
        )
    content = {
        **result.meta,
        "curve": curve,
        "validation": result.errors,
        "borne_out": shrinkage.as_dict(),
    }
    cli.write_json(args.out / "training.json", content)
    cli.show(f"wrote {', '.join(sorted(path.name for path in args.out.iterdir()))} in {args.out}")


main = cli.executable(_train, parser)
