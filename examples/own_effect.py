"""An effect of your own: TDOAs err with the side from which an anchor sees the tag.

python examples/own_effect.py
"""

import numpy as np
import uwb_tdoa as uwb


@uwb.effect
class SideDelay(uwb.ArrivalEffect):
    """Delay an arrival by cosine * cos(azimuth) + sine * sin(azimuth) of the tag at the anchor."""

    row = uwb.Row(
        name="side_delay",
        unit="m",
        bound=2.0,
        negligible=0.02,
        prior_std=0.2,
        example="cosine",
        physics="the housing of the anchors delays signals from one side",
        reference="an example",
    )

    @classmethod
    def groups(cls, anchors, pairs):
        return [("cosine", "sine")]

    def delay_regressors(self, samples, rows, keys):
        towards = np.tile(samples.p, (len(rows) // len(samples.p), 1))
        towards = towards - samples.anchors.positions[rows]
        azimuth = np.arctan2(towards[:, 1], towards[:, 0])
        return np.column_stack(
            [np.cos(azimuth) if k == "cosine" else np.sin(azimuth) for k in keys]
        )


if __name__ == "__main__":
    flight = uwb.simulate(duration=25.0, seed=3, imu_rate=100.0, bias=False, multipath=False)
    hidden = SideDelay({"cosine": 0.3, "sine": -0.2})
    diagnosis = uwb.diagnose([hidden.inject(flight)])
    for found in diagnosis.effects:
        values = {key: round(value, 3) for key, value in found.values.items()}
        print(f"hidden {hidden.values}, found {found.name} {values}")
