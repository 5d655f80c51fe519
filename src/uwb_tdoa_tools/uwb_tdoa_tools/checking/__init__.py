# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find mistakes of drivers, surveys and clocks in recordings, before anything else uses them."""
