"""What a tag costs by how many anchors are installed, of which it hears the same 20: the table of
docs/warehouse.md.

python src/uwb_tdoa_ekf/test/warehouse_cost.py
"""

from pathlib import Path
import tempfile
import time
import tracemalloc

from halls import Hall, fly
import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.stream_watch import StreamWatch

INSTALLED = 20, 100, 1000, 10_000
SPACING = 8.0  # m
TURN = 0.005  # s of stamps that a node takes at once


def installation(n):
    """n Anchors, the first 20 of which are the same for every n; the others are out of reach of a
    tag among these.
    """
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(5) * SPACING, np.arange(4) * SPACING)
    near = np.column_stack([x.ravel(), y.ravel(), rng.uniform(0.5, 6.0, 20)])
    beyond = np.arange(n - 20)
    far = np.column_stack(
        [200.0 + SPACING * (beyond % 125), SPACING * (beyond // 125), np.full(len(beyond), 4.0)]
    )
    return Anchors.from_positions(np.concatenate([near, far]))


class Tag:
    """Both nodes of a tag, without ROS: correction, filter with its monitor, and watch over the
    streams.
    """

    def __init__(self, anchors):
        self.corrector, self.estimator, self.watch = (
            Corrector(anchors),
            Estimator(anchors),
            StreamWatch(anchors, 0.25),
        )

    def take(self, flight):
        """Take a Flight, turn by turn. Returns the Odometry of each."""
        imu, d, out, next_look = flight.imu, flight.tdoa, [], 1.0
        edges = np.arange(0.0, d.t[-1] + TURN, TURN)
        of_imu, of_tdoa = np.searchsorted(imu.t, edges), np.searchsorted(d.t, edges)
        rows = flight.anchors.index
        for k, end in enumerate(edges[1:]):
            i, j = slice(of_imu[k], of_imu[k + 1]), slice(of_tdoa[k], of_tdoa[k + 1])
            self.estimator.add_imu(imu.t[i], imu.gyro[i], imu.accel[i])
            self.watch.add_imu(imu.t[i], imu.t[i], imu.gyro[i], imu.accel[i])
            if j.stop > j.start:
                corrected = self.corrector.correct(
                    d.t[j], rows(d.a[j]), rows(d.b[j]), d.d[j]
                ).corrected
                self.estimator.add_tdoa(d.t[j], d.a[j], d.b[j], corrected)
                self.watch.add_tdoa(d.t[j], d.t[j], d.a[j], d.b[j], d.d[j])
            out.append(self.estimator.advance()[0])
            if end >= next_look:
                next_look += 1.0
                self.watch.findings()
        return out


def flight_among(anchors, duration):
    """Flight of a tag that walks among the first 20 of Anchors and hears these alone, the same
    whatever the others are.
    """
    few = Hall(anchors.only(np.arange(20)), (4.0 * SPACING, 3.0 * SPACING), 100.0, np.zeros(20))
    return fly(few, 0, duration)


def cost(n, duration=30.0, repeat=3):
    """(share of a core, memory of a tag, bytes, start from a file, s of processor time, the last
    Odometry) among n installed anchors.
    """
    anchors, shares = installation(n), []
    with tempfile.TemporaryDirectory() as folder:
        anchors.to_yaml(path := Path(folder) / "anchors.yaml")
        began = time.process_time()
        Tag(Anchors.from_yaml(path))
        start = time.process_time() - began
    flight = flight_among(anchors, duration)
    for _ in range(repeat):
        tag = Tag(anchors)
        began = time.process_time()
        odometry = tag.take(flight)
        shares.append((time.process_time() - began) / duration)
    tracemalloc.start()
    tag = Tag(anchors)
    tag.take(flight_among(anchors, 5.0))
    memory = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return min(shares), memory, start, odometry[-1]


if __name__ == "__main__":
    cost(20, 5.0, 1)  # what is compiled, is
    print(
        "| installed | of a core | over that of 20 | memory of a tag, MB | start, s "
        "|\n|---:|---:|---:|---:|---:|"
    )
    for n in INSTALLED:
        share, memory, start, _ = cost(n)
        if n == INSTALLED[0]:
            least = share
        print(
            f"| {n} | {share:.4f} | {share / least:.2f} | {memory / 1e6:.1f} | {start:.2f} |",
            flush=True,
        )
