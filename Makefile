# The commands a user and a developer need. `make run` and `make test` are the README's two.
PY  ?= python3
PIP := $(PY) -m pip --python .venv/bin/python --disable-pip-version-check install --quiet
BIN := .venv/bin

.PHONY: run test test-slow setup bench blind storm bench-links lock clean

run: .venv/ready ## acquire ten seconds from the simulated meter
	$(BIN)/aemd acquire --seconds 10 --out recordings

test: .venv/ready ## style, spelling, types, layers, tests, the README's commands
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest -n auto

test-slow: .venv/ready ## the tests that `test` leaves out because they take minutes
	$(BIN)/pytest -n auto -m slow

setup: .venv/ready

bench: .venv/ready ## performance, side by side in one run, as ratios
	$(BIN)/python -m tests.benchmarks

blind: .venv/ready ## hide effects in data and see what the critic finds; writes tests/blind/REPORT.md
	$(BIN)/python -m tests.blind

storm: .venv/ready ## ten days of 1,000 faults each, accelerated; SEED=n for one
	$(BIN)/python -m tests.storm $(if $(SEED),--seed $(SEED))

bench-links: .venv/ready ## each link: readings/s drained, and kept up for a minute, beside peers and the bare link
	$(BIN)/python -m tests.benchmarks.links

# --without-pip and `pip --python`: Debian packs ensurepip apart from python3.
.venv/ready: pyproject.toml .ci/requirements.lock .ci/peers.lock
	$(PY) -m venv --clear --without-pip .venv
	$(PIP) --require-hashes --only-binary :all: -r .ci/requirements.lock
	$(PIP) --require-hashes --no-deps --no-build-isolation -r .ci/peers.lock
	$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

# The one target that needs uv; it fetches it into a throwaway environment.
UV := .venv/uv/bin/uv pip compile --universal --python-version 3.11 --generate-hashes --quiet \
      --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock"
lock:
	$(PY) -m venv .venv/uv && .venv/uv/bin/python -m pip install --quiet uv
	$(UV) pyproject.toml --all-extras --group dev --output-file .ci/requirements.lock
	$(UV) pyproject.toml --constraint .ci/requirements.lock --output-file .ci/runtime.lock
	$(UV) --group peers --no-deps --output-file .ci/peers.lock

clean:
	rm -rf .venv recordings
