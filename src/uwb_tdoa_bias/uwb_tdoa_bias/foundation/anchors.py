"""Anchors: where the fixed radios are and which way they point."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from .errors import InputError


@dataclass(frozen=True)
class Anchors:
    """The fixed radios of one installation, in one world frame.

    Attributes
    ----------
    ids : (N,) int array, each id once
    positions : (N, 3) float array, antenna centres, metres
    orientations : (N, 4) float array, quaternions x y z w, antenna to world, normalised; a row of NaN where the
        orientation was not surveyed
    frame : name of the world frame
    """

    ids: np.ndarray
    positions: np.ndarray
    orientations: np.ndarray
    frame: str = "map"

    def __post_init__(self):
        ids = np.array(self.ids, dtype=np.int64).reshape(-1)
        positions = np.array(self.positions, dtype=float, order="C")
        orientations = np.array(self.orientations, dtype=float)
        n = len(ids)
        if n == 0:
            raise InputError("anchors: the list is empty; give at least two anchors.")
        if positions.shape != (n, 3) or orientations.shape != (n, 4):
            raise InputError(
                f"anchors: {n} ids need positions of shape ({n}, 3) and orientations of shape ({n}, 4), "
                f"got {positions.shape} and {orientations.shape}."
            )
        values, counts = np.unique(ids, return_counts=True)
        if (counts > 1).any():
            raise InputError(f"anchors: id {values[counts > 1][0]} is given twice; every anchor needs its own id.")
        if (ids < 0).any() or (ids > 65535).any():
            raise InputError(f"anchors: id {ids[(ids < 0) | (ids > 65535)][0]} is outside 0 ... 65535.")
        bad = ~np.isfinite(positions).all(axis=1)
        if bad.any():
            raise InputError(f"anchors: position of anchor {ids[bad][0]} is {positions[bad][0]}; it must be finite metres.")
        norm = np.linalg.norm(orientations, axis=1, keepdims=True)
        orientations = np.where(norm > 1e-9, orientations / np.where(norm > 1e-9, norm, 1.0), np.nan)
        for name, value in (("ids", ids), ("positions", positions), ("orientations", orientations)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_rows", {i: row for row, i in enumerate(ids.tolist())})

    def __len__(self):
        return len(self.ids)

    def row(self, anchor):
        """Row of one id, -1 if it is unknown."""
        return self._rows.get(anchor, -1)

    def index(self, ids):
        """Rows of the given ids: int array of the shape of `ids`, -1 where an id is unknown."""
        ids = np.asarray(ids)
        order = np.argsort(self.ids)
        at = np.clip(np.searchsorted(self.ids[order], ids), 0, len(self.ids) - 1)
        return np.where(self.ids[order][at] == ids, order[at], -1)

    @classmethod
    def from_positions(cls, positions, ids=None, frame="map"):
        """Anchors at (N, 3) positions in metres whose orientations are not known. Default ids: 0 ... N-1."""
        positions = np.asarray(positions, dtype=float)
        ids = np.arange(len(positions)) if ids is None else ids
        return cls(ids, positions, np.full((len(positions), 4), np.nan), frame)

    @classmethod
    def from_message(cls, message):
        """Anchors of a uwb_tdoa_msgs/AnchorArray, of rclpy or out of a bag. An orientation of (0, 0, 0, 0) is not
        known; without a frame_id the frame is "map". Raises InputError."""
        poses = [anchor.pose for anchor in message.anchors]
        return cls(
            [anchor.id for anchor in message.anchors],
            np.array([_numbers(pose.position, "xyz") for pose in poses]).reshape(-1, 3),
            np.array([_numbers(pose.orientation, "xyzw") for pose in poses]).reshape(-1, 4),
            message.header.frame_id or "map",
        )

    @classmethod
    def from_yaml(cls, path):
        """Read `frame` and `anchors: {id: {position: [x, y, z], orientation: [x, y, z, w]}}`; raises InputError."""
        path = Path(path)
        try:
            content = yaml.safe_load(path.read_text())
        except (OSError, yaml.YAMLError) as error:
            raise InputError(f"{path}: cannot be read as YAML ({error}).") from error
        if not isinstance(content, dict) or not isinstance(content.get("anchors"), dict) or not content["anchors"]:
            raise InputError(f"{path}: expected a mapping 'anchors' of id to position and orientation.")
        ids, positions, orientations = [], [], []
        for key, entry in content["anchors"].items():
            try:
                ids.append(int(key))
                positions.append([float(value) for value in entry["position"]])
                orientations.append([float(value) for value in entry.get("orientation") or [np.nan] * 4])
                if len(positions[-1]) != 3 or len(orientations[-1]) != 4:
                    raise ValueError("wrong number of values")
            except (TypeError, ValueError, KeyError, AttributeError) as error:
                raise InputError(
                    f"{path}: anchors: {key}: {entry!r} is not an anchor; write it as "
                    "'0: {position: [x, y, z], orientation: [x, y, z, w]}' (orientation optional)."
                ) from error
        return cls(ids, positions, orientations, str(content.get("frame", "map")))

    def to_yaml(self, path):
        """Write what `from_yaml` reads."""
        entries = {}
        for i, p, q in zip(self.ids.tolist(), self.positions.tolist(), self.orientations.tolist()):
            entries[i] = {"position": p, **({"orientation": q} if np.isfinite(q).all() else {})}
        text = yaml.safe_dump({"frame": self.frame, "anchors": entries}, sort_keys=False, default_flow_style=None)
        Path(path).write_text(text)


def _numbers(message, names):
    return [getattr(message, name) for name in names]
