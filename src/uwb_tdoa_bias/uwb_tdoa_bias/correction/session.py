"""A model that only onnxruntime can run: importing it takes longer than all the rest of a node's start."""

import numpy as np
import onnxruntime


class Session:
    """An ONNX model in onnxruntime, on one thread. inputs : [(name, shape)]; meta : {key: text}."""

    def __init__(self, path):
        """Raises an exception of onnxruntime's own family, with no common public base, for what is no model."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what goes wrong is told by who calls
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
        )
        self.meta = self._session.get_modelmeta().custom_metadata_map
        self.inputs = [(entry.name, entry.shape) for entry in self._session.get_inputs()]

    def run(self, x):
        """x (n, width) float -> what the model gives, of whatever kind."""
        return self._session.run(None, {self.inputs[0][0]: x.astype(np.float32)})[0]
