# make demo: the whole job on the embedded scene.   make test: the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# Two processes share two cores.
test test-all test-types: export OMP_NUM_THREADS = 1

.PHONY: demo test test-all test-types lint bench clean

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,lint]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/python train/fit.py --config-name=demo

test: $(INSTALLED)
	$(BIN)/python -m pytest -n 2

test-all: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 -m ''

# Shape annotations checked at run time, on the tests that pass tensors about.
test-types: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 --jaxtyping-packages=prt_torch,beartype.beartype \
	  tests/test_sphere.py tests/test_sh.py tests/test_baking.py tests/test_hemisphere.py \
	  tests/test_cpca.py tests/test_fitting.py tests/test_relight.py tests/test_glossy.py

lint: $(INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(INSTALLED)
	$(BIN)/python eval/benchmark.py
	$(BIN)/python eval/liu2004.py --supersampling=2
	$(BIN)/python eval/wang2004.py
	$(BIN)/python eval/tsai2006.py --supersampling=2

clean:
	rm -rf $(VENV) .cache runs
