# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev study`.

Python looks for modules beside this file, and not in the present folder as `python -m studies`
would.
"""

import sys

from uwb_tdoa_bias.common.executable import executable

sys.exit(executable("studies.__main__")())
