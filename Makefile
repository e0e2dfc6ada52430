# Two commands do everything on a fresh machine: `make demo` and `make test`. Both set up .venv first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
SMOKE := runs/smoke
DEMO_OPTIONS := --iterations 1000 --densify-every 50 --test-every 100 --eval --overwrite

.PHONY: demo test smoke portability check clean

demo: $(VENV)/.installed
	$(BIN)/lapgs sample $(DEMO)/scene --overwrite
	$(BIN)/lapgs train $(DEMO)/scene -o $(DEMO)/baseline --levels 1 $(DEMO_OPTIONS)
	$(BIN)/lapgs train $(DEMO)/scene -o $(DEMO)/hierarchy --levels 2 $(DEMO_OPTIONS)
	$(BIN)/lapgs eval $(DEMO)/baseline
	$(BIN)/lapgs eval $(DEMO)/hierarchy
	$(BIN)/lapgs render $(DEMO)/hierarchy
	$(BIN)/lapgs report $(DEMO)/hierarchy --baseline $(DEMO)/baseline

# The smoke benchmark compiles the CPU kernels that the tests use, while mypy takes the other core. Two processes of one
# thread each take half the time of one process of two: most tests start others or hardly compute. A browser that draws in
# software needs the machine for itself.
test: $(VENV)/.installed
	$(MAKE) -j2 --output-sync=target check smoke
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile -m 'not slow and not browser'
	$(BIN)/pytest -m 'browser and not slow'

smoke: $(VENV)/.installed
	rm -rf $(SMOKE)
	$(BIN)/lapgs bench benchmarks/smoke.toml --out $(SMOKE)

# Whether tests that compare two computations hold on other processors: raster, unit and contract tests, with PyTorch and
# Numba told to compute as for narrower ones. Takes several times as long as `make test` and is no part of it.
portability: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.portability -n 2 --dist loadfile tests/raster tests/unit tests/contract

check: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) $(DEMO) $(SMOKE) .mypy_cache .pytest_cache .ruff_cache
