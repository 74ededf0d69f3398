# SPDX-License-Identifier: Apache-2.0
"""Fuzz the reader of model files, guided by coverage: any bytes are a model, or one sentence.

    pip install atheris
    python benchmarks/fuzz_model.py CORPUS model.safetensors -max_total_time=600

CORPUS is a folder that the fuzzer keeps what reached new code in; the model is what it starts from, without its
checksum, which would refuse any change at once. The options are those of libFuzzer. What it finds belongs into
tests/end_to_end/test_hostile.py.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

with atheris.instrument_imports(include=["ssilk_core"]):
    from ssilk_core.errors import SsilkError
    from ssilk_core.network.checkpoint import load_model

SCRATCH = Path(tempfile.mkdtemp()) / "model.safetensors"


def one_input(data: bytes) -> None:
    """Read bytes as a model; anything but a model or `SsilkError` is a find."""
    SCRATCH.write_bytes(data)
    try:
        load_model(SCRATCH)
    except SsilkError:
        return


def main() -> None:
    """Fuzz until the time is over or something is found."""
    corpus, model, *options = sys.argv[1:]
    Path(corpus).mkdir(parents=True, exist_ok=True)
    with safe_open(model, "numpy") as stream:
        words = {"ssilk": stream.metadata()["ssilk"]}
    save_file(load_file(model), Path(corpus) / "model", words)
    atheris.Setup([sys.argv[0], corpus, *options], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
