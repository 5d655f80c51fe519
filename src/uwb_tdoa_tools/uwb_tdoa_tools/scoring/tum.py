"""TUM trajectory files: `stamp x y z qx qy qz qw` a line, as evo and others read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.files import write_filled


def write_tum(path: str | Path, t: np.ndarray, p: np.ndarray, q: np.ndarray) -> None:
    """Write t (n,) s, p (n, 3) m, q (n, 4) x y z w; an unknown attitude becomes the identity."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    q = np.where(np.isfinite(q), q, [0.0, 0.0, 0.0, 1.0])
    write_filled(
        path, lambda file: np.savetxt(file, np.column_stack([t, p, q]), fmt=["%.9f"] + ["%.6f"] * 7)
    )
