# Needs Python 3.11 or 3.12, make and nothing else; everything goes into $(VENV).
.DELETE_ON_ERROR:
.PHONY: demo test stress lint bench clean

SUPPORTED := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for python in python3 python3.12 python3.11; do \
	if "$$python" -c '$(SUPPORTED)' 2>/dev/null; then echo "$$python"; break; fi; done)
VENV ?= .venv
# a sourced ROS 2 is used as it is, otherwise its wheels are installed
EXTRAS := $(if $(AMENT_PREFIX_PATH),,ros,)record,view,study,dask,dev
INSTALLED := $(VENV)/.installed

SPEED ?= real
OUT ?= out/demo
PYTEST_ARGS ?=
# two processes, each with whole files: much of the time goes to compiling and to waiting for nodes
PARALLEL ?= -n 2 --dist loadfile
BENCH_ARGS ?=

demo: $(INSTALLED)
	"$(VENV)/bin/plow-twin" demo --speed $(SPEED) --out "$(OUT)"

test: $(INSTALLED)
	"$(VENV)/bin/python" -m pytest -m "not stress" $(PARALLEL) $(PYTEST_ARGS)

stress: $(INSTALLED)
	"$(VENV)/bin/python" -m pytest -m stress $(PARALLEL) $(PYTEST_ARGS)

lint: $(INSTALLED)
	"$(VENV)/bin/ruff" check .
	"$(VENV)/bin/mypy"

# the peers come on top; where they cannot all be installed, those that lack are named as not run
bench: PIP := "$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt
bench: $(INSTALLED)
	$(PIP) -e ".[bench]" || $(PIP) matplotlib
	"$(VENV)/bin/python" benchmark/run.py $(BENCH_ARGS)

$(INSTALLED): setup.py setup.cfg package.xml pyproject.toml requirements/constraints.txt
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or 3.12 with venv on PATH; name one: make PYTHON=/path/to/python" >&2; exit 1; }
	test -x "$(VENV)/bin/python" || "$(PYTHON)" -m venv "$(VENV)"
	"$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt -e ".[$(EXTRAS)]"
	@touch "$@"

clean:
	rm -rf .venv build dist install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find plow_twin test -name __pycache__ -type d -prune -exec rm -rf {} +
