# SPDX-License-Identifier: Apache-2.0
"""The command line: one module for each verb, loaded cheaply; with `delivery.bake` it alone joins the core and USD.

In: words. Out: files, events for people or as JSON, an exit code.
Open `main.py` first: `VERBS` lists the verbs, and a new one is added there. `train.py` is an example of one:
`add_arguments` declares its options and `run` carries it out. `options/` holds what several verbs share.
Public: `main`, which runs a command.
"""

from .main import main

__all__ = ["main"]
