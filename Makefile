# Two commands do everything on a fresh Debian or Ubuntu machine with Python 3.11 or newer, root or not:
#   make demo    set up, press a probe on an inclusion, show where the pictures are
#   make test    set up, run the tests
# Set-up goes into .venv, .llvm, .ccx and .chromium of this folder, and is done once; delete them (make clean) to do it again.

PYTHON ?= python3
# Where pip looks for torch, if not in its usual index. PyPI's own torch for Linux brings CUDA along (several GB);
# TORCH_INDEX=https://download.pytorch.org/whl/cpu is the build for the CPU.
TORCH_INDEX ?=
OUT ?= out/demo

BIN := .venv/bin
READY := .venv/.ready
export MPLBACKEND := Agg

.PHONY: demo test test-all lint types bench setup clean
.DELETE_ON_ERROR:

demo: $(READY)
	$(BIN)/twin demo --out $(OUT)
	@echo "The pictures are in $(OUT); look at $(OUT)/overview.png first."

# Two processes: most tests use one core.
test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -rs

test-all: $(READY)
	$(BIN)/python tests/debian_fetch.py
	$(BIN)/python -m pytest -m "slow or not slow" --timeout 3600

lint: $(READY)
	$(BIN)/ruff check .

types: $(READY)
	$(BIN)/mypy

bench: $(READY)
	$(BIN)/python tests/debian_fetch.py
	$(BIN)/python -m pytest tests/bench -m "slow or not slow" --timeout 3600 -s

setup: $(READY)

# torch goes first and alone: with its exact version given, pip takes the build that is there.
$(READY): pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python -m pip install -q -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch==2.13.0
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install -q -c constraints.txt -e ".[test]"
	$(BIN)/python -m scenes.llvm_fetch .llvm
	$(BIN)/python tests/debian_fetch.py || echo "What needs it is skipped by make test; make test-all and make bench stop."
	@touch $@

# A fresh Debian has Python without ensurepip (it is in python3-venv): there pip comes from Debian's package of it,
# unpacked into a scratch folder, which needs no root.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "Python 3.11 or newer is needed ($(PYTHON) is not): install it, or name it: make PYTHON=python3.12" >&2; \
	  exit 1; }
	@rm -rf .venv
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv .venv; else \
	  tmp=$$(mktemp -d) && mkdir -p $$tmp/lists/partial $$tmp/cache/archives/partial && cd $$tmp && \
	  apt="apt-get -qq -o APT::Sandbox::User=$$(id -un)" && \
	  { $$apt download python3-pip-whl 2>/dev/null || { \
	    apt="$$apt -o Dir::State::lists=$$tmp/lists -o Dir::Cache=$$tmp/cache"; \
	    $$apt update; $$apt download python3-pip-whl; }; } && \
	  dpkg-deb -x python3-pip-whl_*.deb . && cd "$(CURDIR)" && \
	  $(PYTHON) -m venv --without-pip .venv && \
	  PYTHONPATH=$$(echo $$tmp/usr/share/python-wheels/pip-*.whl) $(BIN)/python -m pip install -q pip && \
	  rm -rf $$tmp; fi || { \
	  rm -rf .venv; \
	  echo "Python cannot make an environment here: sudo apt-get install python3-venv" >&2; exit 1; }

clean:
	rm -rf .venv .llvm .ccx .chromium build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
