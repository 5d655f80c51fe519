# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Cut messages into pieces while they arrive, and calibrate from the pieces in another process.

A piece becomes a bag, which the reader of recordings reads. Hence a recording of the same messages
gives the same calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
import math
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import shutil
import signal
import struct
from threading import Thread
import time
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.stamps import StampGate
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorDelay, AnchorPosition

from ..bags.bag import read_bag
from ..bags.files import new_bag
from ..bags.messages import STREAMS, topics_of, typestore
from ..calibrating import cut
from .stream import PIECE, StreamCalibration, in_place

TDOAS, FRAMES = "uwb/tdoa", "/tf_static"
# {topic: type} of a piece: what the filter takes, with raw TDOAs
TOPICS = {topic: kind for name in STREAMS if name != "pose" for topic, kind in topics_of(name)}
LATE = 1.0  # s, largest delay of a message behind messages with later stamps
MOST_BYTES = 100_000_000  # of the messages that wait for the end of a piece
MOST_KEPT = 3  # calibrations in a folder
LOWEST_PRIORITY = 19
STAMP = struct.Struct("<iI")  # of a message that begins with a Header
ENCAPSULATION = 4  # bytes before it


class Message(NamedTuple):
    """A serialized message. t : s, its stamp; arrived : ns; content : CDR."""

    topic: str
    t: float
    arrived: int
    content: bytes


@dataclass(frozen=True)
class Piece:
    """Messages of a piece of a stream, and some before and after it.

    number : of the piece, from 0; first : s, stamp at which it begins
    frames : messages with constant transforms, in CDR
    """

    number: int
    first: float
    messages: list[Message]
    frames: list[bytes] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """Write a bag."""
        store, connections = typestore(), {}
        with new_bag(path) as writer:
            for topic, kind in {**TOPICS, FRAMES: "tf2_msgs/msg/TFMessage"}.items():
                name = f"/{topic.strip('/')}"
                connections[topic] = writer.add_connection(name, kind, typestore=store)
            for content in self.frames:
                writer.write(connections[FRAMES], self.messages[0].arrived, content)
            for message in self.messages:
                writer.write(connections[message.topic], message.arrived, message.content)


