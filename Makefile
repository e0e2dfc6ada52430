# Two commands do everything on a fresh machine: `make demo` and `make test`. Both set up .venv first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
SMOKE := runs/smoke
KERNELS := runs/kernels
UNUSED := /tests?/|/sympy/|/networkx/|/pip/|/torch/(_inductor|_dynamo|onnx|testing/_internal)/
DEMO_OPTIONS := --iterations 1000 --densify-every 50 --test-every 100 --eval --overwrite

.PHONY: demo test kernels smoke portability check clean

demo: $(VENV)/.installed
	$(BIN)/lapgs sample $(DEMO)/scene --overwrite
	$(BIN)/lapgs train $(DEMO)/scene -o $(DEMO)/baseline --levels 1 $(DEMO_OPTIONS)
	$(BIN)/lapgs train $(DEMO)/scene -o $(DEMO)/hierarchy --levels 2 $(DEMO_OPTIONS)
	$(BIN)/lapgs eval $(DEMO)/baseline
	$(BIN)/lapgs eval $(DEMO)/hierarchy
	$(BIN)/lapgs render $(DEMO)/hierarchy
	$(BIN)/lapgs report $(DEMO)/hierarchy --baseline $(DEMO)/baseline

# Kernels that most tests use are compiled once, beside mypy, instead of by both test processes. Processes of one thread
# each take less time than one process of two: most tests start others, wait for them or hardly compute. Files are tested in
# the order of tests/conftest.py, so that none of the long ones is left to one process at the end.
test: $(VENV)/.installed
	$(MAKE) -j2 --output-sync=target check kernels
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

kernels: $(VENV)/.installed
	$(BIN)/lapgs sample $(KERNELS)/scene --size 64x48 --views 3 --points 50 --overwrite
	$(BIN)/lapgs train $(KERNELS)/scene -o $(KERNELS)/run --iterations 4 --eval --rasterizer cpu --overwrite

smoke: $(VENV)/.installed
	rm -rf $(SMOKE)
	$(BIN)/lapgs bench smoke --out $(SMOKE)

# Whether tests that compare two computations hold on other processors: raster, unit and contract tests, with PyTorch and
# Numba told to compute as for narrower ones. Takes several times as long as `make test` and is no part of it.
portability: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.portability -n 2 --dist loadfile tests/raster tests/unit tests/contract

check: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# pip would compile modules in one process, and where PYTHONDONTWRITEBYTECODE is set each of the hundreds of processes that
# tests start would compile the package's. Tests of libraries, a third of their code, are left out, and so is what this package
# does not import, another quarter. A few files are for other versions of Python and do not compile.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[dev]'
	$(BIN)/python -m compileall -q -j 0 -x '$(UNUSED)' $(VENV)/lib lapgs_plugin lapgs_bench >/dev/null || true
	touch $@

clean:
	rm -rf $(VENV) $(DEMO) $(SMOKE) $(KERNELS) .mypy_cache .pytest_cache .ruff_cache
