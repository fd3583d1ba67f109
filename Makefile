# Everything a newcomer needs: `make demo` and `make test` set up their own environment in .venv.
# PyBullet has ready-made wheels for Linux up to Python 3.11 only; elsewhere environment.py compiles it once.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest
# Where Python may not store compiled files, each process compiles all tests again: half of the time of `make test`.
unexport PYTHONDONTWRITEBYTECODE
# Two goals run one after the other, also with -j: both change the environment, and both need the whole machine.
.NOTPARALLEL:
ifneq ($(and $(ARGS),$(word 2,$(MAKECMDGOALS))),)
$(error ARGS is for one goal, but there are $(words $(MAKECMDGOALS)) ($(MAKECMDGOALS)): run `make` once for each)
endif

.PHONY: demo test test-all test-long mutation lint docs release lock clean python demo-environment test-environment

demo: demo-environment
	$(BIN)/sightline demo $(ARGS)

test: test-environment  ## at most two minutes: 89 % of all tests; or just ARGS
	$(PYTEST) $(or $(ARGS),--numprocesses auto --dist worksteal)

# Tests that no clock decides take only the processor time that the others leave; their output comes after theirs.
test-all: test-environment  ## what is longer: first what can share the machine, then what measures real time
	log=$$(mktemp); nice -n 19 $(PYTEST) -m "slow and computes and not alone and not long" --numprocesses auto \
	  --dist worksteal >"$$log" 2>&1 & computing=$$!; trap "kill $$computing; exit 130" INT TERM; \
	$(PYTEST) -m "slow and not computes and not alone and not long" --numprocesses auto --dist worksteal; shared=$$?; \
	wait $$computing; computed=$$?; cat "$$log"; rm "$$log"; \
	$(PYTEST) -m "alone and not long" && exit $$((shared | computed))

test-long: test-environment  ## once before a release: the fault bench, the exploration, the kit against every broken peer, all mutants
	$(PYTEST) -m "long and not alone" --numprocesses auto --dist worksteal; shared=$$?; \
	$(PYTEST) -m "long and alone"; alone=$$?; \
	$(MAKE) --no-print-directory mutation && exit $$((shared | alone))

lint: test-environment
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: test-environment  ## the docs site in site/, with strict links; its generated pages must be those of the code
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements-docs.lock
	$(BIN)/python -m docs.make.reference --check
	$(BIN)/zensical build --strict --clean

release: python  ## before a release: the SBOM (CycloneDX) in dist/; an audit, which also fails where it cannot look up a package
	$(PYTHON) -m venv $(VENV)-release
	$(VENV)-release/bin/python -m pip install --quiet cyclonedx-bom==7.5.0 pip-audit==2.10.1
	mkdir -p dist
	$(VENV)-release/bin/cyclonedx-py requirements requirements.lock --pyproject pyproject.toml \
	  --output-reproducible --output-file dist/sbom.cdx.json
	$(VENV)-release/bin/pip-audit --disable-pip --require-hashes --strict --requirement requirements.lock

python:
	@[ -n "$(PYTHON)" ] || { echo "error: no Python found: install Python 3.11, or pass PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "error: $(PYTHON) ($$($(PYTHON) --version 2>&1 | tail -n 1)) cannot run Sightline, which needs Python 3.11 or newer:" \
	    "pass PYTHON=/path/to/python3.11"; exit 2; }

demo-environment test-environment: %-environment: python
	@$(PYTHON) environment.py $* $(VENV)

mutation: test-environment
	$(BIN)/python -m tests.mutation $(ARGS)

lock:  ## pin every dependency of every extra, with hashes, for all platforms; then the parts for the demo and the docs
	@command -v uv >/dev/null || { echo "error: no uv to make the locks with: pip install uv"; exit 2; }
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --output-file requirements.lock
	uv pip compile pyproject.toml --extra demo --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --constraints requirements.lock --output-file requirements-demo.lock
	uv pip compile pyproject.toml --extra docs --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --constraints requirements.lock --output-file requirements-docs.lock

clean:
	rm -rf $(VENV) runs
