# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Changes of the events of a flight, from which faults are made.

Each takes (events, Scene) and returns events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors

from .events import NUMBERS, Event, Scene, in_order

APART = 0.02  # m
Change = Callable[[list[Event], Scene], list[Event]]
OfOne = Callable[[Event, Scene], Iterable[Event]]  # replaces one event by others


def nothing(events: list[Event], _: Scene) -> list[Event]:
    """The same."""
    return events


def chain(*changes: Change) -> Change:
    """One after the other."""

    def change(events: list[Event], scene: Scene) -> list[Event]:
        for each in changes:
            events = each(events, scene)
        return in_order(events)

    return change


def during(streams: str, of_one: OfOne) -> Change:
    """What of_one makes of each event of some streams (names, split at blanks) while the fault
    lasts.
    """
    names = streams.split()

    def change(events: list[Event], scene: Scene) -> list[Event]:
        out: list[Event] = []
        for event in events:
            hit = event.stream in names and scene.begin <= event.at < scene.end
            out.extend(of_one(event, scene) if hit else (event,))
        return in_order(out)

    return change


def first(count: int, stream: str, of_one: OfOne) -> Change:
    """What of_one makes of the first few events of a stream, a tenth of a second apart."""

    def change(events: list[Event], scene: Scene) -> list[Event]:
        times = [event.at for event in events if event.stream == stream]
        chosen = {
            min((at for at in times if at >= scene.begin + 0.1 * k), default=None)
            for k in range(count)
        }
        out: list[Event] = []
        for event in events:
            out.extend(
                of_one(event, scene) if event.stream == stream and event.at in chosen else (event,)
            )
        return in_order(out)

    return change


def restamped(seconds: float, rate: float = 0.0) -> OfOne:
    """Stamps are ahead by `seconds`, and by `rate` s more for each second."""
    return lambda event, scene: (
        event._replace(t=event.t + seconds + rate * (event.t - scene.begin)),
    )


def delayed(seconds: float, restamp: bool = False) -> OfOne:
    """Messages come later. restamp : by their arrival."""
    return lambda event, _: (event._replace(at=event.at + seconds, t=event.t + seconds * restamp),)


def in_bursts(period: float) -> OfOne:
    """Messages come together, once in each period, s."""
    return lambda event, _: (event._replace(at=period * math.ceil(event.at / period)),)


def lost(_: Event, __: Scene) -> Iterable[Event]:
    """No message."""
    return ()


def repeated(count: int) -> OfOne:
    """Each message comes `count` times."""
    return lambda event, _: (event,) * count


def scaled(factor: float, *fields: str) -> OfOne:
    """Numbers times a factor; of some fields only."""
    return valued(lambda value: value * factor, *fields)


def valued(function: Callable[[Any], Any], *fields: str) -> OfOne:
    """function(value) instead of the numbers; of some fields only."""

    def of_one(event: Event, _: Scene) -> Iterable[Event]:
        new = {name: function(event.values[name]) for name in (fields or NUMBERS[event.stream])}
        return (event._replace(values=event.values | new),)

    return of_one


def frozen(streams: str) -> Change:
    """Values freeze at the first message of the fault; stamps continue."""

    def change(events: list[Event], scene: Scene) -> list[Event]:
        kept: dict[str, dict[str, Any]] = {}
        return during(
            streams,
            lambda event, _: (event._replace(values=kept.setdefault(event.stream, event.values)),),
        )(events, scene)

    return change


def for_good(change: Change) -> Change:
    """A change that does not end with the fault."""
    return lambda events, scene: change(events, replace(scene, end=math.inf))


def only_from(seconds: float, change: Change) -> Change:
    """A change that begins `seconds` after the fault."""
    return lambda events, scene: change(events, replace(scene, begin=scene.begin + seconds))


def relabelled(labels: dict[int, int]) -> OfOne:
    """Other ids of anchors."""

    def of_one(event: Event, _: Scene) -> Iterable[Event]:
        new = {key: labels.get(int(event.values[key]), event.values[key]) for key in "ab"}
        return (event._replace(values=event.values | new),)

    return of_one


