"""Labels of anchors in pictures."""

import numpy as np

TOGETHER = 0.35  # m; anchors that are nearer to each other in a picture have one label


def labels(ids, places):
    """Yield (label, (2,) m) of ids at places (n, 2) m; those that would cover each other have one."""
    left = list(range(len(ids)))
    while left:
        here = [k for k in left if np.linalg.norm(places[k] - places[left[0]]) < TOGETHER]
        yield ", ".join(str(ids[k]) for k in here), places[here].max(axis=0)
        left = [k for k in left if k not in here]
