# make demo    train on the Forest, evaluate 1000 episodes, record them, print the report
# make test    run the tests
# make lint    ruff and mypy
# make soak    the tests of failures in full: 200 kills, every failing operation, the whole corpus of hostile runs
# make bench   throughput on this machine
# make cluster          sweeps on a Slurm of this machine and on a Ray of two nodes, with failures (Debian, as root)
# make cluster-scaling  what a sweep costs besides the runs: 1 and 2 workers, 10 000 run folders
# make bound   all tests of the time-optimal solver, published races included
# make unseen-references T_ref of the unseen maps, MAPS of each level (100), on from what is solved
# make thrust-figure     the optimum against thrust-to-weight: table, and docs/images/thrust_to_weight.png
# make certificates      fly a certificate of every map of the presets: srlrace/task/certificates.json
# make starts            which starts of the evaluations nothing survives
# make reference         publish the finished runs: runs/* to runs/reference/*, packed, without checkpoints and recordings
# make pictures           all pictures of the documentation, from the published runs (Chromium); its two halves:
# make report-pictures    commands in the terminal, the report's page and figures, in docs/images
# make replay-pictures    the replay's pictures in docs/images, from the published runs (Chromium)
# make vendor             bundle three.js anew for the replay page (npm)
# Both build the same virtual environment first. PYTHON and VENV may be set on the command line.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed-$(shell cat pyproject.toml constraints.txt | cksum | cut -d' ' -f1)
NODE_MODULES := tests/readers/node_modules
AXE := tests/browser/node_modules

.PHONY: demo test lint bench bound unseen-references thrust-figure certificates starts pictures reference readers browser-tools replay-pictures report-pictures vendor cluster cluster-scaling soak clean

demo: $(STAMP)
	$(BIN)/srlrace train env=forest algo.total_steps=15_000_000
	$(BIN)/srlrace eval --episodes 1000
	$(BIN)/srlrace report

test: $(STAMP) readers browser-tools
	$(BIN)/python -m pytest

bound: $(STAMP)
	SRLRACE_BOUND=1 $(BIN)/python -m pytest tests/unit/bound -v --durations=10

MAPS ?= 100

unseen-references: $(STAMP)
	$(BIN)/python -m srlrace.bound.unseen $(MAPS)

thrust-figure: $(STAMP)
	$(BIN)/python -m srlrace.bound.thrust docs/images/thrust_to_weight.png

certificates: $(STAMP)
	$(BIN)/python -m srlrace.evaluation.certify

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/srlrace bench

pictures: replay-pictures report-pictures

REPORT_RUNS ?= runs/reference
report-pictures: $(STAMP) browser-tools
	$(BIN)/srlrace report --runs $(REPORT_RUNS) --out results
	-cp results/figures/minimum_time-forest-trajectories.png docs/images/forest.png
	$(BIN)/python docs/images/report_pictures.py $(REPORT_RUNS) docs/images

REPLAY_RUNS ?= runs/reference
REPLAY_FOREST ?= forest-srl_tuned-s0-cb2b0196
REPLAY_SPLIT_S ?= split_s-srl_tuned-s0-42ccef87
replay-pictures: $(STAMP) browser-tools
	$(BIN)/python docs/images/replay_pictures.py $(REPLAY_RUNS) $(REPLAY_FOREST) $(REPLAY_SPLIT_S) results

THREE := srlrace/replay/web/three
vendor:
	npm ci --silent --no-audit --no-fund --prefix $(THREE)
	npm run --silent --prefix $(THREE) build
	cp $(THREE)/node_modules/three/LICENSE $(THREE)/LICENSE

starts: $(STAMP)
	for suite in level1 level2 level3; do \
		$(BIN)/python -m srlrace.evaluation.starts env=forest level=mixed --suite $$suite || exit; done
	for track in forest split_s; do \
		$(BIN)/python -m srlrace.evaluation.starts env=$$track --suite train_map || exit; done

reference: $(STAMP)
	$(BIN)/python -m srlrace.report.publish runs runs/reference

# The TypeScript MCAP reader, a test's independent witness; without npm that test is skipped.
readers:
	@if command -v npm >/dev/null; then \
		test -d $(NODE_MODULES) || npm ci --silent --no-audit --no-fund --prefix tests/readers; \
	else echo "npm not found: the TypeScript reader's tests will be skipped"; fi

# Chromium opens the pages that srlrace writes, axe-core checks their accessibility; without them those tests are skipped.
browser-tools:
	@if ! command -v chromium >/dev/null && command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium \
			fonts-inter >/dev/null; fi || true
	@command -v chromium >/dev/null || echo "chromium not found: the tests of HTML pages will be skipped"
	@if command -v npm >/dev/null; then \
		test -d $(AXE) || npm ci --silent --no-audit --no-fund --prefix tests/browser; \
	else echo "npm not found: the accessibility of HTML pages will not be tested"; fi

$(STAMP):
	@$(PYTHON) -c 'import sys; sys.exit("srlrace needs Python 3.11 or newer") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@rm -f $(VENV)/.installed-*
	@touch $@

# Installs Slurm from Debian's packages and the extras, starts daemons in temporary folders, and stops them again.
cluster: $(STAMP)
	@command -v slurmctld munged >/dev/null || (apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
		apt-get install -y -qq --no-install-recommends slurm-wlm munge >/dev/null) \
		|| echo "no slurm-wlm: the tests of Slurm will be skipped"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[slurm,ray]'
	SRLRACE_CLUSTER=1 $(BIN)/python -m pytest tests/cluster -v -rs

cluster-scaling: $(STAMP)
	$(BIN)/python tests/cluster/scaling.py

# Kills, failing disks, damage, signals, hostile runs, in full: 41 minutes on one core while the other was busy.
soak: $(STAMP)
	SRLRACE_SOAK=1 $(BIN)/python -m pytest tests/failures -vv --durations=10

clean:
	rm -rf $(VENV) $(NODE_MODULES) $(AXE) .pytest_cache .mypy_cache .ruff_cache .hypothesis
