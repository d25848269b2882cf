# A fresh checkout needs Python >= 3.11 with venv and pip, and make; nothing else of the system.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
# Two more than processors: tests of drivers wait for time-outs.
WORKERS ?= $(shell $(PYTHON) -c 'import os; print((os.cpu_count() or 1) + 2)')
# Bytecode is kept, also where the environment says otherwise: workers, and commands that tests start, share it.
export PYTHONDONTWRITEBYTECODE :=
# What Debian's gir1.2-aravis-0.8 brings: GigE Vision and USB3 Vision.
ARAVIS  := $(wildcard /usr/lib/*/girepository-1.0/Aravis-0.8.typelib)

.PHONY: demo test tests lint examples docs rig slow bench bench-compare aravis clean

demo: aravis
	$(BIN)/reseau demo --out $(OUT)

# Types are checked while tests wait. A file stays with one worker: what it computes once, and compiles, is not computed
# twice.
test: $(VENV)/.test
	$(MAKE) -j 2 lint tests

tests: $(VENV)/.test
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site: guides, mathematics, decisions and the reference of the API, in build/docs; warnings are errors.
docs: $(VENV)/.docs examples
	rm -rf docs/api/generated docs/examples
	$(BIN)/python -m sphinx -b html -W --keep-going -q -d build/doctrees docs build/docs
	@echo build/docs/index.html

# The examples of the reference.
examples: $(VENV)/.test
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --doctest-modules src drivers sims

rig: $(VENV)/.test
	$(BIN)/python -m tests.rig.machine

# All comparisons with peers that are installed; an interrupted run continues where it ended. The tables and
# pictures of docs/benchmarks/peers.md are written. AquaCal asks for an OpenCV before 5, and works with that, too.
bench: $(VENV)/.test
	@$(PIP) -e '.[peers]' || echo "without peers of PyPI"
	@$(PIP) natsort pandas pyyaml requests tqdm && $(PIP) --no-deps aquacal || echo "without AquaCal"
	$(BIN)/python benchmarks/all.py --write

# Time, memory and accuracy of the main jobs against what was recorded; see benchmarks/history.py.
bench-compare: $(VENV)/.test
	$(BIN)/python benchmarks/history.py compare

slow: $(VENV)/.test
	$(BIN)/python -m pytest -n $(WORKERS) -m slow

# Where Aravis is installed: PyGObject, which Python uses it with (built from source). All else works without.
aravis: $(VENV)/.core
ifneq ($(ARAVIS),)
	@$(BIN)/python -c 'import gi' 2>/dev/null || $(PIP) -e '.[aravis]' >$(VENV)/aravis.log 2>&1 \
	|| echo "without GigE Vision: PyGObject could not be installed (apt-get install libgirepository1.0-dev" \
	"libcairo2-dev pkg-config gcc python3-dev; see $(VENV)/aravis.log)"
endif

clean:
	rm -rf $(VENV) $(OUT) build dist

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "reseau needs Python 3.11 or newer"'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -e '.[bench]'
	$(BIN)/reseau compile demo
	touch $@

$(VENV)/.test: $(VENV)/.core
	$(PIP) -e '.[test]'
	touch $@

$(VENV)/.docs: $(VENV)/.core
	$(PIP) -e '.[docs]'
	touch $@
