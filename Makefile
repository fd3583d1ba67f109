# Everything a newcomer needs: `make demo` and `make test` set up their own environment in .venv.
# PyBullet has ready-made wheels for Linux up to Python 3.11 only; elsewhere pip compiles it, which takes minutes.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest
# Where Python may not store what it compiled, each process compiles all tests anew: half of the time of `make test`.
unexport PYTHONDONTWRITEBYTECODE
READY := $(VENV)/.ready

.PHONY: demo test test-all test-long mutation lint lock clean

demo: $(READY)
	$(BIN)/sightline demo $(ARGS)

test: $(READY)  ## at most two minutes: at least 90 % of all tests; or just ARGS
	$(PYTEST) $(or $(ARGS),--numprocesses auto --dist worksteal)

test-all: $(READY)  ## what is longer: first what can share the machine, then what measures real time
	$(PYTEST) -m "slow and not long" --numprocesses auto --dist worksteal; shared=$$?; \
	$(PYTEST) -m "alone and not long" && exit $$shared

test-long: $(READY)  ## once before a release: the fault bench, the kit against every broken peer, all mutants
	$(PYTEST) -m long; tests=$$?; $(BIN)/python -m tests.mutation && exit $$tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $$($(PYTHON) --version) is too old: Sightline needs Python 3.11 or newer; make PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  echo "note: no Python 3.11 here, so PyBullet will be compiled for $$($(PYTHON) --version): minutes, and needs a C++ compiler. Or use docker compose."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

mutation: $(READY)
	$(BIN)/python -m tests.mutation $(ARGS)

lock:  ## pin every dependency of every extra, with hashes, for all platforms
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --output-file requirements.lock

clean:
	rm -rf $(VENV) runs
