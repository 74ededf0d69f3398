# SPDX-License-Identifier: Apache-2.0
"""Files that a command writes, and what suffixes say of files."""

from __future__ import annotations

from pathlib import Path

from ...files import need_not_input, need_writable

LIST, MODEL = ".toml", ".safetensors"  # suffixes of a list of garments, and of a trained one


def is_folder(output: Path) -> bool:
    """Return whether an output is a folder, there already or by its name."""
    return output.is_dir() or not output.suffix


def check_output(output: Path, *inputs: Path | str | None) -> None:
    """Check that `output` can be written and is none of the `inputs`.

    Raises:
        SsilkError: it cannot, or it is.
    """
    need_writable(output)
    need_not_input(output, *inputs)
