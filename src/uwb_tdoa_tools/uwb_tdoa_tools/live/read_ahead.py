"""Reading a bag ahead of its use, so that decoding a chunk of it never delays a message."""

import queue
import threading

BATCH = 500
BATCHES_AHEAD = 100


def read_ahead(messages):
    """Yield what the iterable yields, read by a thread up to 50,000 items ahead. Its exceptions are raised here."""
    batches = queue.Queue(BATCHES_AHEAD)
    closed = threading.Event()

    def put(item):
        while not closed.is_set():
            try:
                return batches.put(item, timeout=0.1)
            except queue.Full:
                pass

    def read():
        batch = []
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
