# `make run` and `make test` do all the set-up: virtual environment, installation, then the work.
# Both take PYTHON=python3.12; ARGS goes to the command: make run ARGS="--task reposition".

PYTHON ?= python3
PYTHONS ?= python3.11 python3.12 python3.13
PYTHON312 ?= python3.12
ARGS ?=

BIN := .venv/bin
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d%d" % sys.version_info[:2])' 2>/dev/null)
CONSTRAINTS := $(wildcard constraints/py$(VERSION).txt)
INSTALL := $(BIN)/python -m pip install -qq --no-input --disable-pip-version-check -c $(CONSTRAINTS)
# One stamp a Python version: another PYTHON, or a changed pyproject or constraints file, installs anew.
CORE := .venv/installed-core-$(VERSION)
DEV := .venv/installed-dev-$(VERSION)
EXTRAS := .venv-extras/installed-$(VERSION)
DOCS := .venv-docs/installed-$(VERSION)
PLUGINS := .venv-lerobot/installed

.DEFAULT_GOAL := help
.PHONY: help run test check test-slow test-deep test-all test-gpu extras test-extras docs-tools docs plugins test-plugins reliability lock clean python try-wheels
# Two installations into one environment must not run at once.
.NOTPARALLEL:

help:
	@echo "make run          install, then squeeze plasticine between two tactile sensors   (ARGS=\"--task reposition\")"
	@echo "make test         install with dev extras, then lint, types, import contract, vocabulary, tests   (ARGS=\"-k rig\")"
	@echo "make check        the same without the tests"
	@echo "make test-slow    the tests that take over a second each   (CI runs them after make test)"
	@echo "make test-all     make test, make test-slow, then make test-deep: the long runs"
	@echo "make test-gpu     figures and physics tests on CUDA in at most 8 minutes   (without CUDA: says so, and fails)"
	@echo "make reliability  what is promised of arms and cameras, measured by its tests, for docs/reliability.md"
	@echo "make test-extras  tests that need heavy extras (torch, rerun, ray, av), in an environment of their own"
	@echo "make test-plugins tests of the plug-ins for LeRobot, which wants Python 3.12   (without one: says so, and fails)"
	@echo "make docs         the documentation as a site in site/, in an environment of its own; warnings are errors"
	@echo "make try-wheels   build the distributions, use their wheels in clean environments for each of: $(PYTHONS)"
	@echo "make lock         renew constraints/ for each of: $(PYTHONS)"
	@echo "make clean        remove the environment, caches and builds (runs/ stays)"
	@echo "Choose a Python with PYTHON=python3.12 (3.11, 3.12 or 3.13; default: python3)."

run: $(CORE)
	@$(BIN)/tacsim run $(ARGS)

