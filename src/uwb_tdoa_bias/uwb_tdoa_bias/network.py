"""A bias network in an ONNX file that says itself what it wants.

Metadata of the model (all values JSON text):
    features  list of names out of features.FEATURES: the input columns
    offset, scale  lists as long as features: the network is fed (feature - offset) / scale
    clip      number, metres: the output is limited to +-clip
    name      short name, goes into every message
Input: one float tensor (n, number of features), of any name. Output: one float tensor (n, 1), bias in metres, or (n, 2),
bias and its standard deviation in metres.
"""

import json
from pathlib import Path

import numpy as np
import onnxruntime

from .errors import InputError
from .features import FEATURES, features


class Network:
    """An ONNX bias model, run on one thread."""

    def __init__(self, path):
        """Load `path`; raises InputError if it is no model or its metadata do not fit."""
        self._path = Path(path).absolute()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        if not Path(path).is_file():
            raise InputError(f"model: {path} does not exist; give an .onnx file or leave the model empty.")
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises its own family of exceptions, with no common public base
            raise InputError(f"model: {path} cannot be loaded as ONNX ({str(error).splitlines()[0]}).") from error
        meta = self._session.get_modelmeta().custom_metadata_map
        try:
            names, self._offset, self._scale = (json.loads(meta[key]) for key in ("features", "offset", "scale"))
            self._columns = [FEATURES.index(name) for name in names]
            self._offset, self._scale = np.array(self._offset, dtype=float), np.array(self._scale, dtype=float)
            self.clip = float(json.loads(meta["clip"]))
            self.name = str(json.loads(meta["name"]))
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"model: {path}: its metadata must hold features (names out of {', '.join(FEATURES)}), offset, scale, "
                f"clip and name as JSON; the problem is {error!r}."
            ) from error
        (entry,) = self._session.get_inputs()
        width = entry.shape[-1]
        if not (len(self._columns) == len(self._offset) == len(self._scale) == width) or (self._scale == 0).any():
            raise InputError(
                f"model: {path}: input {entry.name!r} has {width} columns, the metadata name {len(self._columns)} features, "
                f"{len(self._offset)} offsets and {len(self._scale)} scales; they must agree, and no scale may be 0."
            )
        self._input = entry.name

    def __reduce__(self):
        """Pickled as the path of its file: a session cannot be."""
        return Network, (self._path,)

    def predict(self, samples):
        """Bias and its standard deviation, two (n,) arrays in metres; NaN where a feature it needs is unknown."""
        x = (features(samples)[:, self._columns] - self._offset) / self._scale
        out = self._session.run(None, {self._input: x.astype(np.float32)})[0].astype(float)
        std = out[:, 1] if out.shape[1] > 1 else np.zeros(len(out))
        return np.clip(out[:, 0], -self.clip, self.clip), std
