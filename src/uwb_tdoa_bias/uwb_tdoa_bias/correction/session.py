"""A model with operators that a tape does not play, in onnxruntime: importing it takes longer than all the rest of a node's start."""

import numpy as np
import onnxruntime

from .tape import BATCH, Tape, Unplayable


class Session:
    """A model in onnxruntime, on one thread."""

    def __init__(self, content: bytes, tape: Tape):
        """content : of the file that the Tape has accepted; raises Unplayable where onnxruntime does not load or play it."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what goes wrong is told by who calls
        (self._name, _), self._outputs = tape.inputs[0], tape.outputs
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)
            self.run(np.zeros((1, tape.width)))
        except Exception as error:  # of its own family, with no common public base
            raise Unplayable(f"onnxruntime: {str(error).splitlines()[0][:200]}") from error

    def run(self, x: np.ndarray) -> np.ndarray:
        """x (n, width) float -> (n, outputs) float, so many rows at once as a Tape holds."""
        out, x = np.empty((len(x), self._outputs)), x.astype(np.float32)
        for first in range(0, len(x), BATCH):
            (out[first : first + BATCH],) = self._session.run(None, {self._name: x[first : first + BATCH]})
        return out
