# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""closed-loop: repeat the flights of Zhao et al. (RA-L 2021, section V) in the loop of `fly`.

The trajectories are A (a level circle) and B (a circle that rises and falls). They are flown in one
constellation of anchors that is part of the training, and in three new ones. One estimator is the
M-estimation EKF: alone, and with the paper's network without and with the orientations of the
anchors. The second is our filter: alone, and with diagnosed effects.

The networks are trained on flights in three constellations. The effects are diagnosed from three
training flights, one per constellation. Writes to --out: trained/, flights.json, table.md, and the
counterparts of figures 7 to 9: rmse.png, paths.png, errors.png.
"""

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import cli, parallel
from uwb_tdoa_tools.flying import fleet
from uwb_tdoa_tools.flying.mission import Circles
from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.world import World
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.simulation.rooms import constellation, room_of
from uwb_tdoa_tools.training import labels, models, physics

from . import pictures
from .sines import Sines

TRAINING = "corners", "wall_middles", "staircase"
KNOWN, UNSEEN = TRAINING[0], ("low_ceiling", "random-7", "random-8")
TRAJECTORIES = {"A": Circles(), "B": Circles(swing=0.4)}
TILT = np.deg2rad(12.0)  # of an anchor mounted by hand, as in random constellations
DELAY, INSTALLATION = 0.05, 1  # m, of the modules, as in `simulate`; always the same eight modules
FIRST_TRAINING, FLOWN = 101, 60.0  # seed of the first flight to train on; s in the air of each
NETWORKS = "paper_no_orientation", "paper"
EFFECTS = "effects.yaml"
BASELINE, WITHOUT, WITH, OURS = (
    "M-estimation",
    "network without orientations",
    "network",
    "ours, diagnosed effects",
)
# by which WITH reduces the error of each, in constellations not seen before
PUBLISHED = {BASELINE: 0.4208, WITHOUT: 0.2032}


@dataclass(frozen=True)
class Estimator:
    """What a controller flies by. config : FilterConfig; model : of NETWORKS, or None; diagnosed :
    with the effects.
    """

    config: FilterConfig
    model: str | None = None
    diagnosed: bool = False


ROBUST = FilterConfig(robust="m_estimation")
ESTIMATORS = {
    BASELINE: Estimator(ROBUST),
    WITHOUT: Estimator(ROBUST, "paper_no_orientation"),
    WITH: Estimator(ROBUST, "paper"),
    "ours": Estimator(FilterConfig()),
    OURS: Estimator(FilterConfig(), diagnosed=True),
}


def add_options(add: Callable) -> None:
    """add : add_argument of a parser."""
    add(
        "--flights",
        type=parallel.whole_number,
        default=10,
        metavar="N",
        help="of each kind (default: 10)",
    )
    add(
        "--seed",
        type=parallel.whole_number,
        default=1001,
        metavar="S",
        help="of the first; the others have the next ones (default: 1001)",
    )
    add(
        "--training",
        type=parallel.whole_number,
        default=8,
        metavar="N",
        help="flights in each of three constellations (default: 8)",
    )
    add(
        "--trained",
        type=Path,
        metavar="DIR",
        help="what an earlier run wrote to trained/ (default: train anew)",
    )
    add(
        "--jobs",
        type=parallel.whole_number,
        metavar="N",
        help="flights at once (default: as many as there are cores)",
    )
    add(
        "--out",
        type=OutputFolder,
        required=True,
        metavar="DIR",
        help="where to write; made if it is not there",
    )


def run(args: Namespace) -> None:
    """Train, fly, print the table, and draw."""
    out = args.out
    out.mkdir(parents=True, exist_ok=True)
    trained = args.trained or train(args.training, out / "trained", args.jobs)
    kinds = [
        (by, where, path)
        for where in (KNOWN, *UNSEEN)
        for path in TRAJECTORIES
        for by in ESTIMATORS
    ]
    seeds = range(args.seed, args.seed + args.flights)
    tasks = [task(kind, seed, trained) for kind in kinds for seed in seeds]
    flown = list(parallel.over(partial(fleet.fly_task, None, True), tasks, args.jobs))
    of_kind = {kind: flown[k * len(seeds) : (k + 1) * len(seeds)] for k, kind in enumerate(kinds)}
    verdicts = {kind: [verdict for verdict, _ in some] for kind, some in of_kind.items()}
    given = [
        dict(zip(("by", "constellation", "trajectory", "flights"), (*kind, some)))
        for kind, some in verdicts.items()
    ]
    cli.write_json(out / "flights.json", {"kinds": given})
    lines = "\n".join(table(verdicts))
    write_text(out / "table.md", lines + "\n")
    print(lines)
    shown = {by: [drawn for _, drawn in of_kind[by, UNSEEN[0], "A"]] for by in ESTIMATORS}
    pictures.draw_errors_by_kind(verdicts, out / "rmse.png")
    pictures.draw_paths(shown, out / "paths.png")
    pictures.draw_errors(shown, out / "errors.png")
    print(f"wrote flights.json, table.md, rmse.png, paths.png and errors.png to {out}")


def world_of(name: str) -> World:
    """World with the anchors of a named constellation.

    Each anchor is turned about the vertical by a random angle and tilted a little. So its position
    does not determine its orientation.
    """
    anchors, rng = constellation(name), np.random.default_rng(list(name.encode()))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, len(anchors)))
    turn = Rotation.from_rotvec(TILT * rng.standard_normal((len(anchors), 3))) * turn
    anchors = replace(
        anchors, orientations=(turn * Rotation.from_quat(anchors.orientations)).as_quat()
    )
    x, y, z = np.abs(anchors.positions).max(axis=0).tolist()
    return World(
        (2.0 * x, 2.0 * y, z),
        anchors,
        delay=DELAY,
        bearing_bias=0.0,
        antennas=True,
        installation=INSTALLATION,
    )


def task(kind: tuple[str, str, str], seed: int, trained: Path) -> Task:
    """Task of a flight. kind : (name of an estimator, constellation, trajectory); trained : folder."""
    by, where, path = kind
    estimator = ESTIMATORS[by]
    effects = EffectSet.from_yaml(trained / EFFECTS) if estimator.diagnosed else None
    model = str(trained / estimator.model / "model.onnx") if estimator.model else None
    return Task(
        world_of(where),
        seed,
        "place",
        config=estimator.config,
        effects=effects,
        model=model,
        path=TRAJECTORIES[path],
    )


def train(count: int, folder: Path, jobs: int | None = None) -> Path:
    """Fly `count` times in each constellation of TRAINING, train the networks, find the effects.

    Each filter is given its initial position. Returns the folder, Path, with the networks and the
    effects. Raises InputError.
    """
    if count < 2:
        raise InputError(
            f"training: {count} flight in each constellation leaves none to validate on; give "
            "at least 2."
        )
    worlds = [world_of(name) for name in TRAINING]
    tasks = [
        Task(
            worlds[k % 3],
            seed,
            "place",
            path=Sines(room_of(worlds[k % 3].anchors), seed, seconds=FLOWN),
        )
        for k, seed in enumerate(range(FIRST_TRAINING, FIRST_TRAINING + 3 * count))
    ]
    flights = {flight.name: flight for flight in parallel.over(_flight, tasks, jobs)}
    parts = [[flights[name] for name in names] for names in labels.split(list(flights), 0)]
    some = list(flights.values())[:3]
    for name in parallel.over(
        partial(_train, parts, some, folder), (EFFECTS, *NETWORKS), jobs, unit="model"
    ):
        tqdm.write(f"wrote {folder / name}")
    return folder


def _flight(task: Task) -> Flight:
    """The Flight of a Task."""
    return fly(task).flight


def _train(parts: list[list[Flight]], some: list[Flight], folder: Path, name: str) -> str:
    """Write a correction to a folder and return its name. NETWORKS are trained and validated on
    `parts`; EFFECTS are found in the flights `some`.
    """
    (folder / name if name in NETWORKS else folder).mkdir(parents=True, exist_ok=True)
    if name in NETWORKS:
        models.save(models.train(models.Recipe(name, 0), *parts, name), folder / name)
    else:
        physics.find_effects(some).effects.to_yaml(folder / name)
    return name


def table(verdicts: dict[tuple[str, str, str], list[dict]]) -> Iterator[str]:
    """Lines of Markdown. verdicts : {(estimator, constellation, trajectory): [verdict]}."""
    yield "| RMSE of the estimate in the air, m | " + " | ".join(ESTIMATORS) + " |"
    yield "|---|" + "---:|" * len(ESTIMATORS)
    for where in (KNOWN, *UNSEEN):
        for path in TRAJECTORIES:
            yield _row(
                f"{where}{', trained in' if where == KNOWN else ''}, {path}",
                [mean(verdicts, by, [where], [path]) for by in ESTIMATORS],
            )
    yield _row("not trained in, mean", [mean(verdicts, by, UNSEEN) for by in ESTIMATORS])
    yield _row(
        "the same, off the path, m",
        [mean(verdicts, by, UNSEEN, figure="tracking") for by in ESTIMATORS],
    )
    yield _row(
        "NEES (3 is honest)", [mean(verdicts, by, UNSEEN, figure="nees") for by in ESTIMATORS], 1
    )
    for word in ("landed", "safe"):
        counts = {
            by: [one[word] for (who, _, _), some in verdicts.items() if who == by for one in some]
            for by in ESTIMATORS
        }
        title = {"landed": "landed, all constellations", "safe": "without a crash"}[word]
        yield (
            f"| {title} | "
            + " | ".join(f"{sum(some)} of {len(some)}" for some in counts.values())
            + " |"
        )
    yield ""
    yield (
        "| less error than | where it was trained | elsewhere | elsewhere, of flights that landed "
        "by both | published |"
    )
    yield "|---|---:|---:|---:|---:|"
    for by, than in ((WITH, BASELINE), (WITH, WITHOUT), ("ours", BASELINE), (OURS, BASELINE)):
        gains = [
            1.0 - mean(verdicts, by, places) / mean(verdicts, than, places)
            for places in ([KNOWN], UNSEEN)
        ]
        both, count = gain_of_landed(verdicts, by, than)
        published = f"{PUBLISHED[than]:.0%}" if by == WITH else ""
        yield (
            f"| {by}: than {than} | {gains[0]:.0%} | {gains[1]:.0%} | {both:.0%} ({count}) | "
            f"{published} |"
        )


def _row(title: str, values: Iterable[float], digits: int = 3) -> str:
    return f"| {title} | " + " | ".join(f"{value:.{digits}f}" for value in values) + " |"


def gain_of_landed(verdicts: dict, by: str, than: str) -> tuple[float, int]:
    """(Gain, number of flights), over the flights in UNSEEN that landed with both estimators.

    The gain is the share by which the mean error with `by` is smaller than the one with `than`.
    """
    both = [
        (one["estimation"], other["estimation"])
        for where in UNSEEN
        for path in TRAJECTORIES
        for one, other in zip(verdicts[by, where, path], verdicts[than, where, path])
        if one["landed"] and other["landed"]
    ]
    if not both:
        return float("nan"), 0
    ours, theirs = np.mean(both, axis=0)
    return float(1.0 - ours / theirs), len(both)


def mean(
    verdicts: dict,
    by: str,
    places: Iterable[str],
    paths: Iterable[str] = tuple(TRAJECTORIES),
    figure: str = "estimation",
) -> float:
    """Mean of a figure over all flights by an estimator, in constellations and on trajectories,
    that took off.
    """
    some = [
        one
        for where in places
        for path in paths
        for one in verdicts[by, where, path]
        if one["took_off"]
    ]
    values = [one["phases"]["air"]["nees"] if figure == "nees" else one[figure] for one in some]
    return float(np.mean(values)) if values else float("nan")