check: $(DEV)
	@$(BIN)/ruff check -q .
	@$(BIN)/ruff format -q --check .
	@$(BIN)/mypy
	@$(BIN)/mypy plugins/*/lerobot_*.py
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/python tools/vocabulary.py

# Two processes; the tests of a file stay in one of them, for what a module opens is opened once.
PARALLEL := -n 2 --dist loadfile

test: check
	@$(BIN)/python -m pytest -q $(PARALLEL) $(ARGS)

test-slow: $(DEV)
	@$(BIN)/python -m pytest -q -m "slow and not deep" $(PARALLEL) $(ARGS) || [ $$? = 5 ]

# Arms and mocks keep real time: their long tests share the machine with no others. 5: no test by that name among these.
test-deep: $(DEV)
	@$(BIN)/python -m pytest -q -m deep $(PARALLEL) --ignore=tests/robot --ignore=tests/stops $(ARGS) || [ $$? = 5 ]
	@$(BIN)/python -m pytest -q -m deep tests/robot tests/stops $(ARGS) || [ $$? = 5 ]

test-all: test test-slow test-deep

# At most 8 minutes, for a machine that is borrowed (--budget 480); 77 without a device. TACSIM_DEVICE=cpu with
# ARGS="--largest 2" tries it without a GPU. All for docs/benchmarks.md: ARGS="--all --budget 7200", then the pages.
test-gpu: $(DEV)
	@$(BIN)/python -m benchmarks.device_run $(ARGS)

# The promises' tests, each several times, and the page of their figures. Wants an idle machine. ARGS="--promise 16":
# that promise alone, whose rows replace the old ones.
reliability: $(DEV)
	@$(BIN)/tacsim bench robot --long --json benchmarks/reliability.json --docs docs $(ARGS)

# What needs torch, rerun or ray, in an environment of its own: make test shows that all else works without them.
WITH_EXTRAS := tests/robot/train tests/robot/cli/test_learn.py tests/robot/export tests/robot/collect/test_cluster.py \
  tests/tacsim/record/test_viewers.py
extras: $(EXTRAS)

test-extras: extras
	@.venv-extras/bin/python -m pytest -q -m "not deep" $(PARALLEL) $(WITH_EXTRAS) $(ARGS)

# The site reads the code: its pages of commands, files and the Python interface are generated.
docs-tools: $(DOCS)

docs: docs-tools
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/python -m mkdocs build --strict --site-dir site
	@echo "The site is in site/. Read it with: $(PYTHON) -m http.server -d site -b 127.0.0.1 8000"

# LeRobot is large (torch), wants Python 3.12, and other versions than constraints/py312.txt: an environment of its own.
# Where pip finds torch for CPUs alone is the machine's affair (PIP_EXTRA_INDEX_URL). 77: nothing was tested.
plugins: $(PLUGINS)

test-plugins:
	@command -v $(PYTHON312) >/dev/null 2>&1 || { \
	  echo "make test-plugins: LeRobot wants Python 3.12, and '$(PYTHON312)' is not found, so nothing was tested."; exit 77; }
	@$(MAKE) --no-print-directory plugins
	@.venv-lerobot/bin/python -m pytest -q -m "" tests/plugins tests/robot/export/test_lerobot_video.py $(ARGS)

try-wheels:
	@$(PYTHON) tools/install_matrix.py $(addprefix --python ,$(PYTHONS)) $(ARGS)

lock:
	@for each in $(PYTHONS); do \
	  if $$each -c 'import pip' >/dev/null 2>&1; then $$each constraints/lock.py || exit 1; \
	  else echo "$$each: not found (or without pip), its constraints stay as they are"; fi; \
	done

clean:
	rm -rf .venv .venv-extras .venv-docs .venv-lerobot .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis build dist site

# Stands before each installation: a clear word about the Python, and an environment made by that Python.
python:
	@test -n "$(VERSION)" || { echo "make: cannot run '$(PYTHON)'. Install Python 3.11 to 3.13, or name one: make PYTHON=python3.12"; exit 1; }
	@case "$(VERSION)" in 311|312|313) ;; *) \
	  echo "make: tacsim needs Python 3.11, 3.12 or 3.13, but '$(PYTHON)' is $$($(PYTHON) -V 2>&1). Name another: make PYTHON=python3.12"; exit 1;; esac
	@test -n "$(CONSTRAINTS)" || { echo "make: constraints/py$(VERSION).txt is missing; make lock writes it"; exit 1; }
	@test "$$($(BIN)/python -c 'import sys; print("%d%d" % sys.version_info[:2])' 2>/dev/null)" = "$(VERSION)" || { \
	  echo "Making a virtual environment in .venv ($$($(PYTHON) -V))"; rm -rf .venv; $(PYTHON) -m venv .venv; }

$(CORE): pyproject.toml $(CONSTRAINTS) | python
	@echo "Installing tacsim into .venv (a few minutes the first time)"
	@$(INSTALL) -e .
	@touch $@

$(DEV): pyproject.toml $(CONSTRAINTS) | python
	@echo "Installing tacsim and its development tools into .venv (a few minutes the first time)"
	@$(INSTALL) -e '.[dev]'
	@touch $@ $(CORE)

$(EXTRAS): pyproject.toml $(CONSTRAINTS) constraints/extras.txt | python
	@echo "Installing tacsim with torch, stable-baselines3 and rerun into .venv-extras (a few minutes the first time)"
	@rm -rf .venv-extras && $(PYTHON) -m venv .venv-extras
	@.venv-extras/bin/python -m pip install -qq --no-input --disable-pip-version-check \
	  -c $(CONSTRAINTS) -c constraints/extras.txt -e '.[dev,train,viz,cluster,video]'
	@touch $@

$(DOCS): pyproject.toml $(CONSTRAINTS) constraints/docs.txt | python
	@echo "Installing tacsim and MkDocs into .venv-docs (a few minutes the first time)"
	@rm -rf .venv-docs && $(PYTHON) -m venv .venv-docs
	@.venv-docs/bin/python -m pip install -qq --no-input --disable-pip-version-check \
	  -c $(CONSTRAINTS) -c constraints/docs.txt -e '.[docs]'
	@touch $@

$(PLUGINS): pyproject.toml constraints/lerobot.txt $(wildcard plugins/*/pyproject.toml)
	@echo "Installing LeRobot and tacsim's plug-ins for it into .venv-lerobot (minutes the first time)"
	@rm -rf .venv-lerobot && $(PYTHON312) -m venv .venv-lerobot
	@.venv-lerobot/bin/python -m pip install -qq --no-input --disable-pip-version-check -c constraints/lerobot.txt \
	  -e '.[export,video]' 'lerobot[core_scripts,training]' pytest pytest-timeout hypothesis \
	  $(addprefix -e ,$(wildcard plugins/lerobot_*))
	@touch $@
