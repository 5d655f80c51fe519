# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A model in onnxruntime.

The import of onnxruntime takes 60 ms; only users of a model import this module.
"""

from __future__ import annotations

import numpy as np
import onnxruntime

from ..common.arrays import SymbolicArray

PACKED = 4  # rows; batches are filled up to a multiple
BATCH = 64  # rows per run at most; their data fit into the cache


class Unplayable(ValueError):
    """The file is no model, is too large, or has an operator that is not permitted."""


class Session:
    """A model on one thread; each row of the input gives the same bits in any batch.

    Attributes
    ----------
    content : bytes of the file
    width, outputs : columns of the input and of the output
    meta : {key: text} of the file
    alone : whether each row is run separately
    """

    def __init__(
        self, content: bytes, alone: bool = False, options: onnxruntime.SessionOptions | None = None
    ) -> None:
        """Load the content of an ONNX file.

        Raises Unplayable if onnxruntime refuses it, or unless it has one input (n, width) and one output
        (n, outputs).
        """
        options = options or onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # the caller reports errors
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:  # onnxruntime's exceptions have no public base class
            raise Unplayable(f"onnxruntime: {str(error).splitlines()[0][:200]}") from error
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or len(self._session.get_outputs()) != 1 or len(inputs[0].shape) != 2:
            raise Unplayable("more than one input or output, or an input that is no table")
        self.content = content
        self._name, (rows, self.width) = inputs[0].name, inputs[0].shape
        if not isinstance(self.width, int):
            raise Unplayable("an input of unknown width")
        self.alone = alone or rows == 1
        self.meta = dict(self._session.get_modelmeta().custom_metadata_map)
        self.outputs = self._play(np.zeros((1, self.width), np.float32)).shape[1]

    def run(self, x: np.ndarray) -> np.ndarray:
        """Return the output (n, outputs) float of an input x (n, width) float.

        Rows are filled up to whole packets, since onnxruntime has other kernels for incomplete packets
        and single rows. Each batch begins at its own address, a multiple of 16 bytes.
        """
        if isinstance(x, SymbolicArray):
            return x.played(self)
        out, most = np.empty((len(x), self.outputs)), 1 if self.alone else BATCH
        for first in range(0, len(x), most):
            out[first : first + most] = self._play(x[first : first + most])
        return out

    def end_profiling(self) -> str:
        """Return the name of the profile, where the options ask for one."""
        return str(self._session.end_profiling())

    def _play(self, some: np.ndarray) -> np.ndarray:
        """Return the output of one batch; raise Unplayable."""
        padded = np.zeros(
            (len(some) + (0 if self.alone else -len(some) % PACKED), self.width), np.float32
        )
        padded[: len(some)] = some
        try:
            (made,) = self._session.run(None, {self._name: padded})
        except Exception as error:  # as above
            raise Unplayable(f"onnxruntime: {str(error).splitlines()[0][:200]}") from error
        if made.ndim != 2 or len(made) != len(padded):
            raise Unplayable(
                f"{made.shape} comes out of {padded.shape}: an output with other rows than "
                "the input"
            )
        return made[: len(some)]
