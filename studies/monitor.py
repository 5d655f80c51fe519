# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""monitor: judge the monitor of ekf_node on measured flights with faults, and on unchanged flights.
Measure its processor time.

The study runs the filter and monitor of the node off line.
"""

from dataclasses import replace
from pathlib import Path

from monitor_cost import CASES, cost
import numpy as np

from uwb_tdoa_bias.common import geometry
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.monitoring.monitor import Monitor
from uwb_tdoa_ekf.monitoring.slices import LENGTH, reduced
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.scoring.metrics import position_at

STEP = 0.5  # s between two looks at what the monitor says
SIZES = {0.6: 5.0, 0.3: 10.0}  # m: s within which it is to be named
MIDDLE = 0.4, 0.6  # of the time in the air, between which a fault begins
SPAN = 6.0  # s over which delays at the ground truth are averaged
JUDGED = 5.0  # s after the beginning of a fault from which errors count


def measured(folder):
    """The micro-SD logs below DATA/flights, without range finders and the like."""
    for log in sorted(
        path for path in (folder / "flights").rglob("*") if path.is_file() and not path.suffix
    ):
        day = log.relative_to(folder / "flights").parts[0]
        flight = read_flight(log, folder / "surveys" / f"anchor_{day}.txt")
        yield replace(flight, height=None, pressure=None, velocity=None)


def cut(flight, low, high):
    """The part of a Flight between two times after its first TDOA."""
    begin = flight.tdoa.t[0]

    def part(stream):
        inside = (stream.t >= begin + low) & (stream.t < begin + high)
        return type(stream)(*(column[inside] for column in vars(stream).values()))

    return replace(flight, imu=part(flight.imu), tdoa=part(flight.tdoa))


def airborne(flight):
    """First and last instant, s, with the tag in the air."""
    high = flight.truth.t[flight.truth.p[:, 2] > 0.3]
    return high[0], high[-1]


def flights_of(folder, days):
    """Flights of the given days: micro-SD logs by folder, CSV files by constellation."""
    flights = [f for f in measured(folder) if any(f"/{day}/" in f.meta["source"] for day in days)]
    for path in sorted((folder / "util").glob("*.csv.gz")):
        constellation = path.name.split("-")[0]
        if constellation in days:
            flights.append(read_flight(path, folder / "surveys" / f"anchor_{constellation}.csv"))
    return flights


def late(flight, row, size, since):
    """The Flight with an anchor that is late by size, m, from a stamp on."""
    tdoa, anchor = flight.tdoa, flight.anchors.ids[row]
    sign = (tdoa.b == anchor).astype(float) - (tdoa.a == anchor)
    return replace(flight, tdoa=replace(tdoa, d=tdoa.d + size * sign * (tdoa.t > since)))


def silenced(flight, ids, since):
    """The Flight in which anchor ids[0] falls silent at stamp `since`, s."""
    tdoa = flight.tdoa
    heard = (tdoa.t < since) | ((tdoa.a != ids[0]) & (tdoa.b != ids[0]))
    return replace(flight, tdoa=type(tdoa)(*(column[heard] for column in vars(tdoa).values())))


def exchanged(flight, ids, since):
    """The Flight in which two anchors have each other's id from a stamp on."""

    def other(column):
        return np.where(
            flight.tdoa.t < since,
            column,
            np.where(column == ids[0], ids[1], np.where(column == ids[1], ids[0], column)),
        )

    return replace(
        flight, tdoa=replace(flight.tdoa, a=other(flight.tdoa.a), b=other(flight.tdoa.b))
    )


# {fault: (function that puts it into a flight, alarm that is expected within EVENT_LIMIT)}. {0} and
# {1} are the ids of the anchors.
EVENTS = {
    "silent": (silenced, "anchor {0} is not heard any more"),
    "exchanged": (exchanged, "two anchors are exchanged, {0} and {1}"),
}
EVENT_LIMIT = 5.0  # s


def watched(flight, config):
    """[(s, sentences)], every STEP, and (t (n,) s, p (n, 3) m) of a Flight.

    The filter runs off line, with the same result as live.
    """
    result, monitor, said = run_offline(flight, config), Monitor(flight.anchors), []
    odometry, residuals = (_by_stamp(part) for part in (result.odometry, result.residuals))
    low = -np.inf
    for until in np.arange(
        (np.floor(flight.tdoa.t[0] / STEP) + 1.0) * STEP, flight.tdoa.t[-1] + STEP, STEP
    ):
        monitor.add(*(_between(part, low, until) for part in (odometry, residuals)))
        monitor.update(until)
        said.append((until, monitor.alarms))
        low = until
    return said, (odometry.t, odometry.p)


