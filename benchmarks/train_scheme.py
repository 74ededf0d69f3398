# SPDX-License-Identifier: Apache-2.0
"""Run 'ssilk train' with the schemes that the paper compares its own with.

python benchmarks/train_scheme.py STAGE --motions FOLDER --valid FOLDER -o direct.safetensors --set scheme=direct
"""

from __future__ import annotations

import sys

from helpers import paper_schemes

from ssilk_core.cli import main

if __name__ == "__main__":
    paper_schemes.register()
    raise SystemExit(main(["train", *sys.argv[1:]]))
