# Needs Python 3.11 or 3.12, make and nothing else; everything goes into $(VENV).
.DELETE_ON_ERROR:
.PHONY: demo test stress lint coverage docs lowest bench clean

# Python caches its bytecode even if the caller has disabled the cache, because the tests start hundreds of processes
unexport PYTHONDONTWRITEBYTECODE

SUPPORTED := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for python in python3 python3.12 python3.11; do \
	if "$$python" -c '$(SUPPORTED)' 2>/dev/null; then echo "$$python"; break; fi; done)
VENV ?= .venv
# without a sourced ROS 2, pip installs the wheels of ROS 2
EXTRAS := $(if $(AMENT_PREFIX_PATH),,ros,)record,mqtt,opcua,sparkplug,influx,metrics,dashboard,view,study,dask,dev
INSTALLED := $(VENV)/.installed

SPEED ?= real
OUT ?= out/demo
PYTEST_ARGS ?=
# pyproject.toml cannot contain this option of pytest 9, because an older pytest, for example of a distribution, refuses it
HANGING := -o faulthandler_exit_on_timeout=true
# Three processes use two cores, because some tests wait for nodes and viewers. Each process runs whole files, in the order of
# test/conftest.py. A process that a test has ended is not restarted, because it would begin with the same test again
PARALLEL ?= -n 3 --dist loadfile --no-loadscope-reorder --max-worker-restart=0
BENCH_ARGS ?=
SITE ?= out/site
COVERED ?= $(wildcard test/test_model_*.py test/test_scene_*.py test/test_stream_*.py test/test_record_file.py)
LOWEST ?= .venv-lowest
# These tests cover core, record, node and MQTT. They leave out compilations and searches that do not depend on the version of a
# library, and rerun, which needs a newer numpy than that of ROS 2 Jazzy
LOWEST_TESTS ?= -k "not rerun and not paper-1e and not locked_coordinates and not offset_mass and not random_scenes \
	and not bench_kv and not all_events and not running_in and not truncated_file and not of_any_size" $(wildcard test/test_model_*.py test/test_scene_*.py test/test_stream_session.py) \
	$(addprefix test/, test_solve_reference.py test_record_file.py test_ros_lifecycle.py test_mqtt.py)

demo: $(INSTALLED)
	"$(VENV)/bin/plow-twin" demo --speed $(SPEED) --out "$(OUT)"

test: $(INSTALLED)
	"$(VENV)/bin/python" -m pytest -m "not stress" $(HANGING) $(PARALLEL) $(PYTEST_ARGS)

# each run draws new examples; `make stress SEED=...` with the printed seed repeats a failure
stress: $(INSTALLED)
	@seed=$${SEED:-$$(od -An -N4 -tu4 /dev/urandom | tr -d " ")}; echo "SEED=$$seed"; \
	"$(VENV)/bin/python" -m pytest -m stress -o faulthandler_timeout=0 --hypothesis-profile=stress --hypothesis-seed=$$seed $(PARALLEL) $(PYTEST_ARGS)

lint: $(INSTALLED)
	"$(VENV)/bin/ruff" check .
	"$(VENV)/bin/mypy"
	"$(VENV)/bin/codespell"

# Coverage counts the lines of Python that these tests reach, without compiled functions. Tracing makes compilation take two
# thirds longer, so run `make test` first, which caches the kernels. The package coverage is installed only by this target,
# because numba imports it if it exists, which takes a twentieth of each start of a process in the tests
coverage: $(INSTALLED)
	"$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt pytest-cov
	"$(VENV)/bin/python" -m pytest -q -m "not stress" $(PARALLEL) $(PYTEST_ARGS) --cov --cov-report=term:skip-covered $(COVERED)

# mkdocs builds the site from the pages and the docstrings; warnings and broken links are errors
docs: $(INSTALLED)
	"$(VENV)/bin/mkdocs" build --strict --site-dir "$(abspath $(SITE))"

# core, record, node and MQTT with the lowest versions that setup.py names
lowest: $(LOWEST)/.installed
	"$(LOWEST)/bin/python" -m pytest -m "not stress" $(filter-out --no-loadscope-reorder,$(subst -n 3,-n 2,$(PARALLEL))) $(PYTEST_ARGS) $(LOWEST_TESTS)

# the benchmark names each peer program that could not be installed
bench: PIP := "$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt
bench: $(INSTALLED)
	$(PIP) -e ".[bench]" || $(PIP) matplotlib
	"$(VENV)/bin/python" benchmark/run.py $(BENCH_ARGS)

# pip compiles no bytecode, which would take two fifths of the time, mostly for modules that are never imported
$(INSTALLED): setup.py setup.cfg package.xml pyproject.toml requirements/constraints.txt
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or 3.12 with venv on PATH; name one: make PYTHON=/path/to/python" >&2; exit 1; }
	test -x "$(VENV)/bin/python" || "$(PYTHON)" -m venv "$(VENV)"
	"$(VENV)/bin/python" -m pip install --no-compile --quiet --disable-pip-version-check -c requirements/constraints.txt -e ".[$(EXTRAS)]"
	@touch "$@"

$(LOWEST)/.installed: setup.py requirements/lowest.txt
	test -x "$(LOWEST)/bin/python" || "$(PYTHON)" -m venv "$(LOWEST)"
	"$(LOWEST)/bin/python" -m pip install --no-compile --quiet --disable-pip-version-check -c requirements/lowest.txt \
		-e ".[$(if $(AMENT_PREFIX_PATH),,ros,)record,mqtt,sparkplug,metrics,test]"
	@touch "$@"

clean:
	rm -rf .venv .venv-lowest build dist install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find plow_twin test -name __pycache__ -type d -prune -exec rm -rf {} +