def _by_stamp(part):
    order = np.argsort(part.t, kind="stable")
    return type(part)(*(column[order] for column in vars(part).values()))


def _between(part, low, high):
    """The part of an Odometry, or of Residuals, with stamps from `low` on and before `high`, s."""
    inside = slice(*np.searchsorted(part.t, [low, high]))
    return type(part)(*(column[inside] for column in vars(part).values()))


def error_of(flight, track, low, high):
    """RMSE, m, between two stamps."""
    t, p = track
    inside = (t >= low) & (t < high)
    return float(
        np.sqrt(np.nanmean(np.sum((p[inside] - position_at(t[inside], flight.truth)) ** 2, axis=1)))
    )


def delays_at_truth(flight):
    """(t (n,) s, delays (n, N) m) at the ground truth, for each half second in the air.

    They are reduced as in the monitor.
    """
    tdoa, (begin, end), positions = flight.tdoa, airborne(flight), flight.anchors.positions
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    p = position_at(tdoa.t, flight.truth)
    error = tdoa.d - geometry.tdoa(p, positions[a], positions[b])
    known, t, out = np.isfinite(error), np.arange(begin, end, LENGTH), []
    for low in t:
        now = known & (tdoa.t >= low) & (tdoa.t < low + LENGTH)
        piece = (
            reduced(low, p[now].mean(axis=0), positions, a[now], b[now], error[now])
            if now.any()
            else None
        )
        out.append(np.full(len(positions), np.nan))
        if piece is not None:
            out[-1][piece.rows] = piece.delays
    return t, np.array(out)


def borne_out(flight, t, sentence):
    """Change of the delay of the anchor that an alarm names, from the ground truth, m.

    It is the mean delay in the SPAN seconds around t, minus the mean from 2 SPAN to SPAN before t.
    The delays are shrunk as in the monitor. NaN for other sentences.
    t : stamp of the first alarm, s
    """
    if not sentence.startswith("anchor "):
        return np.nan
    row = int(flight.anchors.index(np.array([int(sentence.split()[1].rstrip(":"))]))[0])
    at, delays = delays_at_truth(flight)
    now, before = (
        (at > t - 0.5 * SPAN) & (at < t + 0.5 * SPAN),
        (at > t - 2.0 * SPAN) & (at < t - SPAN),
    )
    return float(np.nanmean(delays[now, row]) - np.nanmean(delays[before, row]))


def clean(flights, config):
    """Prints the alarms on unchanged flights, and the change of the delay from the ground truth."""
    seconds = alarmed = grounded = 0
    for flight in flights:
        said, _ = watched(flight, config)
        begin, end = airborne(flight)
        seconds += end - begin
        first = next(((t, sentences[0]) for t, sentences in said if sentences), None)
        alarmed += first is not None
        grounded += any(
            sentences
            for t, sentences in said
            if t < begin or (t > end and not (first and first[0] <= end))
        )
        if first:
            truth = borne_out(flight, *first)
            print(
                (
                    f"  {flight.name}: {first[0] - begin:.1f} s in the air: {first[1]} (at the "
                    f"ground truth by {truth:+.2f} m)"
                ),
                flush=True,
            )
    print(
        f"{alarmed} of {len(flights)} unharmed flights with an alarm, {grounded} on the "
        f"floor, {seconds:.0f} s in the air"
    )


