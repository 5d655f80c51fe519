# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a diagnosis for people: verdict, advice, worth of each effect, undetermined parameters.

`page.py` writes one HTML page. The text for the screen and diagnosis.json (`output.py`) have the
same content.
"""
