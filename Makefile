# `make demo` and `make test` install what they need into .venv and start from nothing but python3, gcc and make.
PYTHON ?= python3
BIN := .venv/bin
comma := ,
# pip's log is kept, not shown: it is long, and of use only when an install fails. Modules are compiled at their
# first import, 15 s in all: pip would compile some 18,000, of which 2,600 are imported, in 70 s (measured, 2.0 GHz Xeon).
install = $(BIN)/python -m pip --disable-pip-version-check install --no-compile -c constraints.txt -e ".[$(1)]" > .venv/install.log 2>&1 || { tail -n 15 .venv/install.log >&2; echo "make: the install failed; the whole log is in .venv/install.log" >&2; exit 1; }
SEED ?= 0
PEOPLE ?= 4
DURATION ?= 60
ROBOT ?= go2

# Isolated tests run two at a time with one thread each; tests that start real-time processes run one at a time.
WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest
SINGLE := OMP_NUM_THREADS=1 $(PYTEST)
PARALLEL := $(SINGLE) -n $(WORKERS) --dist loadfile
PROCESS_FILES = $(shell grep -rlF --include='test_*.py' mark.process tests)
PROPERTY_FILES = $(shell grep -rlE --include='test_*.py' 'given|stateful' tests)
# Tests of processes mostly wait, so isolated ones run beside them, with the lowest priority. They share a folder, so that
# the model is exported once: EDGE_TEST_FOLDER, or one of their own. $(1): the tests' name, $(2): options, $(3): marker.
tiers = @own=; test -n "$$EDGE_TEST_FOLDER" || own=$$(mktemp -d) && folder=$${EDGE_TEST_FOLDER:-$$own} && \
	export EDGE_TEST_FOLDER="$$folder" && \
	trap 'kill $$isolated 2>/dev/null; wait $$isolated; rm -rf $$own' EXIT && trap 'exit 130' INT TERM && \
	{ nice -n 19 env $(PARALLEL) $(2) -m "$(3)not process" > "$$folder/isolated.log" 2>&1 & } && isolated=$$!; \
	echo "== $(1) tests of processes, one at a time" && \
	$(PYTEST) $(2) -m "$(3)process and not repeated" $(PROCESS_FILES); processes=$$?; wait $$isolated; code=$$?; isolated=; \
	echo "== isolated $(1) tests" && cat "$$folder/isolated.log" && test $$processes = 0 && test $$code = 0
# Tests start hundreds of processes; without compiled modules on the disk each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo demos nano faults contract test test-slow test-random test-all stops coverage mutants lint clean

help:
	@echo "make demo   export, simulate, drive for $(DURATION) s and write out/demo/report.html"
	@echo "            LIVE=1: with a live view in the browser, whose address is printed"
	@echo "            ROBOT=carter-can, carter-mavlink or carter-ros2: another robot and protocol than the go2's"
	@echo "make demos  the demo with ten seeds (about 15 min); out/demos/SEED/report.html"
	@echo "make nano   train nano from nothing into out/nano-run; weights and card in its folder ship (hours; Ctrl-C and again goes on)"
	@echo "make faults inject faults into real processes, some 250 times (about 15 min), and write out/faults/"
	@echo "make faults PER_ROW=20 LOAD=2  each fault 20 times beside two busy processes; resumes; the table: python -m tools.faults --table out/faults"
	@echo "make contract  faults of link, bridge and runner on every robot, 20 times each, into out/contract/ (an hour; resumes)"
	@echo "make test   lint, type-check and run the fast tests (4 to 9 min on 2 cores)"
	@echo "make test-all     lint, type-check and run every test (15 to 30 min on 2 cores)"
	@echo "make test-slow    the tests that 'make test' leaves out"
	@echo "make test-random  the property tests with a random seed, which is printed; SEED=N repeats one"
	@echo "make stops  every stop and kill 20 times, with its times and distances (about 10 min)"
	@echo "make coverage  branch coverage of the bridge's rules and link; fails below 100 % (about 1 min)"
	@echo "make mutants   change safety-critical modules in small ways; fails when no test notices one (resumes)"
	@echo "make lint   ruff and mypy only"
	@echo "make clean  remove out/ (keeps .venv)"

.venv/bin/python:
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "make: $(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }

# Stamps are newer than what they were installed from: a second run installs nothing.
.venv/.demo-installed: pyproject.toml constraints.txt | .venv/bin/python
	@echo "make: installing the demo's packages into .venv, once; log: .venv/install.log" >&2
	@$(call install,export$(comma)sim$(comma)live)
	@touch $@

# The extra dev brings the demo's live with it: one install serves both.
.venv/.test-installed: pyproject.toml constraints.txt | .venv/bin/python
	@echo "make: installing the test packages into .venv, once; log: .venv/install.log" >&2
	@$(call install,export$(comma)sim$(comma)dev)
	@touch .venv/.demo-installed $@

