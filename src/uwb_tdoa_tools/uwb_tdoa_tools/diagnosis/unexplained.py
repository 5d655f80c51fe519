"""Where innovations stay slow that positions and delays of anchors do not explain: a reflector or a cabinet."""

import numpy as np

FEWEST = 4  # TDOAs in a cell; noise of fewer hides what is slow
STANDS_OUT = 2.0  # ratio of an anchor's root mean square to the median of all
LEAST = 0.08  # m, root mean square of the slow innovations of that anchor
CLEAR = 2.0  # medians of the slow innovations beyond which a cell is one of those
SHORT = 1.0 / 3.0  # of a flight; what lasts for less is told by its time, else by its place


def unexplained(flights, parts):
    """A sentence on the anchor whose pairs keep the largest slow innovations, and on place or time of these; "" where none stands
    out. flights : [Flight]; parts : [TdoaResidual] of them."""
    n, rows = len(flights[0].anchors), [part.rows() for part in parts]
    kept = [some.count >= FEWEST for some in rows]
    y, pair, t = (np.concatenate([getattr(some, name)[k] for some, k in zip(rows, kept)]) for name in ("y", "series", "t"))
    place = np.concatenate([some.place[k] for some, k in zip(rows, kept)])
    number = np.repeat(np.arange(len(rows)), [k.sum() for k in kept])
    ends = np.stack(np.divmod(pair, n))
    heard = [(ends == k).any(axis=0) for k in range(n)]
    sizes = np.array([np.sqrt(np.mean(y[mine] ** 2)) if mine.any() else 0.0 for mine in heard])
    worst = int(np.argmax(sizes))
    if sizes[worst] < max(LEAST, STANDS_OUT * np.median(sizes)):
        return ""
    there = heard[worst] & (np.abs(y) > CLEAR * max(np.median(np.abs(y[heard[worst]])), 0.5 * LEAST))
    flight = int(np.bincount(number[there]).argmax())
    first, last = np.quantile(t[there & (number == flight)], [0.05, 0.95])
    spread = last - first < SHORT * np.ptp(t[number == flight])
    where = ", ".join(f"{value:.1f}" for value in np.median(place[there], axis=0))
    told = f"from {first:.0f} to {last:.0f} s of {flights[flight].name}" if spread else f"mostly where the tag is near ({where}) m"
    return (
        f"pairs of anchor {flights[0].anchors.ids[worst]} stay {100 * sizes[worst]:.0f} cm off that neither positions nor delays explain, {told}: "
        "something there may block or reflect"
    )