def late_anchor(anchor: int, metres: float) -> OfOne:
    """One anchor is late: its distance is longer."""

    def of_one(event: Event, _: Scene) -> Iterable[Event]:
        a, b, d = (event.values[key] for key in "abd")
        return (
            event._replace(
                values=event.values | {"d": d + metres * (int(b == anchor) - int(a == anchor))}
            ),
        )

    return of_one


def second_sender(of_one: OfOne) -> OfOne:
    """A second publisher sends what of_one makes of each message."""
    return lambda event, scene: (event, *(new._replace(sender=1) for new in of_one(event, scene)))


def survey(change: Callable[[Anchors], Anchors]) -> Change:
    """Other anchors from the start."""

    def changed(events: list[Event], _: Scene) -> list[Event]:
        return [
            e._replace(values={"anchors": change(e.values["anchors"])})
            if e.stream == "anchors"
            else e
            for e in events
        ]

    return changed


def placed(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other positions of the anchors: change((n, 3) m) gives (n, 3) m."""
    return survey(lambda anchors: replace(anchors, positions=change(anchors.positions.copy())))


def moved(row: int, metres: np.ndarray | list[float]) -> Change:
    """One anchor is elsewhere by (3,) m."""
    return placed(lambda p: p + np.outer(np.arange(len(p)) == row, metres))


def republished(period: float, change: Callable[[Anchors, np.random.Generator], Anchors]) -> Change:
    """Anchors are published again in each period, s, of the fault, changed; and unchanged at its
    end.
    """

    def changed(events: list[Event], scene: Scene) -> list[Event]:
        true, rng = (
            next(e for e in events if e.stream == "anchors").values["anchors"],
            np.random.default_rng(0),
        )
        times = np.arange(scene.begin, scene.end, period).tolist()
        return in_order(
            events
            + [Event(at, "anchors", at, {"anchors": change(true, rng)}) for at in times]
            + [Event(scene.end, "anchors", scene.end, {"anchors": true})]
        )

    return changed


def framed(stream: str, *frames: str) -> Change:
    """Messages of a stream come in these frames, in turn.

    In /tf_static, the first frame is at the body. Each following frame is APART above the previous
    one.
    """

    def changed(events: list[Event], scene: Scene) -> list[Event]:
        transforms = [
            (frame, [0.0, 0.0, APART * k], [0.0, 0.0, 0.0]) for k, frame in enumerate(frames)
        ]
        rows = [k for k, event in enumerate(events) if event.stream == stream]
        out = list(events)
        for turn, k in enumerate(rows):
            out[k] = events[k]._replace(
                frame=frames[turn % len(frames) if events[k].at >= scene.begin else 0]
            )
        return in_order([Event(-1.0, "frames", 0.0, {"transforms": transforms}), *out])

    return changed


def jittered_frames(period: float, rad: float) -> Change:
    """Frames of /tf_static are published again in each period, turned by `rad` (standard
    deviation).
    """

    def changed(events: list[Event], scene: Scene) -> list[Event]:
        true, rng = (
            next(e for e in events if e.stream == "frames").values["transforms"],
            np.random.default_rng(0),
        )
        times = np.arange(scene.begin, scene.end, period).tolist()
        turned = [
            [(frame, p, (rad * rng.standard_normal(3)).tolist()) for frame, p, _ in true]
            for _ in times
        ]
        return in_order(
            events
            + [Event(at, "frames", at, {"transforms": new}) for at, new in zip(times, turned)]
        )

    return changed


def done(stream: str, after: float = 0.0, **values: Any) -> Change:
    """Something is done `after` s after the fault begins."""
    return lambda events, scene: in_order(
        [*events, Event(scene.begin + after, stream, scene.begin + after, values)]
    )


def pose_given(offset: float = 0.0, yaw: float = 0.0) -> Change:
    """A pose on initialpose that is wrong by `offset`, m, along x, and by `yaw`, rad."""

    def changed(events: list[Event], scene: Scene) -> list[Event]:
        p, true = scene.pose(scene.begin)
        values = {"p": (p + [offset, 0.0, 0.0]).tolist(), "yaw": true + yaw}
        return in_order([*events, Event(scene.begin, "initialpose", scene.begin, values)])

    return changed
