"""Values as JSON takes them."""

from __future__ import annotations

from typing import Any

import numpy as np


def as_json(value: Any) -> Any:
    """A value, or dicts and sequences of values, as JSON has them: NaN and infinity are null,
    arrays lists.
    """
    if isinstance(value, dict):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [as_json(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
