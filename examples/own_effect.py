# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""An effect of your own: an anchor hears the tag late through two sides of its housing.

python examples/own_effect.py
"""

import numpy as np
import uwb_tdoa as uwb


@uwb.effect
class SideDelay(uwb.ArrivalEffect):
    """Delay an arrival by cosine * cos(2 a) + sine * sin(2 a), with the azimuth a of the tag."""

    row = uwb.Row(
        name="side_delay",
        unit="m",
        bound=2.0,
        negligible=0.02,
        prior_std=0.2,
        example="cosine",
        physics="the housing of the anchors delays signals from two opposite sides",
        reference="an example",
    )

    @classmethod
    def groups(cls, anchors, pairs):
        return [("cosine", "sine")]

    def delay_regressors(self, samples, rows, keys):
        towards = np.tile(samples.p, (len(rows) // len(samples.p), 1))
        towards = towards - samples.anchors.positions[rows]
        angle = 2.0 * np.arctan2(towards[:, 1], towards[:, 0])
        return np.column_stack([np.cos(angle) if k == "cosine" else np.sin(angle) for k in keys])


if __name__ == "__main__":
    flight = uwb.simulate(duration=25.0, seed=3, imu_rate=100.0, bias=False, multipath=False)
    hidden = SideDelay({"cosine": 0.1, "sine": -0.07})
    diagnosis = uwb.diagnose([hidden.inject(flight)])
    for found in diagnosis.effects:
        values = {key: round(value, 3) for key, value in found.values.items()}
        print(f"hidden {hidden.values}, found {found.name} {values}")
