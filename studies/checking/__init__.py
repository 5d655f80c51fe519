# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Does `check` name what was put into a recording, and is it silent where nothing was?"""
