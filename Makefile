# Evade's commands; `make` or `make help` lists them.

# The first that runs; pyenv leaves a python3.12 that does not.
PYTHON ?= $(shell for version in 3.11 3.12 3.13; do python$$version -c '' 2>/dev/null && echo python$$version && break; done)
VENV ?= .venv
ARGS ?=

PYTHONS ?= 3.11 3.12 3.13
SEEDS ?= 0 1 2
STEPS ?=
POLICIES ?= bytestream bytestream_xy event_columns event_image_vae event_set event_image rgb

# PPO's trainings are compared at one length; what a planner teaches takes that of its recipe. STEPS sets both.
COMPARED_STEPS := 500000
TAUGHT := bytestream_hold bytestream_imitation

COMMA := ,
TRAINED = 'study.policies=[$(subst $() ,$(COMMA),$(strip $(POLICIES)) straight oracle)]'

BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# What tests, lint, docs and releases need beside it; brought when first needed.
DEVELOPING := $(VENV)/.installed-dev
GL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri
LAUNCH := $(BIN)/python -m platform.launch
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4
# What failed is run once more by itself: beside other tests a wait or a time limit may fail by load alone.
ALONE := $(BIN)/python -m pytest --last-failed --last-failed-no-failures none
# A local dashboard runs no jobs of its own and sends no telemetry.
MLFLOW_ENV := MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false MLFLOW_DISABLE_TELEMETRY=true \
	MLFLOW_ALLOW_PICKLE_DESERIALIZATION=false

PSYCOPG := 'psycopg[binary]>=3.2'

export OMP_NUM_THREADS ?= 1
export NUMBA_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup setup-all system-libraries demo bytestream train-all sweep-robustness mlflow test test-costs test-system test-slow test-faults test-cluster test-soak test-pythons test-image lint check bench bench-clone lines numerics docs dist lock clean

help: ## list these commands
	@echo "make TARGET [ARGS=\"key=value ...\"]"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  %-17s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# Imports leave bytecode, whatever the shell says: the first start then takes half as long.
setup: $(INSTALLED) system-libraries ## create .venv with the pinned packages and this package, and compile what the default commands use
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m jobs.run.compile

setup-all: setup ## compile the other kernels, too, which otherwise compile when they are first used
	@$(BIN)/python -m jobs.run.compile all

$(INSTALLED): requirements.lock pyproject.toml
	@test -x $(BIN)/python -o -n "$(PYTHON)" || { echo "Evade needs Python 3.11, 3.12 or 3.13: see docs/start.md#install"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python platform/install.py requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

$(DEVELOPING): requirements-dev.lock $(INSTALLED)
	$(BIN)/python platform/install.py requirements.lock requirements-dev.lock
	touch $@

system-libraries: $(INSTALLED) # OpenGL without a screen, for renderer=pyrender
	@$(BIN)/python -c 'import ctypes; ctypes.CDLL("libEGL.so.1"); ctypes.CDLL("libGL.so.1")' 2>/dev/null \
	&& ls /usr/lib/*/dri/*swrast_dri.so /usr/lib/*/libgallium*.so 2>/dev/null | grep -q . \
	|| if [ "$$(uname)" != Linux ]; then \
	    echo "renderer=pyrender, and so mesh files, need EGL, which is for Linux; the rest does not"; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    { apt-get update && apt-get install --yes --no-install-recommends $(GL_PACKAGES); } \
	    || echo "warning: no OpenGL, so renderer=pyrender will not run; renderer=raycast does not need it"; \
	else \
	    echo "renderer=pyrender needs OpenGL; install it with:"; \
	    echo "    sudo apt-get install --no-install-recommends $(GL_PACKAGES)"; \
	fi

demo: setup ## watch a shipped policy: its result and a film, in less than a minute
	$(LAUNCH) +exp=demo $(ARGS)

bytestream: setup ## from nothing to an evaluated policy (4 to 8 minutes; ARGS="budget=smoke": a minute)
	$(LAUNCH) +exp=bytestream $(ARGS)

train-all: setup ## train every policy with three seeds into models/pretrained (hours; give it again to continue)
	for seed in $(SEEDS); do for exp in $(POLICIES); do \
	    case " $(TAUGHT) " in *" $$exp "*) steps=$(STEPS);; *) steps=$(or $(STEPS),$(COMPARED_STEPS));; esac; \
	    $(LAUNCH) +exp=$$exp job=train seed=$$seed $${steps:+train.env_steps=$$steps} $(ARGS) || exit 1; \
	done; done
	$(LAUNCH) publish $(ARGS)

# `train=true` first trains $(POLICIES), as train-all does, and evaluates the new policies.
sweep-robustness: $(if $(filter true,$(train)),train-all,setup) ## evaluate trained policies at other rates and thresholds, in other worlds, with faults
	$(LAUNCH) +exp=robustness $(if $(filter true,$(train)),$(TRAINED)) $(ARGS)

mlflow: setup ## serve the results on http://127.0.0.1:5000, for this machine only
	@echo "Open http://127.0.0.1:5000/#/experiments/1/runs?workflowType=machine_learning&viewStateShareKey=results"
	$(MLFLOW_ENV) $(BIN)/mlflow server --workers 1 --host 127.0.0.1 --port 5000 \
	    --backend-store-uri sqlite:///$(CURDIR)/mlflow.db $(ARGS)

test: setup $(DEVELOPING) ## the quick tests (4 minutes on two cores)
	$(PYTEST) --dist worksteal $(ARGS)

