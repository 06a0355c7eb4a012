# make demo    train, evaluate and record a plan-conditioned policy on MT10
# make test    the fast tests, about five minutes on two cores; JOBS=4 for four processes instead of two
# make test-all    the fast tests and the slow ones
# make check   ruff and mypy
# make bench   what everything costs, against rivals (benchmarks/results/performance.md)
# make docs    the documentation as a site, in site/
# make setup   the environment alone (.venv)
# make test-python PYTHON=python3.13   the suite under another interpreter, in an environment of its own
#
# On Linux pip's own torch brings gigabytes of CUDA. For the small one, or for another CUDA, name PyTorch's index when the
# environment is first made, as https://pytorch.org/get-started/locally/ shows it for your machine:
#     make setup TORCH_INDEX=ADDRESS
PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
TORCH_INDEX ?=
BIN := $(VENV)/bin
READY := $(VENV)/.ready

PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-slow test-all test-python check docs setup bench robosuite clean
demo: $(READY)
	$(BIN)/lw-torchrl demo
test: $(READY)
	$(PYTEST) -m 'not slow'
test-slow: robosuite
	$(PYTEST) -m slow
test-all: test test-slow
test-python:
	$(MAKE) test-all VENV=.venv-$(notdir $(PYTHON)) PYTHON=$(PYTHON)
check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
setup: $(READY)
# Without what robosuite 1.5.2 asks for, numpy below 2 and keyboards that are compiled: its arms need neither. Where it
# cannot be had, its tests are skipped.
robosuite: $(READY)
	-$(BIN)/python -m pip install --disable-pip-version-check --no-deps robosuite==1.5.2 opencv-python-headless==5.0.0.93 termcolor==3.3.0
bench: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks

# pip, not uv: constraints.txt pins torch, and pip is what honours the wheel an environment provides.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "lw_torchrl needs Python 3.11 or newer; this is %s. Try: make PYTHON=python3.11" % sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check $(addprefix --extra-index-url ,$(TORCH_INDEX)) -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv .venv-* runs site
