# What is installed where: Debian packages by docker/install-system-packages.sh (root or sudo only if
# one is missing), Python packages from the lock into .venv. Stamp files in .venv keep it quick when
# nothing changed; remove .venv to start afresh.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# How many tests run at once.
JOBS ?= auto

# Whoever has the development packages keeps them up to date, also for the demo.
ENVIRONMENT := $(if $(wildcard $(VENV)/.python-dev),$(VENV)/.python-dev,$(VENV)/.python-run)

# What one process has compiled the next one reads: the tests start dozens, and each worker imports everything.
unexport PYTHONDONTWRITEBYTECODE

.NOTPARALLEL:
.PHONY: help demo test lint format bench lock

help:
	@echo "make demo    install what is missing and open the application with the simulated rig"
	@echo "make test    install what the tests need and run all of them"
	@echo "make lint    format, style, types, import contracts, lock files, container files"
	@echo "make format  let ruff mend what it can"
	@echo "make bench   run the benchmarks"
	@echo "make lock    write the lock files after a change in pyproject.toml (OPTIONS=--upgrade: newest versions)"

demo: $(VENV)/.system-run $(ENVIRONMENT) $(VENV)/.kernels
	$(BIN)/unglare demo $(OPTIONS)

# worksteal: tests of a file stay together, so that what they share is made once, not once per process.
# The browser's tests run by themselves: its pictures are drawn by the processor, which others would keep busy.
test: $(VENV)/.system-run $(VENV)/.system-test $(VENV)/.python-dev $(VENV)/.kernels
	$(BIN)/pytest -m "not bench and not ui" --numprocesses=$(JOBS) --dist=worksteal --doctest-modules tests backend/domain backend/numerics $(OPTIONS)
	$(BIN)/pytest -m ui tests/ui $(OPTIONS)

lint: $(VENV)/.python-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy .ci/lock.py
	$(BIN)/lint-imports --no-logo
	$(BIN)/python .ci/lock.py check
	for script in docker/*.sh; do sh -n "$$script" || exit 1; done
	if command -v hadolint >/dev/null; then hadolint docker/Dockerfile; fi

format: $(VENV)/.python-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.system-run $(VENV)/.python-dev
	$(BIN)/pytest -m bench --benchmark-enable -p no:randomly tests/bench $(OPTIONS)

# No condition on the installed packages: the lock is older than pyproject.toml when it has to be written.
lock:
	[ -x $(BIN)/uv ] || $(MAKE) $(VENV)/.python-dev
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python .ci/lock.py write $(OPTIONS)

$(VENV)/.system-%: docker/packages-%.txt docker/install-system-packages.sh
	docker/install-system-packages.sh $*
	@mkdir -p $(VENV) && touch $@

# Compiled once, so that neither the first scan nor each test process waits for it.
# After the environment: targets name it before this one, and nothing runs in parallel.
$(VENV)/.kernels: $(wildcard backend/numerics/*.py)
	$(BIN)/python -c "from backend.numerics.warm_up import warm_up; warm_up()"
	@touch $@

$(VENV)/.python-run: requirements.lock pyproject.toml docker/install-python-packages.sh
	PYTHON="$(PYTHON)" docker/install-python-packages.sh requirements.lock $(VENV) --editable
	@touch $@

$(VENV)/.python-dev: requirements-dev.lock pyproject.toml docker/install-python-packages.sh
	PYTHON="$(PYTHON)" docker/install-python-packages.sh requirements-dev.lock $(VENV) --editable
	@touch $@
