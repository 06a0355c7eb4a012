# make demo    train, evaluate and record a plan-conditioned policy on MT10
# make test    the whole test suite, warnings as errors
# make check   ruff and mypy
# make bench   what everything costs, against rivals (docs/performance.md)
# make setup   the environment alone (.venv)
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: demo test check setup bench clean
demo: $(READY)
	$(BIN)/lw-torchrl demo
test: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/pytest
check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
setup: $(READY)
bench: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks

# pip, not uv: constraints.txt pins torch, and pip is what honours the wheel an environment provides.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "lw_torchrl needs Python 3.11 or newer; this is %s. Try: make PYTHON=python3.11" % sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv runs
