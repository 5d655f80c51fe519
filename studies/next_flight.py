# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""next-flight: whether a flight that `diagnose` plans settles what the first flight left open.

A systematic error is put into a short simulated flight on a simple path. If its diagnosis is
ambiguous, that is, another effect has a criterion within 10 of the true one, a second flight is
planned. The same error is put into this flight, and into a random flight of the same length. Each is
diagnosed together with the first one.
"""

from known_effects import CLEAN
import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, SmoothTerm
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.motions import Limits, motions, route
from uwb_tdoa_tools.diagnosis.next_flight import plan_flight
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.regression.select import AMBIGUOUS
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.parallel import whole_number
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.rooms import room_of

PATHS = ("line_x", "line_y", "circle", "square")
KINDS = (
    "anchor_delay",
    "anchor_position",
    "tag_lever_arm",
    "truth_frame",
    "range_scale",
    "range_bias",
    "tdoa_time_offset",
    "received_power_bias",
    "antenna_pattern",
    "bearing",  # a function of one anchor, which looks like its position
)
FIRST_SECONDS = 25.0
FIRST_SEED = 9000  # smaller seeds were looked at while the planner was developed
RATES = {"imu_rate": 200.0, "truth_rate": 100.0, "start_in_air": True}


def add_options(add):
    """The options of the study."""
    add("--cases", metavar="N", type=whole_number, default=40, help="ambiguous cases (default: 40)")
    add("--seed", metavar="S", type=whole_number, default=FIRST_SEED, help="of the first draw")
    add(
        "--time", metavar="S", type=float, default=30.0, help="longest planned flight (default: 30)"
    )
    add(
        "--functions",
        action="store_true",
        help="search for functions without a name too, as diagnose does; takes four times as long",
    )
    add("--json", metavar="FILE", type=OutputFile, help="write every case")


def run(args):
    """Print a line for each case, and the shares."""
    cases, seed = [], args.seed
    while len(cases) < args.cases:
        case = judged(seed, args.time, args.functions)
        seed += 1
        if case is None:
            continue
        cases.append(case)
        print(
            f"{len(cases)}: seed {case['seed']}: {case['true']}, left {case['left']}; stated "
            f"{case['stated']:.2f} in {case['seconds']:.0f} s; planned {case['planned']}, random "
            f"{case['random']}, with its yaw kept {case['kept']}",
            flush=True,
        )
        if args.json is not None:
            cli.write_json(args.json, {"cases": cases, "draws": seed - args.seed})
    figures = {
        name: np.mean([case[name] for case in cases])
        for name in ("planned", "random", "kept", "stated", "seconds")
    }
    print(
        f"{len(cases)} ambiguous cases of {seed - args.seed} draws: the planned flight settles "
        f"{figures['planned']:.0%} (stated {figures['stated']:.0%}), a random flight of the same "
        f"length {figures['random']:.0%}, with its yaw kept {figures['kept']:.0%}; {figures['seconds']:.0f} s on the mean"
    )


def judged(seed, longest, functions):
    """dict of the case of a seed, or None if the first flight leaves no ambiguity.

    It has the true effect, the effect that remains ambiguous with it, and the probability of
    success that the plan states. It also has whether the planned flight and the random flights
    resolve the ambiguity.
    """
    rng = np.random.default_rng([seed, 52])
    name = KINDS[rng.integers(len(KINDS))]
    effect = drawn(name, rng)
    path, protocol = PATHS[rng.integers(len(PATHS))], ("tdoa2", "tdoa3")[rng.integers(2)]
    simple = {"trajectory": path, "duration": FIRST_SECONDS}
    first = flown(effect, seed, protocol, **simple)
    found = attribute([first], GroundTruth(), undeclared=functions)
    left = open_question(found, effect)
    if left is None:
        return None
    limits = Limits(time=longest)
    room = room_of(first.anchors)
    library = motions(room, [first], limits)
    plan = plan_flight([first], found, found.findings(), library)
    case = {
        "seed": seed,
        "true": title_of(effect),
        "left": left,
        "stated": plan.probability,
        "seconds": plan.path.duration,
    }
    others = {
        "planned": plan.path,
        "random": at_random(plan.path, room, limits, rng, np.pi),
        "kept": at_random(plan.path, room, limits, rng, 0.0),
    }
    for kind, one in others.items():
        poses = np.column_stack([one.t, one.p, one.yaw])
        other = flown(
            effect,
            seed + 500_000,
            protocol,
            poses=tuple(map(tuple, poses)),
            duration=one.duration,
        )
        again = attribute([first, other], GroundTruth(), undeclared=functions)
        case[kind] = settles(again, effect, left)
    return case


def drawn(name, rng):
    """An effect of a kind, with a size and an anchor at random."""
    anchor, sign = int(rng.integers(8)), rng.choice([-1.0, 1.0])
    way = rng.standard_normal(3)
    way /= np.linalg.norm(way)
    if name == "bearing":
        values = dict(zip((f"{anchor}.c1", f"{anchor}.c2"), rng.uniform(0.08, 0.2) * way[:2]))
        return SmoothTerm(
            values, covariate="bearing", form="anchor", knots=(-np.pi, np.pi), shape="wave"
        )
    values = {
        "anchor_delay": {f"{anchor}": sign * rng.uniform(0.05, 0.2)},
        "anchor_position": {
            f"{anchor}.{axis}": x for axis, x in zip("xyz", rng.uniform(0.06, 0.2) * way)
        },
        "tag_lever_arm": dict(zip("xyz", rng.uniform(0.05, 0.15) * way)),
        "truth_frame": dict(zip("xyz", rng.uniform(0.04, 0.12) * way)),
        "range_scale": {"scale": sign * rng.uniform(0.01, 0.03)},
        "range_bias": {"quadratic": sign * rng.uniform(0.002, 0.006)},
        "tdoa_time_offset": {"offset": rng.uniform(0.015, 0.05)},
        "received_power_bias": {"scale": rng.uniform(0.7, 2.0)},
        "antenna_pattern": {"tag": rng.uniform(0.1, 0.3)},
    }[name]
    return EFFECTS[name](values)


def flown(effect, seed, protocol, **path):
    """A simulated flight with the effect."""
    flight = simulate(SimulationConfig(seed=seed, protocol=protocol, **path, **RATES, **CLEAN))
    return effect.inject(flight, np.random.default_rng([seed, 53]))


def title_of(effect):
    """The title of a candidate with the effect."""
    return effect.label if isinstance(effect, SmoothTerm) else effect.name


def open_question(found, effect):
    """Title of the effect that is ambiguous with the true one; None if there is none."""
    true = title_of(effect)
    for candidate, rivals in zip(found.selection.chosen, found.selection.rivals):
        near = {one.candidate.title for one in rivals if abs(one.gap) < AMBIGUOUS}
        if candidate.title == true and near:
            return min(near)
        if true in near:
            return candidate.title
    return None


def settles(found, effect, left):
    """Whether an Attribution contains the true effect, and `left` is neither chosen nor a close
    alternative.
    """
    true = title_of(effect)
    chosen = {
        one.title: rivals for one, rivals in zip(found.selection.chosen, found.selection.rivals)
    }
    near = {one.candidate.title for one in chosen.get(true, ()) if one.gap < AMBIGUOUS}
    return true in chosen and left not in chosen and left not in near


def at_random(planned, room, limits, rng, turn):
    """A TimedPath of the same length through random places, with random yaws up to `turn`, rad."""
    count = 2 + int(planned.duration)
    places = rng.uniform(*room.path_box, (count, 3))
    out = route(places, rng.uniform(-turn, turn, count), limits)
    rows = len(planned.p)
    return type(out)(out.p[:rows], out.yaw[:rows], "random", (0, rows - 1))
