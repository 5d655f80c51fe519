"""Reading a bag ahead of its use, so that decoding a chunk of it never delays a message."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

Item = TypeVar("Item")

BATCH = 500
BATCHES_AHEAD = 100


def read_ahead(messages: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield what the iterable yields, read by a thread up to 50,000 items ahead.

    Its exceptions are raised here.
    """
    batches: queue.Queue[list[Item] | BaseException | None] = queue.Queue(BATCHES_AHEAD)
    closed = threading.Event()

    def put(item: list[Item] | BaseException | None) -> None:
        while not closed.is_set():
            try:
                return batches.put(item, timeout=0.1)
            except queue.Full:
                pass

    def read() -> None:
        batch: list[Item] = []
        try:
            for message in messages:
                batch.append(message)
                if len(batch) == BATCH:
                    put(batch)
                    batch = []
                if closed.is_set():
                    return
            put(batch)
            put(None)
        except BaseException as error:
            put(batch)
            put(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        while (batch := batches.get()) is not None:
            if isinstance(batch, BaseException):
                raise batch
            yield from batch
    finally:
        closed.set()
        thread.join()
