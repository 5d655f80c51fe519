"""A model in onnxruntime. Importing that takes 60 ms, and is left to those who have a model."""

from __future__ import annotations

import numpy as np
import onnxruntime

from .graph_size import PACKED, Unplayable, size_of
from .onnx_file import Graph

BATCH = 64  # rows at most that are played together: what they hold stays in the cache


class Session:
    """A model on one thread, which gives each row of the input the same bits, whatever comes with it."""

    def __init__(self, graph: Graph) -> None:
        """Plays the bytes of the file that were read. Raises Unplayable where they are too large, or onnxruntime does not take them."""
        size = size_of(graph)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what goes wrong is reported by who calls
        self._rows, self._most = (1, 1) if size.alone else (PACKED, BATCH)
        ((self._name, _),), self._width, self._outputs = graph.inputs, size.width, size.outputs
        try:
            self._session = onnxruntime.InferenceSession(graph.content, options, providers=["CPUExecutionProvider"], enable_fallback=0)
            self._try_out()
        except Exception as error:  # of its own family, with no common public base
            raise Unplayable(f"onnxruntime: {str(error).splitlines()[0][:200]}") from error

    def run(self, x: np.ndarray) -> np.ndarray:
        """x (n, width) float -> (n, outputs) float. Rows are filled up to whole packets: other kernels play the rest of one, and
        a single row. Each batch begins at an address of its own, which is a multiple of 16 bytes."""
        out = np.empty((len(x), self._outputs))
        for first in range(0, len(x), self._most):
            some = x[first : first + self._most]
            padded = np.zeros((len(some) + -len(some) % self._rows, self._width), np.float32)
            padded[: len(some)] = some
            (made,) = self._session.run(None, {self._name: padded})
            if made.shape != (len(padded), self._outputs):
                raise ValueError(f"{made.shape} comes out of {padded.shape}")
            out[first : first + len(some)] = made[: len(some)]
        return out

    def _try_out(self) -> None:
        """Raises ValueError unless each row comes out as from its own."""
        x = np.random.default_rng(0).normal(size=(2 * PACKED, self._width))
        if not np.array_equal(self.run(x)[:PACKED], self.run(x[:PACKED]), equal_nan=True):
            raise ValueError("rows of the input that mix")
