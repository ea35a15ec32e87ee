# Everything runs from one environment, .venv, made from scratch when PYTHON changes version
# and brought up to date when pyproject.toml or constraints.txt change.

PYTHON ?= python3
PYTHONS ?= python3.11 python3.13

BIN := .venv/bin
# Sources are compiled when they are first imported: a third of those that are installed.
INSTALL := -m pip install --quiet --quiet --disable-pip-version-check --no-compile
# A file to a process, in the order of tests/conftest.py.
SPREAD := -n 2 --dist loadfile --no-loadscope-reorder
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
CREATED := .venv/.python$(VERSION)

.PHONY: help demo test check docs bench soak constraints clean
.NOTPARALLEL:
# Each test process, and each command that a test starts, would compile all sources anew.
unexport PYTHONDONTWRITEBYTECODE

help:  ## Show this list
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' Makefile | expand -t 14

demo: .venv/.demo  ## Run the demonstration and write its report to out/
	$(BIN)/heliograph demo --out out

test: .venv/.test  ## Check style and types, run the tests that guard daily work (five to ten minutes on two cores)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy --strict src studies & types=$$!; \
	$(BIN)/pytest $(SPREAD) -m "not slow"; tests=$$?; \
	wait $$types && exit $$tests

check: .venv/.test  ## Run all other tests: studies from end to end, kills, brokers, a browser (twenty to thirty more)
	$(BIN)/pytest $(SPREAD) -m slow

docs: .venv/.docs  ## Build the documentation into out/docs, running its gallery, and check every page of it
	@rm -rf out/docs docs/_made
	$(BIN)/python -m sphinx -W --keep-going --quiet docs out/docs
	$(BIN)/python -m pytest --quiet docs/_site
	@echo "Open out/docs/index.html"

bench: .venv/.test  ## Time everything, beside its peers, into benchmarks/results.json
	@$(BIN)/python benchmarks/run.py

soak: .venv/.test  ## Kill, interrupt, try thousands of random programs and networks (hours; goes on where stopped)
	@$(BIN)/python benchmarks/kills.py
	@$(BIN)/python benchmarks/upper_claims.py
	@$(BIN)/python benchmarks/upper_fusion.py
	@$(BIN)/python benchmarks/upper_networks.py
	@$(BIN)/python benchmarks/interruptions.py
	@$(BIN)/python benchmarks/random_programs.py
	@$(BIN)/python benchmarks/soak.py

clean:  ## Remove the environment and everything made by the other targets
	rm -rf .venv out docs/_made build dist .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find src studies tests benchmarks -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

# An interpreter of some years comes with a pip that takes half as long again, and knows no groups (before 25.1).
$(CREATED):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "heliograph needs Python 3.11 or newer, and '$(PYTHON)' is older or does not start: try make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m venv --clear .venv >/dev/null 2>&1 || \
	  { echo "'$(PYTHON) -m venv .venv' failed: install venv and pip for it (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@$(BIN)/python $(INSTALL) --upgrade pip || true
	@touch $@

.venv/.demo: $(CREATED) pyproject.toml constraints.txt
	@echo "Installing heliograph into .venv (the first time: a minute or two, 1.4 GB) ..."
	@$(BIN)/python $(INSTALL) -c constraints.txt -e '.[report,tables,recordings,results,sweep,lmi,live]'
	@$(BIN)/python -c 'import pytest' 2>/dev/null || \
	  { printf '#!/bin/sh\necho "pytest: run make test, which installs what the tests need" >&2\nexit 2\n' >$(BIN)/pytest && chmod +x $(BIN)/pytest; }
	@touch $@

.venv/.test: $(CREATED) pyproject.toml constraints.txt
	@echo "Installing heliograph and its tools into .venv (the first time: a minute or two) ..."
	@$(BIN)/python $(INSTALL) -c constraints.txt -e '.[all]' --group dev
	@touch .venv/.demo $@

.venv/.docs: .venv/.test
	@echo "Installing what builds the documentation into .venv ..."
	@$(BIN)/python $(INSTALL) -c constraints.txt -e '.[all]' --group dev --group docs
	@touch $@

# The newest of everything on the oldest and on a newer Python. jax, numpy, scipy and zarr have left 3.11 behind,
# so 3.11 has versions of its own and every later Python shares the others.
constraints:  ## Pin the newest versions in constraints.txt (needs Python 3.11 and 3.13)
	@set -e; work=$$(mktemp -d); trap 'rm -rf "$$work"' EXIT; export LC_ALL=C; \
	for python in $(PYTHONS); do \
	  "$$python" -m venv "$$work/venv" --clear; \
	  "$$work/venv/bin/python" $(INSTALL) -e '.[all]' --group dev --group docs; \
	  "$$work/venv/bin/python" -m pip freeze --exclude-editable | grep -E '^[A-Za-z0-9._-]+==[^ ]+$$' \
	    | sort > "$$work/$$(echo "$$python" | tr / _).txt"; \
	done; \
	set -- $(subst /,_,$(PYTHONS)); old="$$work/$$1.txt"; new="$$work/$$2.txt"; \
	{ echo '# Written by "make constraints": what a fresh install of heliograph[all] and the groups dev and docs resolves to.'; \
	  { comm -12 "$$old" "$$new"; \
	    comm -23 "$$old" "$$new" | sed 's/$$/; python_version < "3.12"/'; \
	    comm -13 "$$old" "$$new" | sed 's/$$/; python_version >= "3.12"/'; } | sort -f; } > constraints.txt
