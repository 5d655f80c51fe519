# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from hypothesis import given, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.robust_loss import (
    CAUCHY,
    GEMAN_MCCLURE,
    HUBER,
    geman_mcclure_loss,
    weight,
)

# Textbook losses (MacTavish and Barfoot 2015, table I). All approach e^2 / 2 near zero.
RHO = {
    GEMAN_MCCLURE: lambda e, c: 0.5 * e**2 / (1.0 + (e / c) ** 2),
    HUBER: lambda e, c: 0.5 * e**2 if abs(e) <= c else c * (abs(e) - 0.5 * c),
    CAUCHY: lambda e, c: 0.5 * c**2 * np.log1p((e / c) ** 2),
}


@given(st.sampled_from(list(RHO)), st.floats(-30.0, 30.0), st.floats(0.5, 5.0))
def test_weight_is_the_slope_of_the_textbook_loss(loss, e, scale):
    # The second condition excludes the corner of the slope of Huber's loss.
    if abs(e) < 0.01 or abs(abs(e) - scale) < 1e-3:
        return
    slope = (RHO[loss](e + 1e-5, scale) - RHO[loss](e - 1e-5, scale)) / 2e-5
    assert weight(loss, e, scale) == pytest.approx(slope / e, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("loss", RHO)
def test_weight_has_its_limits(loss):
    assert weight(loss, 0.0, 2.0) == 1.0 and weight(loss, 1e300, 2.0) == 0.0
    # The weight of an outlier falls with e^-4, e^-1 or e^-2.
    power = {GEMAN_MCCLURE: 4, HUBER: 1, CAUCHY: 2}[loss]
    assert weight(loss, 2e4, 2.0) / weight(loss, 2e5, 2.0) == pytest.approx(10.0**power, rel=1e-3)


@given(st.floats(-30.0, 30.0), st.floats(0.5, 5.0))
def test_geman_mcclure_loss_is_the_textbook_one_over_its_limit(e, scale):
    assert geman_mcclure_loss(e, scale) == pytest.approx(
        2.0 * RHO[GEMAN_MCCLURE](e, scale) / scale**2, abs=1e-12
    )