# Some 5 s of a quick host; a unit is a piece of work, see tests/support/costs.py.
MOST_UNITS := 100
test-costs: setup $(DEVELOPING) ## the quick tests one at a time, and which of them cost more than a quick test may (10 minutes)
	$(BIN)/python -m tests.support.kernels
	$(BIN)/python -m pytest --most-units $(MOST_UNITS) $(ARGS)

test-system: setup $(DEVELOPING) ## whole jobs, Ray, the launcher, every kind of policy, the site, the notebooks (8 minutes)
	$(PYTEST) -m "system and not slow" --dist loadfile $(ARGS)

test-slow: setup $(DEVELOPING) ## what continuous integration leaves out for its length (an hour; Chromium for the pages)
	$(PYTEST) -m slow --dist loadfile $(ARGS)

test-faults: setup $(DEVELOPING) ## inject faults into running jobs and print what was lost (19 minutes)
	$(BIN)/python -m pytest -m faults tests/faults --numprocesses 3 --dist worksteal $(ARGS)

test-cluster: setup $(DEVELOPING) ## a Ray cluster and what it may lose, and eight sweeps at once into PostgreSQL (18 minutes)
	@ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 \
	|| { [ "$$(id -u)" = 0 ] && apt-get update && apt-get install --yes --no-install-recommends postgresql; } \
	|| echo "warning: no PostgreSQL, so its test is skipped; apt-get install postgresql"
	$(BIN)/python -c 'import psycopg' 2>/dev/null || $(BIN)/python -m pip install --quiet $(PSYCOPG)
	$(BIN)/python -m pytest -m cluster -rs tests/cluster $(ARGS)

test-soak: setup $(DEVELOPING) ## training, sweep and dashboard for an hour, with a fault every minute (ARGS="minutes=10 seed=1")
	$(BIN)/python -m tests.soak.soak $(ARGS)

# Interpreters are found as python3.X; pyenv, uv and Debian can install them.
test-pythons: ## the quick tests on each supported Python, in .venv-3.X (PYTHONS="3.12 3.13" ARGS=tests/envs)
	@for version in $(PYTHONS); do \
	    if ! python$$version -c '' 2>/dev/null; then said="$$said  $$version: no interpreter\n"; \
	    elif make test PYTHON=python$$version VENV=.venv-$$version; then said="$$said  $$version: passed\n"; \
	    else said="$$said  $$version: FAILED\n"; fi; \
	done; printf "Python\n$$said"; case "$$said" in *FAILED*|*"no inter"*) exit 1;; esac

test-image: ## build the image by debootstrap and buildah, as root, and run its commands (ARGS="--build-arg ...")
	docker/test_image.sh $(ARGS)

lint: $(DEVELOPING) ## check style, format, types, and who imports whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

lines: ## count the lines of code of each room
	@$(BIN)/python .ci/lines.py

numerics: setup $(DEVELOPING) ## measure the numbers at the ends of their ranges, and write docs/numerics.md
	$(BIN)/python -m tests.numerics.page

check: ## what must pass before a change is merged
	$(MAKE) $(DEVELOPING)
	$(MAKE) --jobs 2 lint setup
	$(MAKE) test-again
	$(MAKE) test-system-again

%-again: # a suite, and what failed of it once more by itself
	$(MAKE) $* || $(MAKE) $* PYTEST='$(ALONE)' ARGS='--numprocesses 0 $(ARGS)'

bench: setup $(DEVELOPING) ## measure the speed of the parts, and what accuracy of the simulator costs
	for part in $(filter-out %/from_clone.py,$(wildcard benchmarks/*.py)); do $(BIN)/python -m benchmarks.$$(basename $$part .py) || exit 1; done
	$(LAUNCH) +exp=trade_simulator $(ARGS)

bench-clone: setup ## measure how long a new user waits, from an empty clone to each first result, on an idle machine
	$(BIN)/python -m benchmarks.from_clone $(ARGS)

docs: setup $(DEVELOPING) ## build this site in docs/_build/html; a broken link, a stale table or a long sentence stops it
	$(BIN)/python -m docs.tables --check
	$(BIN)/python -m docs.reading --check
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html $(ARGS)

dist: setup-all $(DEVELOPING) ## build the wheel dist/evade-*.whl: environment, camera, recordings, policies, compiled kernels
	rm -rf build
	$(BIN)/python -m build --wheel --no-isolation --outdir dist

COMPILE_LOCK := pip-compile --quiet --strip-extras --allow-unsafe --no-annotate --no-header \
	--no-emit-index-url --no-emit-find-links --no-emit-trusted-host

# Without "+cpu", so that every build of torch satisfies the pin.
lock: $(DEVELOPING) ## update requirements.lock and requirements-dev.lock (ARGS=--upgrade: to the newest versions)
	$(BIN)/$(COMPILE_LOCK) --extra jobs,meshes --output-file requirements.lock $(ARGS) pyproject.toml
	sed -i 's/+cpu$$//' requirements.lock
	$(BIN)/$(COMPILE_LOCK) --extra jobs,meshes,dev,docs --constraint requirements.lock \
	    --output-file requirements-dev.lock $(ARGS) pyproject.toml
	sed -i 's/+cpu$$//; /^$$/d; /^#/d' requirements-dev.lock
	grep --invert-match --line-regexp --fixed-strings --file requirements.lock requirements-dev.lock > $(VENV)/lock
	mv $(VENV)/lock requirements-dev.lock

clean: ## remove caches and build files; .venv, runs and results stay
	rm -rf build dist *.egg-info .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './.venv*' -prune -exec rm -rf {} +