demo: .venv/.demo-installed
	@$(BIN)/python -m tools.demo --robot $(ROBOT) --out out/demo --duration $(DURATION) --seed $(SEED) --people $(PEOPLE) $(if $(LIVE),--live)

# Ten worlds with one model, each with a report of its own; says how many passed every check.
demos: .venv/.demo-installed
	@$(BIN)/edge-export --target cpu --model nano --out out/demos/artifacts
	@passed=0; for seed in 0 1 2 3 4 5 6 7 8 9; do \
		$(BIN)/python -m tools.demo --robot $(ROBOT) --out out/demos/$$seed --artifacts out/demos/artifacts --duration $(DURATION) --seed $$seed --people $(PEOPLE); \
		code=$$?; case $$code in 0) passed=$$((passed + 1));; 1) ;; *) exit $$code;; esac; \
	done; echo "make: $$passed of 10 seeds passed, 9 are asked for"; test $$passed -ge 9

# Every stage of tools/train/config/recipes/nano.toml; a second call goes on where the first was ended. The plan: --dry-run.
nano: .venv/.demo-installed
	@OMP_NUM_THREADS=$$(( ($$(nproc) + 1) / 2 )) $(BIN)/torchrun --nproc-per-node 2 -m tools.train.cli all --preset nano --out out/nano-run --resume
	@$(BIN)/edge-train card --out out/nano-run --ship out/nano-run/ship
	@echo "make: weights and card are in out/nano-run/ship; measure them, then publish: edge-train card --out out/nano-run --scores RESULT.json --ship export/weights"

# The demo's artifacts, if they are there; otherwise its own. make faults PER_ROW=20: a second call goes on where the first
# was ended; delete out/faults after a change of the code. LOAD=2: beside two busy processes.
LOAD = 0
faults: .venv/.demo-installed
	@grep -qs '"schema_version": 4' out/demo/artifacts/manifest.json || $(BIN)/edge-export --target cpu --model nano --random-weights 0 --out out/demo/artifacts
	@$(BIN)/python -m tools.faults --robot $(ROBOT) --artifacts out/demo/artifacts --out out/faults --load $(LOAD) $(if $(PER_ROW),--per-row $(PER_ROW) --resume)

# One robot: make contract ROBOTS=carter-can. A second call keeps the rows that are there; OUT=DIR writes elsewhere.
ROBOTS = go2 carter-can carter-mavlink carter-ros2
OUT = out/contract
contract: .venv/.demo-installed
	@grep -qs '"schema_version": 4' out/demo/artifacts/manifest.json || $(BIN)/edge-export --target cpu --model nano --random-weights 0 --out out/demo/artifacts
	@failed=0; for robot in $(ROBOTS); do \
		$(BIN)/python -m tools.faults --robot $$robot --contract --resume --per-row 20 --artifacts out/demo/artifacts --out $(OUT)/$$robot; \
		code=$$?; case $$code in 0) ;; 1) failed=1;; *) exit $$code;; esac; \
	done; $(BIN)/python -m tools.faults --table $(ROBOTS:%=$(OUT)/%) > $(OUT)/table.md && cat $(OUT)/table.md && exit $$failed

lint: .venv/.test-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(call tiers,fast,,not slow and )

test-slow: .venv/.test-installed
	$(call tiers,slow,--durations=15,slow and )

# Shrinking a failing example takes up to 5 minutes: longer than the usual time limit of a test.
test-random: .venv/.test-installed
	@seed=$(SEED); test "$$seed" -ne 0 || seed=$$($(PYTHON) -c "import secrets; print(1 + secrets.randbelow(2**31))"); \
	echo "== property tests with the random seed $$seed; repeat them with: make test-random SEED=$$seed"; \
	$(PARALLEL) $(PROPERTY_FILES) -m "hypothesis and not process" --timeout 600 --hypothesis-profile=random --hypothesis-seed=$$seed

test-all: lint
	$(call tiers,all,--durations=15,)

stops: .venv/.test-installed
	$(PYTEST) -s -m repeated tests/process/bridge

# The threshold is in pyproject.toml.
COVERING = $(wildcard tests/firmware_bridge/test_*.py) tests/firmware_bridge/core tests/firmware_bridge/can tests/firmware_bridge/ros2/test_ros2_config.py \
	tests/firmware_bridge/unitree/test_robot_state.py
coverage: .venv/.test-installed
	OMP_NUM_THREADS=1 $(BIN)/coverage run --data-file=.venv/coverage -m pytest -q -m "not slow and not process" $(COVERING)
	$(BIN)/coverage report --data-file=.venv/coverage

mutants: .venv/.test-installed
	OMP_NUM_THREADS=1 $(BIN)/python -m tools.mutants

clean:
	rm -rf out