class PieceCutter:
    """Collect messages, and cut them into pieces of PIECE s by the stamps of the TDOAs.

    Attributes
    ----------
    left_out : number of messages without a stamp, or that waited beyond MOST_BYTES
    """

    def __init__(self) -> None:
        self.left_out = self._number = 0
        self._begin([])

    def _begin(self, messages: list[Message]) -> None:
        """Start anew with some messages."""
        self._tdoas = StampGate()
        # s, first stamp of a TDOA; it is final once the first piece is complete
        self._origin, self._place = math.inf, 0
        self._keep(messages)

    def _keep(self, messages: list[Message]) -> None:
        self._messages, self._bytes = messages, sum(len(one.content) for one in messages)

    def __len__(self) -> int:
        """Return the number of messages that wait for the end of their piece."""
        return len(self._messages)

    def add(self, topic: str, arrived: int, content: bytes) -> None:
        """Collect a message of TOPICS. arrived : ns."""
        if len(content) < ENCAPSULATION + STAMP.size:
            self.left_out += 1
            return
        if self._bytes > MOST_BYTES:  # of an IMU beside a silent radio
            self.left_out += len(self)
            self._begin([])
        second, nanosecond = STAMP.unpack_from(content, ENCAPSULATION)
        t = (second * 10**9 + nanosecond) / 1e9
        self._messages.append(Message(topic, t, arrived, content))
        self._bytes += len(content)
        if topic != TDOAS:
            return
        accepted, _, jumped_back = self._tdoas.take(t, None)
        if jumped_back:
            self._begin([one for one in self._messages if abs(one.t - t) < LATE])
            self._tdoas.take(t, None)
        if self._place == 0:
            self._origin = min([self._origin, *(stamp for stamp, _ in accepted)])

    def pieces(self) -> Iterator[Piece]:
        """Yield the pieces that are complete."""
        while True:
            first = self._origin + self._place * PIECE
            end = first + PIECE
            newest = self._tdoas.newest
            if newest < end + LATE:
                return
            yield Piece(self._number, first, self._messages)
            kept = [one for one in self._messages if end - LATE <= one.t <= newest + LATE]
            self._keep(kept)
            # the next piece with TDOAs
            following = min(one.t for one in kept if one.topic == TDOAS and one.t >= end)
            self._place = int((following - self._origin) // PIECE)
            self._number += 1


class Taken(NamedTuple):
    """What came of a piece.

    number : of the calibration that is in use; taken : whether it is new; text : a sentence
    effects : EffectSet in use, see StreamCalibration
    last : s, stamp of the last TDOA of the piece; cost : s of processor time
    """

    number: int
    taken: bool
    text: str
    effects: EffectSet
    last: float
    cost: float


def take(calibration: StreamCalibration, piece: Piece) -> Taken:
    """Give a Piece to a StreamCalibration."""
    before = time.process_time()
    taken, last = False, piece.first + PIECE
    with temporary_folder() as folder:
        path = folder / "piece"
        piece.write(path)
        try:
            flight = read_bag(path, anchors=calibration.given, salvage=True, truth=False)
            part = cut(flight, piece.number, piece.first)
            if part is None:
                raise InputError("it has no TDOAs.")
            step = calibration.take(part)
            taken, text, last = step.taken, step.text, step.last
        except InputError as error:
            text = str(error).replace(f"{path}: ", "")
    cost = time.process_time() - before
    return Taken(calibration.number, taken, text, calibration.effects, last, cost)


class Worker:
    """A StreamCalibration in a process of its own, at the lowest priority."""

    def __init__(self, calibration: StreamCalibration) -> None:
        """Start the process."""
        spawn = multiprocessing.get_context("spawn")
        self._end, other = spawn.Pipe()
        self._process = spawn.Process(target=_work, args=(other, calibration), daemon=True)
        self._process.start()
        other.close()
        self.busy = False

    def give(self, piece: Piece) -> None:
        """Give it a piece; it is busy until the result."""
        self.busy = True
        # the process may take long to read it; if it has ended, `result` says so
        Thread(target=self._send, args=(piece,), daemon=True).start()

    def _send(self, piece: Piece) -> None:
        with suppress(OSError):
            self._end.send(piece)

    def result(self) -> Taken | None:
        """Return what came of the last piece, once.

        Raises OSError or EOFError if the process has ended.
        """
        if not (self.busy and self._end.poll()):
            return None
        taken: Taken = self._end.recv()
        self.busy = False
        return taken

    def close(self) -> None:
        """End the process; a solution that it computes is lost."""
        self._process.terminate()
        self._process.join()


def _work(end: Connection, calibration: StreamCalibration) -> None:
    """Take pieces until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the node ends it
    os.nice(LOWEST_PRIORITY)
    try:
        while True:
            end.send(take(calibration, end.recv()))
    except (EOFError, OSError):
        return


def keep(folder: Path, number: int, given: Anchors, effects: EffectSet) -> None:
    """Write a calibration to a folder of its own in `folder`, and delete all but the MOST_KEPT last.

    It has anchors.yaml and effects.yaml, as `calibrate` writes them. Either both files appear, or none.
    Raises OSError and InputError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / ".partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    anchors, others = in_place(given, effects)
    anchors.to_yaml(partial / "anchors.yaml")
    others.to_yaml(partial / "effects.yaml")
    partial.rename(folder / str(number))
    for old in sorted(_kept(folder))[:-MOST_KEPT]:
        shutil.rmtree(folder / str(old))


def _kept(folder: Path) -> list[int]:
    return [int(one.name) for one in folder.glob("*") if one.name.isdecimal()]


def last_kept(folder: Path, given: Anchors, base: EffectSet) -> tuple[int, EffectSet, float]:
    """Return (number, effects, age in s) of the last calibration that `keep` has written.

    Its positions and delays of anchors replace those of `base`. Without any: (0, base, 0). Raises
    InputError if it is of other anchors, or cannot be read.
    """
    numbers = _kept(folder)
    if not numbers:
        return 0, base, 0.0
    path = folder / str(max(numbers))
    anchors, kept = read_survey(path / "anchors.yaml"), EffectSet.from_yaml(path / "effects.yaml")
    if anchors.frame != given.frame or not np.array_equal(anchors.ids, given.ids):
        raise InputError(
            f"{path}: is of anchors {', '.join(map(str, anchors.ids))} in frame '{anchors.frame}', the "
            f"survey of {', '.join(map(str, given.ids))} in '{given.frame}': delete it, or name "
            "another folder."
        )
    shifts = {
        f"{i}.{axis}": value
        for i, row in zip(given.ids.tolist(), (anchors.positions - given.positions).tolist())
        for axis, value in zip("xyz", row)
    }
    delays = [one for one in kept if isinstance(one, AnchorDelay)]
    effects = base.with_anchors([AnchorPosition(values=shifts), *delays])
    age = time.time() - path.stat().st_mtime
    return max(numbers), EffectSet(effects.effects, kept.covariance), age
