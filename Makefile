# `make demo` films a cape that ships trained, then trains, bakes, verifies and films a draft. `make test` runs all
# checks but the tests that take longest, which `make test-slow` runs.
# Both create the environment they need in .venv; only Python 3.11 (or later) and make must be there.
# `make extension` packs the Blender extension, with ssilk in it, into dist/; `make test-blender` tests it
# in Blender's Python module. Both need Python 3.11 and download some 370 MB into .venv-blender.
# `make docs` writes the documents as a site into build/site.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BLENDER_VENV := .venv-blender
BLENDER_STAMP := $(BLENDER_VENV)/.installed
# Bytecode is kept, also where the environment forbids it: it is compiled where it is first used, and not for all
# packages at once, which takes half of an installation.
export PYTHONDONTWRITEBYTECODE :=
BLENDER_TOOL = $(wildcard $(BLENDER_VENV)/lib/python3.11/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py)

.PHONY: demo test test-slow pytest lint docs extension test-blender clean

demo: $(STAMP)
	$(BIN)/ssilk demo --output demo_out

# Both at once: mypy has one process, and the last files of tests leave cores idle.
test: $(STAMP)
	$(MAKE) -j 2 lint pytest

# One process more than there are cores, since many tests wait for processes of their own; each of them computes with
# one thread. Files begin in the order of tests/conftest.py.
# The first files compile nearly all loops, two of them beside the other check, and numba keeps these for the rest:
# processes that came to a loop at once would each compile it. What pytest makes of the assertions in all files takes
# longer than to read it: one process does so before that. What it cannot collect, the others tell.
WORKERS = $(shell $(PYTHON) -c "import os; print(os.cpu_count() + 1)")
FIRST := $(addprefix tests/core/,physics/test_loops.py physics/test_simulate_solver.py physics/test_clearing.py \
	network/test_runtime.py network/test_latent_solver.py)
pytest: export OMP_NUM_THREADS := 1
pytest: $(STAMP)
	$(BIN)/python -m pytest --collect-only -qq > /dev/null || true
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist loadfile --no-loadscope-reorder $(FIRST)
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile --no-loadscope-reorder \
		$(addprefix --ignore=,$(FIRST))

# The tests that take longest, which `make test` leaves out.
test-slow: export OMP_NUM_THREADS := 1
test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow -n $(WORKERS) --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy

# -W: a broken link, or a document that the contents do not name, is an error.
docs: $(STAMP)
	$(BIN)/python -m sphinx -W -q -c docs -d build/doctrees . build/site
	@echo "open build/site/index.html"

extension: $(BLENDER_STAMP)
	mkdir -p dist
	$(BLENDER_VENV)/bin/python tools/stage_extension.py build/extension
	$(BLENDER_VENV)/bin/python $(BLENDER_TOOL) build --source-dir build/extension --output-dir dist

test-blender: $(STAMP) $(BLENDER_STAMP)
	$(BLENDER_VENV)/bin/python -m pytest tests/blender

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile torch -c constraints.txt
	$(BIN)/python -m pip install --quiet --no-compile -e '.[dev]' -c constraints.txt
	touch $(STAMP)

$(BLENDER_STAMP): constraints.txt
	python3.11 -m venv $(BLENDER_VENV)
	$(BLENDER_VENV)/bin/python -m pip install --quiet bpy==5.0.1 pytest -c constraints.txt
	touch $(BLENDER_STAMP)

clean:
	rm -rf $(VENV) $(BLENDER_VENV) demo_out build ssilk.egg-info
