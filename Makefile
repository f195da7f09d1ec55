# Everything a person does here: `make demo`, `make test`, `make lint`. Each makes the virtual environment once.
# `make programs` installs what tests need beyond Python packages: without it they are left out.
PYTHON ?= python3
VENV ?= .venv
# Where torch is taken from, e.g. TORCH_INDEX=URL of an index of CPU wheels. Empty: pip's own configuration.
TORCH_INDEX ?=
# Gigabytes of CUDA come only when asked for: ALLOW_CUDA=1.
ALLOW_CUDA ?=
TORCH := --constraint constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
# Tests at once: of those that compute, and of those that fly in real time and mostly wait.
WORKERS ?= auto
REALTIME_WORKERS ?= 6
# The files with real-time tests, without those that need an autopilot: each of the workers imports what it is given.
REALTIME = $(filter-out tests/alone/%,$(sort $(shell grep -rl mark.realtime tests --include='test_*.py' | xargs grep -L mark.sitl)))
PAGE_TESTS := tests/companion/dashboard
AXE := $(PAGE_TESTS)/node_modules/axe-core/axe.min.js
# GPL, and used by tests alone: in an environment of its own.
MAVPROXY := .venv-mavproxy/bin/mavproxy.py
# A real ROS 2 from PyPI's wheels, each release in an environment of its own, without what rclpy does not need.
JAZZY := ros-jazzy-rclpy==7.1.6 ros-rmw-fastrtps-cpp==8.4.3 ros-sensor-msgs==5.3.6
KILTED := ros-kilted-rclpy==9.1.2 ros-rmw-fastrtps-cpp==9.3.3 ros-kilted-sensor-msgs==5.5.1
ROS_TESTS := tests/companion/ros2
ROS_READER := $(ROS_TESTS)/node_modules/.package-lock.json
PYZEROS := .venv-pyzeros/.installed
BIN := $(VENV)/bin
READY := $(VENV)/.installed

define REFUSE_CUDA
import json, sys; names = [i["metadata"]["name"] for i in json.load(sys.stdin)["install"]]; cuda = [n for n in names if n.lower().startswith(("nvidia", "cuda", "triton"))]; sys.exit("torch would bring %s: name an index of CPU wheels with TORCH_INDEX=..., or ask for it with ALLOW_CUDA=1" % ", ".join(cuda) if cuda else 0)
endef

# Package indexes may be slow: the command is tried three times; then the last line names what could not be installed.
define TRY
for try in 1 2 3; do if timeout 600 sh -ec '$(2)'; then exit 0; fi; sleep $$((5 * try)); done; \
	echo "make programs: could not install $(1); the lines above say why" >&2; exit 1
endef

.PHONY: demo test test-slow test-systemd programs debian lint format clean

demo: $(READY)
	$(BIN)/companion demo --output demo-output

# Hundreds of processes are started: bytecode is kept, whatever the environment says.
test test-slow: export PYTHONDONTWRITEBYTECODE =
test: $(READY)
	$(BIN)/python -m pytest tests/alone -m "not slow" --reruns 1
	$(BIN)/python -m pytest --ignore tests/alone -n $(WORKERS) --dist worksteal -m "not realtime and not slow"
	$(BIN)/python -m pytest $(REALTIME) -n $(REALTIME_WORKERS) --dist worksteal -m "realtime and not slow" --reruns 1
	@$(BIN)/python -m tests.programs

test-slow: $(READY)
	$(BIN)/python -m pytest tests/alone -m slow
	$(BIN)/python -m pytest --ignore tests/alone -n $(WORKERS) -m "slow and not realtime"
	$(BIN)/python -m pytest $(REALTIME) -n $(REALTIME_WORKERS) --dist worksteal -m "slow and realtime" --reruns 1
	$(BIN)/python -m pytest --ignore tests/alone -n $(WORKERS) -m "hypothesis and not slow" --hypothesis-profile explore --reruns 1

# As root; the first time some minutes, for Debian's files and the packages, which are kept.
test-systemd: export COMPANION_TEST_SYSTEMD ?= $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/mavlink-companion/test-systemd
test-systemd: $(READY)
	$(BIN)/python -m pytest tests/systemd -m systemd

programs: debian $(AXE) $(MAVPROXY) $(ROS_READER) .venv-ros-jazzy/.installed .venv-ros-kilted/.installed $(PYZEROS)

debian:
	@packages=$$($(PYTHON) -m tests.programs debian) || exit 1; test -n "$$packages" || exit 0; export packages; \
	$(call TRY,$$packages,apt-get update -qq; DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends $$packages)

$(AXE): $(PAGE_TESTS)/package-lock.json | debian
	@$(call TRY,axe-core,cd $(PAGE_TESTS); npm ci --ignore-scripts)
	@touch $@

$(MAVPROXY): constraints.txt
	@test -x $(@D)/python || $(PYTHON) -m venv .venv-mavproxy
	@$(call TRY,MAVProxy,$(@D)/python -m pip install --quiet --constraint constraints.txt pymavlink pyserial==3.5; $(@D)/python -m pip install --quiet --no-deps MAVProxy==1.8.75)
	@touch $@

$(ROS_READER): $(ROS_TESTS)/package-lock.json | debian
	@$(call TRY,rosmsg2-serialization,cd $(ROS_TESTS); npm ci --ignore-scripts)
	@touch $@

.venv-ros-jazzy/.installed: ROS := $(JAZZY)
.venv-ros-kilted/.installed: ROS := $(KILTED)
# Where there are no wheels, the tests are left out.
.venv-ros-%/.installed: tests/ros_interfaces.py companion/ros2/definitions.py | debian
	@test -n "$$($(PYTHON) -m tests.programs wheels)" || { echo "make programs: no wheels of ROS 2 for this machine"; exit 0; }; \
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D) || exit 1; \
	$(call TRY,ROS 2 $*,$(@D)/bin/python -m pip install --quiet $(ROS); PYTHONPATH=. $(@D)/bin/python tests/ros_interfaces.py > /dev/null; touch $@)

$(PYZEROS): constraints.txt
	@test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	@$(call TRY,pyzeros,$(@D)/bin/python -m pip install --quiet --constraint constraints.txt pyzeros==0.1.0 ros2-pyterfaces==0.3.0)
	@touch $@

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tools.check_words

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "companion needs Python 3.11 or newer, this is %d.%d; set PYTHON=" % sys.version_info[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(if $(ALLOW_CUDA),,$(BIN)/python -m pip install --quiet --dry-run --report $(VENV)/torch.json $(TORCH))
	$(if $(ALLOW_CUDA),,$(BIN)/python -c '$(REFUSE_CUDA)' < $(VENV)/torch.json)
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .venv-mavproxy .venv-pyzeros .venv-ros-* $(PAGE_TESTS)/node_modules $(ROS_TESTS)/node_modules demo-output build *.egg-info .pytest_cache .mypy_cache .ruff_cache