def faults(flights, config, draws, seed):
    """Prints how often a late anchor is named, and the errors with and without it compensated."""
    rng = np.random.default_rng(seed)
    compensating = replace(config, compensate_changes=True)
    print(
        "| late by, m | cases | named in time | another named first | median after, s | "
        "error, m: unharmed | harmed | compensated |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for size, limit in SIZES.items():
        named, wrong, after, errors = 0, 0, [], []
        for row in range(min(len(flight.anchors) for flight in flights)):
            for _ in range(draws):
                flight = flights[rng.integers(len(flights))]
                begin, end = airborne(flight)
                since = begin + (end - begin) * rng.uniform(*MIDDLE)
                harmed = late(flight, row, size, since)
                said, track = watched(harmed, config)
                name = f"anchor {flight.anchors.ids[row]}:"
                told = next(((t, s[0]) for t, s in said if t > since and s), (np.inf, ""))
                right = told[1].startswith(name) and told[0] - since <= limit + STEP
                named += right
                wrong += not told[1].startswith(name) and told[0] - since <= limit + STEP
                after += [told[0] - since] if right else []
                tracks = watched(flight, config)[1], track, watched(harmed, compensating)[1]
                errors.append([error_of(flight, one, since + JUDGED, end) for one in tracks])
        ratios = np.array(errors)[:, 1:] / np.array(errors)[:, :1]
        cells = " | ".join(f"{value:.3f}" for value in np.sqrt(np.mean(np.square(errors), axis=0)))
        n = len(errors)
        print(
            f"| {size} | {n} | {100 * named / n:.0f} % | {100 * wrong / n:.0f} % | "
            f"{np.median(after):.1f} | {cells} |"
        )
        for name, column in zip(("harmed", "compensated"), ratios.T):
            print(
                f"  {name} / unharmed: median {np.median(column):.2f}, at most 1.2 in "
                f"{100 * np.mean(column <= 1.2):.0f} %"
            )


def events(flights, config, draws, seed):
    """Prints how often a silent anchor, and two that were exchanged, are named."""
    rng = np.random.default_rng(seed)
    print(
        f"| anchors | cases | named within {EVENT_LIMIT:g} s | something else named first | "
        "median after, s |\n|---|---|---|---|---|"
    )
    for name, (change, sentence) in EVENTS.items():
        after, wrong, n = [], 0, 0
        for row in range(min(len(flight.anchors) for flight in flights)):
            for _ in range(draws):
                flight = flights[rng.integers(len(flights))]
                begin, end = airborne(flight)
                since = begin + (end - begin) * rng.uniform(*MIDDLE)
                other = rng.choice(np.delete(np.arange(len(flight.anchors)), row))
                ids = flight.anchors.ids[
                    sorted([row, other]) if name == "exchanged" else [row, other]
                ]
                said, _ = watched(
                    cut(
                        change(flight, ids, since),
                        0.0,
                        since + EVENT_LIMIT + STEP - flight.tdoa.t[0],
                    ),
                    config,
                )
                told = next(((t, s[0]) for t, s in said if t > since and s), (np.inf, ""))
                n += 1
                right = (
                    told[1].startswith(sentence.format(*ids))
                    and told[0] - since <= EVENT_LIMIT + STEP
                )
                after += [told[0] - since] if right else []
                wrong += bool(told[1]) and not told[1].startswith(sentence.format(*ids))
        print(
            (
                f"| {name} | {n} | {100 * len(after) / n:.0f} % | {100 * wrong / n:.0f} % | "
                f"{np.median(after):.1f} |"
            ),
            flush=True,
        )


def add_options(add):
    """The options of the study."""
    add("data", metavar="DATA", type=Path, help="folder of measured flights")
    add(
        "--days", nargs="+", default=["0422", "0425", "0426", "0607"], help="(default: raw flights)"
    )
    draws = "of flight and time, for each anchor; 0: unharmed flights alone (default: %(default)s)"
    add("--draws", metavar="N", type=int, default=10, help=draws)
    add("--events", action="store_true", help="anchors that are silent or exchanged, not late")
    add("--seed", metavar="N", type=int, default=1, help="of the draws (default: %(default)s)")
    add("--cost", action="store_true", help="memory and processor time by the number of anchors")


def run(args):
    """Print the tables."""
    if args.cost:
        costs()
        return
    flights = flights_of(args.data, args.days)
    if args.events:
        events(flights, FilterConfig(), args.draws, args.seed)
        return
    clean(flights, FilterConfig())
    if args.draws:
        faults(flights, FilterConfig(), args.draws, args.seed)


def costs():
    """Print what watching takes, by the number of anchors."""
    cost(8, 8, 30)  # what is compiled, is
    print("| anchors | heard at a time | memory, MB | ms each half second |\n|---:|---:|---:|---:|")
    for n, heard in CASES:
        peak, seconds = cost(n, heard, 60)
        print(f"| {n} | {heard} | {peak / 1e6:.1f} | {1e3 * seconds:.1f} |", flush=True)
