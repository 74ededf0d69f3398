#!/usr/bin/env bash
# torch 2.13.0: the first optimiser of a process imports the compiler, though nothing is compiled.
#
# `torch.optim.Adam([parameter])` imports torch._dynamo and what it needs: 804 modules, which took 1.2 s on two idle
# cores and 3.5 s on busy ones. `import torch` alone does not import it, and neither does a step of gradient
# descent by hand. A program that starts a process for each short training pays this each time; a fork server that has
# imported torch._dynamo before pays it once.
#
# Seen: "before: False", "after: True", and more than 500 new modules. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet torch==2.13.0 numpy==1.26.4
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import time

import torch

parameter = torch.nn.Parameter(torch.zeros(3))
before, count, began = "torch._dynamo" in sys.modules, len(sys.modules), time.perf_counter()
torch.optim.Adam([parameter])
seconds, after, more = time.perf_counter() - began, "torch._dynamo" in sys.modules, len(sys.modules) - count
print(f"torch {torch.__version__}; before: {before}; after: {after}; {more} new modules; {seconds:.1f} s")
if before or not after or more < 500:
    sys.exit("this has changed")
PYTHON
