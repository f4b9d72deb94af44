# Needs Python 3.11 or 3.12, make and nothing else; everything goes into $(VENV).
.DELETE_ON_ERROR:
.PHONY: demo test stress lint coverage docs lowest bench clean

# what Python has compiled is kept, whatever the caller's habit: hundreds of processes start in the tests
unexport PYTHONDONTWRITEBYTECODE

SUPPORTED := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for python in python3 python3.12 python3.11; do \
	if "$$python" -c '$(SUPPORTED)' 2>/dev/null; then echo "$$python"; break; fi; done)
VENV ?= .venv
# a sourced ROS 2 is used as it is, otherwise its wheels are installed
EXTRAS := $(if $(AMENT_PREFIX_PATH),,ros,)record,mqtt,opcua,sparkplug,influx,metrics,dashboard,view,study,dask,dev
INSTALLED := $(VENV)/.installed

SPEED ?= real
OUT ?= out/demo
PYTEST_ARGS ?=
# an option of pytest 9: older ones, as of a distribution, would not start with it in pyproject.toml
HANGING := -o faulthandler_exit_on_timeout=true
# three processes for two cores, each with whole files in the order of test/conftest.py: some of them wait for nodes and
# viewers; one that a test has ended is not replaced, for the next one would begin with that test again
PARALLEL ?= -n 3 --dist loadfile --no-loadscope-reorder --max-worker-restart=0
BENCH_ARGS ?=
SITE ?= out/site
COVERED ?= $(wildcard test/test_model_*.py test/test_scene_*.py test/test_stream_*.py test/test_record_file.py)
LOWEST ?= .venv-lowest
# core, record, node and MQTT, without kernels and searches that tell nothing of a library; rerun wants a newer numpy than
# ROS 2 Jazzy has
LOWEST_TESTS ?= -k "not rerun and not paper-1e and not locked_coordinates and not offset_mass and not random_scenes \
	and not bench_kv and not all_events and not running_in and not truncated_file and not of_any_size" $(wildcard test/test_model_*.py test/test_scene_*.py test/test_stream_session.py) \
	$(addprefix test/, test_solve_reference.py test_record_file.py test_ros_lifecycle.py test_mqtt.py)

demo: $(INSTALLED)
	"$(VENV)/bin/plow-twin" demo --speed $(SPEED) --out "$(OUT)"

test: $(INSTALLED)
	"$(VENV)/bin/python" -m pytest -m "not stress" $(HANGING) $(PARALLEL) $(PYTEST_ARGS)

# other examples each time; a failure is had again by the seed that is printed: make stress SEED=...
stress: $(INSTALLED)
	@seed=$${SEED:-$$(od -An -N4 -tu4 /dev/urandom | tr -d " ")}; echo "SEED=$$seed"; \
	"$(VENV)/bin/python" -m pytest -m stress -o faulthandler_timeout=0 --hypothesis-profile=stress --hypothesis-seed=$$seed $(PARALLEL) $(PYTEST_ARGS)

lint: $(INSTALLED)
	"$(VENV)/bin/ruff" check .
	"$(VENV)/bin/mypy"
	"$(VENV)/bin/codespell"

# lines of Python that these tests reach; compiled ones are not seen. Apart from `test`, for tracing makes compiling take
# two thirds longer: run it after, when the kernels are in the cache. Installed here only: numba imports coverage where it
# finds it, a twentieth of each of the hundreds of starts in the tests
coverage: $(INSTALLED)
	"$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt pytest-cov
	"$(VENV)/bin/python" -m pytest -q -m "not stress" $(PARALLEL) $(PYTEST_ARGS) --cov --cov-report=term:skip-covered $(COVERED)

# the pages as one site, the API reference from the docstrings; warnings and broken links are errors
docs: $(INSTALLED)
	"$(VENV)/bin/mkdocs" build --strict --site-dir "$(abspath $(SITE))"

# core, record, node and MQTT with the lowest versions that setup.py names
lowest: $(LOWEST)/.installed
	"$(LOWEST)/bin/python" -m pytest -m "not stress" $(filter-out --no-loadscope-reorder,$(subst -n 3,-n 2,$(PARALLEL))) $(PYTEST_ARGS) $(LOWEST_TESTS)

# the peers come on top; where they cannot all be installed, those that lack are named as not run
bench: PIP := "$(VENV)/bin/python" -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt
bench: $(INSTALLED)
	$(PIP) -e ".[bench]" || $(PIP) matplotlib
	"$(VENV)/bin/python" benchmark/run.py $(BENCH_ARGS)

# no bytecode: it would take two fifths of the time, most of it for modules that are never imported
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
