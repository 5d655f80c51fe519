"""What a time offset between IMU and TDOAs does, and whether the innovations tell it: the table of
docs/reliability.md.

python src/uwb_tdoa_tools/test/time_offset_table.py DATA
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

SHIFTS = np.array([-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3])  # s, added to the stamps of the IMU
WINDOWS = ((8.0, 20.0), (20.0, 32.0))  # s after the first TDOA
SETTLE = 3.0  # s at the beginning of a run that are not judged
LARGEST = 1.0  # m; a larger innovation counts as this


def measured(folder):
    """The micro-SD logs below DATA/flights, without range finders and the like."""
    for log in sorted(
        path for path in (folder / "flights").rglob("*") if path.is_file() and not path.suffix
    ):
        day = log.relative_to(folder / "flights").parts[0]
        flight = read_flight(log, folder / "surveys" / f"anchor_{day}.txt")
        yield replace(flight, height=None, pressure=None, velocity=None)


def simulated():
    """Flights without systematic errors, at 2 m/s."""
    for seed in range(6):
        yield simulate(
            SimulationConfig(seed=seed, duration=40.0, speed=2.0, yaw="rotating", yaw_rate=0.4)
        )


def cut(flight, low, high):
    """The part of a Flight between two times after its first TDOA."""
    begin = flight.tdoa.t[0]

    def part(stream):
        inside = (stream.t >= begin + low) & (stream.t < begin + high)
        return type(stream)(*(column[inside] for column in vars(stream).values()))

    return replace(flight, imu=part(flight.imu), tdoa=part(flight.tdoa))


def run(flight, shift):
    """(mean squared innovation m^2, RMSE m) of a Flight with shifted IMU."""
    result = run_offline(replace(flight, imu=replace(flight.imu, t=flight.imu.t + shift)))
    r, odometry = result.residuals, result.odometry
    used = (r.t > r.t[0] + SETTLE) & np.isfinite(r.innovation)
    innovation = np.mean(np.clip(r.innovation[used], -LARGEST, LARGEST) ** 2)
    truth = flight.truth
    t = odometry.t[
        (odometry.t > max(odometry.t[0] + SETTLE, truth.t[0])) & (odometry.t < truth.t[-1])
    ]
    p = np.stack([np.interp(t, odometry.t, odometry.p[:, k]) for k in range(3)], axis=1)
    error = np.linalg.norm(p - position_at(t, truth), axis=1)
    return innovation, float(np.sqrt(np.nanmean(error**2)))


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("data", type=Path)
    folder = arguments.parse_args().data
    for title, flights in (("simulated", simulated()), ("measured", measured(folder))):
        rmse, best, wholes = [], [], []
        for flight in flights:
            whole = [run(flight, shift) for shift in SHIFTS]
            rmse.append([error for _, error in whole])
            wholes.append(SHIFTS[np.argmin([cost for cost, _ in whole])])
            for window in WINDOWS:
                part = cut(flight, *window)
                if part.tdoa.t[-1] - part.tdoa.t[0] > 10.0:
                    best.append(SHIFTS[np.argmin([run(part, shift)[0] for shift in SHIFTS])])
        print(f"{title}: {len(rmse)} flights")
        print("  IMU shifted by, s     " + "  ".join(f"{shift:+.1f}" for shift in SHIFTS))
        print(
            "  mean RMSE, m          "
            + "  ".join(f"{value:.2f}" for value in np.mean(rmse, axis=0))
        )
        for what, shifts in (("whole flights", wholes), ("12 s", best)):
            counts = [int(np.sum(np.isclose(shifts, shift))) for shift in SHIFTS]
            print(
                f"  least innovations at  {'  '.join(f'{count:4d}' for count in counts)}   ({what})"
            )


if __name__ == "__main__":
    main()
