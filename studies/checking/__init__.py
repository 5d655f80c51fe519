# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Does `check` name mistakes put into recordings, and report nothing in sound recordings?"""
