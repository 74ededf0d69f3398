# SPDX-License-Identifier: Apache-2.0
"""How large the matrices of trained networks have become: their largest singular values.

    python benchmarks/matrix_norms.py cape.safetensors NAME=cape_long.safetensors

The product of those of a network bounds how far two near poses can drive its outputs apart.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from helpers.reports import table, write_results

from ssilk_core.network.checkpoint import load_model, network

PARTS = {"initialiser": "P", "stepper": "S", "output": "D"}  # D's parameters are those of its outputs


@torch.no_grad()
def norms(path: Path) -> tuple[int, dict[str, list[float]]]:
    """Return the iteration of a model, and the largest singular values of its matrices by network, first to last."""
    file = load_model(path)
    found: dict[str, list[float]] = {part: [] for part in PARTS.values()}
    for name, value in network(file, file.scene).named_parameters():
        part = PARTS.get(name.partition(".")[0])
        if part and value.ndim == 2:
            found[part].append(float(torch.linalg.matrix_norm(value, 2)))
    return int(file.provenance["iteration"]), found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", metavar="[NAME=]MODEL", help="files written by 'ssilk train'")
    parser.add_argument("--name", default="matrix_norms", help="of the result file (default matrix_norms)")
    parser.set_defaults(hardware="cpu")
    options = parser.parse_args()
    rows, measured = [], {}
    for text in options.models:
        name, _, path = text.rpartition("=")
        iteration, found = norms(Path(path))
        measured[name or Path(path).stem] = {"iteration": iteration, **found}
        cells = (", ".join(f"{value:.1f}" for value in values) for values in found.values())
        rows.append([name or Path(path).stem, f"{iteration}", *cells])
    write_results(options, table(("model", "iteration", *PARTS.values()), rows), measured)


if __name__ == "__main__":
    main()
