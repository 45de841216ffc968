# The reproducibility book of Invariant Policy Optimization. `make help` lists the targets.

PYTHON ?= python3
PROFILE ?= class
STARTED := $(shell date +%s)
IN_VENV := .venv/bin/python
SCHEDULED = $(if $(SCHEDULER),--scheduler $(SCHEDULER))
SETUP_SECONDS = --setup-seconds $$(( $$(date +%s) - $(STARTED) ))

LOCK := .venv/bin/uv pip compile --quiet --universal --python-version 3.11.5 --generate-hashes \
	--no-annotate --custom-compile-command "make lock"

# Compiled modules are kept, whatever the shell says of it: many processes import the same ones,
# which takes nine seconds instead of four where they are compiled each time.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup book teaching test verify confirm reproduce claims serve lab lint format lock newest clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## the environment in .venv (every other target does it first)
	@$(PYTHON) book/setup.py

book: setup ## execute what changed and build the site [PROFILE=class] [JOBS=cores]
	@$(IN_VENV) book/build.py --profile $(PROFILE) $(if $(JOBS),--jobs $(JOBS)) $(SETUP_SECONDS)

teaching: setup ## archives of exercises, lab and homework for students and instructors
	@$(IN_VENV) book/teaching.py

test: ## set-up, browser included, the witnesses, and the default test suite
	@$(PYTHON) book/setup.py --system
	@$(IN_VENV) -m experiments.witness verify
	@$(IN_VENV) -m pytest

verify: setup ## whether today's code still gives the results: a slice of every kind of cell [CHAPTER=lqr]
	@$(IN_VENV) -m experiments.witness verify $(CHAPTER)

confirm: setup ## one full batch of every cell again, hours; goes on where it was [CHAPTER=lqr] [SINCE=commit]
	@$(IN_VENV) -m experiments.confirm $(CHAPTER) $(if $(SINCE),--since $(SINCE)) $(SCHEDULED)

reproduce: setup ## every result from nothing, into data/reproduced, hours; goes on where it was [CHAPTER=lqr]
	@$(IN_VENV) -m experiments.reproduce $(CHAPTER) $(SCHEDULED)
	@rm -rf book/_executed/paper
	@$(IN_VENV) book/build.py --profile paper $(if $(CHAPTER),--chapter $(CHAPTER)) $(SETUP_SECONDS)

claims: setup ## decide every claim of the paper again from the rows in data/
	@$(IN_VENV) book/claims.py

serve: setup ## the built site on http://localhost:8000
	@$(IN_VENV) -m http.server --bind localhost --directory book/_build/html

lab: setup ## the notebooks in JupyterLab
	@$(IN_VENV) -m jupyterlab

lint: setup ## ruff's checks and format, and the types of ipo/, without changing anything
	@$(IN_VENV) -m ruff check && $(IN_VENV) -m ruff format --check && $(IN_VENV) -m mypy

format: setup ## ruff's format and safe repairs
	@$(IN_VENV) -m ruff check --fix && $(IN_VENV) -m ruff format

lock: setup ## the hashes of the pinned packages anew, after a change of environment.txt
	@sed '/^torch==/d' environment.txt | $(LOCK) - --excludes book/locks/excluded.txt \
		--output-file book/locks/packages.txt >/dev/null
	@grep '^torch==' environment.txt \
		| $(LOCK) --constraint environment.txt - --output-file book/locks/torch.txt >/dev/null
	@grep '^uv==' environment.txt | $(LOCK) - --output-file book/locks/uv.txt >/dev/null

# All but jupyter-book, whose 2.x is another program.
newest: ## the tests with the newest versions of all direct dependencies, in .newest
	@$(PYTHON) -m venv --clear .newest
	@sed '/^# What the packages above need/,$$d; /^jupyter-book==/!s/==[^ ]*//' environment.txt \
		| .newest/bin/python -m pip install --quiet --requirement /dev/stdin
	@.newest/bin/python -m pip uninstall --quiet --yes --requirement book/locks/excluded.txt
	@.newest/bin/python -m pip install --quiet --no-deps --no-build-isolation \
		--editable . --editable notebooks
	@.newest/bin/python -m pip freeze
	@.newest/bin/python -m experiments.witness verify
	@.newest/bin/python -m pytest

clean: ## remove what was built; the environment and data/ stay
	@rm -rf book/_build book/_executed .pytest_cache .ruff_cache .mypy_cache .hypothesis
