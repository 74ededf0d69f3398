# SPDX-License-Identifier: Apache-2.0
"""`python -m ssilk_core` is the command line."""

import sys

from .cli import main

sys.exit(main())
