# `make run` and `make test` work in a clean clone with Python 3.11+ and nothing else.
PYTHON ?= python3
BIN := .venv/bin
# A program of the tests starts twice as fast if its modules need not be compiled again.
export PYTHONDONTWRITEBYTECODE =

.PHONY: run test coverage check format schema sim fuzz soak mutants faults histories operator upgrade bench scenarios peers plant reloads pictures pins crowd bridges archive fleet parsers contract docs clean sbom release bundle

run: .venv/installed
	$(BIN)/plc-gateway run config.example.yaml

# Six workers also on two cores: many tests wait for real time, and their waits overlap.
test: .venv/ready
	$(BIN)/python -m pytest -n 6 --dist worksteal

# Branch coverage of the suite; subprocesses are not counted.
coverage: .venv/ready
	$(BIN)/python -m pytest -n 6 --dist worksteal --cov --cov-report=term --cov-report=html:build/coverage

check: .venv/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: .venv/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

schema: .venv/installed
	$(BIN)/plc-gateway schema > config.schema.json
	$(BIN)/python -m benchmarks.schemas

# The gateway against its aims, in about nine minutes. The second line writes docs/performance.md.
# Other benchmarks are programs of their own: python -m benchmarks.NAME.
bench: .venv/ready
	$(BIN)/python -m benchmarks.performance --json benchmarks/results/performance.json
	$(BIN)/python -m benchmarks.performance --docs

# The scenarios that other gateways publish, every value checked; about nine minutes. The second
# line writes docs/scenarios.md.
scenarios: .venv/ready
	$(BIN)/python -m benchmarks.scenarios --peers --json benchmarks/results/scenarios.json
	$(BIN)/python -m benchmarks.scenarios --docs

# Reloads under load: memory, missed polls, what is left over.
reloads: .venv/ready
	$(BIN)/python -m benchmarks.reload

# Each view of the page, on a phone, a laptop and a wall display, in light and dark, with and without
# faults: in build/pictures.
pictures: .venv/ready
	$(BIN)/python -m benchmarks.pictures

# This gateway beside its peers (docs/peers.md); .ci/install-peers installs them.
peers: .venv/ready
	$(BIN)/python -m benchmarks.peers

# Ten gateways and three routers, some of them killed (docs/scale.md); takes about seven minutes.
plant: .venv/ready
	$(BIN)/python -m benchmarks.routers
	$(BIN)/python -m benchmarks.plant

clean:
	rm -rf .venv build dist *.egg-info .coverage

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; v = sys.version_info; v >= (3, 11) or sys.exit('This is Python %d.%d, \
	the gateway needs 3.11 or newer. Name one: make PYTHON=python3.12 $(MAKECMDGOALS)' % v[:2])"
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --require-hashes --requirement constraints.txt
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

.venv/ready: .venv/installed constraints-dev.txt
	$(BIN)/pip install --quiet --require-hashes --requirement constraints-dev.txt
	touch $@

# Notes the hashes of all files of each package, for every system. `make pins NEW=--upgrade` also
# takes newer versions. `make sbom` follows.
PINS = echo 'hatchling>=1.28' | $(BIN)/uv pip compile - --quiet --universal $(NEW) --no-header \
    --python-version 3.11 --generate-hashes --no-annotate
PINNED = '2i \# `make pins` makes this file from pyproject.toml; it keeps the versions that are here.'

pins: .venv/ready
	$(BIN)/pip install --quiet 'uv~=0.13'
	$(PINS) --output-file constraints.txt pyproject.toml
	$(PINS) --output-file constraints-dev.txt pyproject.toml --all-extras --constraint constraints.txt
	$(PINS) --output-file constraints-bridges.txt pyproject.toml --extra mqtt --extra opcua \
	    --constraint constraints-dev.txt
	$(PINS) --output-file constraints-release.txt --group release --constraint constraints-dev.txt
	$(PINS) --output-file constraints-ros2.txt --group ros2 --constraint constraints.txt
	$(PINS) --output-file constraints-s3.txt --group s3
	sed -i '1i # A server of S3, for the tests of the archive, each package with the hashes of its files.' constraints-s3.txt
	sed -i '1i # ROS 2, for the tests of its bridge, each package with the hashes of its files.' constraints-ros2.txt
	sed -i '1i # The packages that the gateway runs with, and hatchling to build it, each with the hashes of its files.' constraints.txt
	sed -i '1i # The packages of constraints.txt and those of the bridges to MQTT and OPC UA, each with the hashes of its files.' constraints-bridges.txt
	sed -i '1i # The packages that developers and tests need, with those of constraints.txt, each with the hashes of its files.' constraints-dev.txt
	sed -i '1i # The packages that build a release, each with the hashes of its files.' constraints-release.txt
	sed -i $(PINNED) constraints.txt constraints-bridges.txt constraints-dev.txt constraints-release.txt constraints-ros2.txt constraints-s3.txt

# Programs that build a release; in a place of their own.
build/tools/ready: constraints-release.txt
	$(PYTHON) -m venv build/tools
	build/tools/bin/pip install --quiet --upgrade pip
	build/tools/bin/pip install --quiet --require-hashes --requirement constraints-release.txt
	touch $@

# The bill of materials that each wheel contains: the packages of constraints.txt, as they describe
# themselves, without those that only build.
BUILDERS = hatchling packaging pathspec pluggy tomlkit trove-classifiers
INTO_SBOM = build/tools/bin/pip --python build/sbom/bin/python

sbom: build/tools/ready
	$(PYTHON) -m venv --clear --without-pip build/sbom
	$(INTO_SBOM) install --quiet --require-hashes --requirement constraints.txt
	$(INTO_SBOM) install --quiet --no-deps --no-build-isolation .
	$(INTO_SBOM) uninstall --quiet --yes $(BUILDERS)
	build/tools/bin/python -m tools.sbom build/sbom

# Wheel, sdist, bill of materials and an archive for machines without a network: in dist/, built
# twice from the last commit. Fails if a bit is different.
release: build/tools/ready
	build/tools/bin/python -m tools.release

# The pages as a site with a search, in build/site: fails at a warning, or if the search does not
# lead a newcomer to the right page. It needs Chromium.
docs: build/tools/ready
	build/tools/bin/python -m tools.site

# The same with an archive for fewer machines: make bundle MACHINES=armv7l PYTHONS="3.11 3.13"
bundle: build/tools/ready
	build/tools/bin/python -m tools.release $(if $(MACHINES),--machines "$(MACHINES)") \
	    $(if $(PYTHONS),--pythons "$(PYTHONS)")

# Long proofs (docs/contributors/proof.md); a short slice of each runs with the tests.
SEEDS ?= 0-19
HOURS ?= 1
PACE ?= busy
EXAMPLES ?= 20000
KILLS ?= 200
MINUTES ?= 30
SAMPLE ?= 50
SEED ?= 0

sim: .venv/ready
	$(BIN)/python -m tests.sim.campaign --seeds $(SEEDS) --hours $(HOURS) --pace $(PACE) \
	    $(if $(ONLY),--only $(ONLY)) $(if $(PART),--part $(PART)) \
	    $(if $(RESULT),--result $(RESULT)) $(if $(WORKERS),--workers $(WORKERS))

fuzz: .venv/ready
	EXAMPLES=$(EXAMPLES) $(BIN)/python -m pytest -q -o faulthandler_timeout=0 tests/fuzz

soak: .venv/ready
	$(BIN)/python -m tests.faults.soak --minutes $(MINUTES)

contract: .venv/ready
	$(BIN)/python -m benchmarks.contract_reader --minutes $(MINUTES)

mutants: .venv/ready
	$(BIN)/python -m tests.sim.mutants --sample $(SAMPLE) --seed $(SEED) $(ONLY) \
	    $(if $(WORKERS),--workers $(WORKERS))

# Faults as an operator meets them, and what each place says of them (docs/find-a-fault.md).
operator: .venv/ready
	$(BIN)/python -m tests.faults.operator

# Writes with faults, checked against what the PLC did.
histories: .venv/ready
	$(BIN)/python -m tests.faults.histories

# Bridges, brokers and gateways killed at random; what their clients show (docs/contributors/bridges.md).
bridges: .venv/ready
	$(BIN)/python -m tests.bridges.campaign --hours $(HOURS) --seed $(SEED)

# Archivers, databases and gateways killed at random; what the archive has then (docs/archive.md).
archive: .venv/ready
	$(BIN)/python -m tests.archive.campaign --kills $(KILLS) --seed $(SEED)

# 1,000 gateways behind three routers: seen, changed, parted and killed (docs/fleet.md).
fleet: .venv/ready
	$(BIN)/python -m benchmarks.fleet

# Ten gateways in network namespaces get a new version, one after the other; one has a bug
# (docs/upgrade-fleet.md).
upgrade: .venv/ready
	$(BIN)/python -m tests.faults.upgrade

# 10,000 connections to the page of a gateway that runs.
crowd: .venv/ready
	$(BIN)/python -m tests.attacks.crowd 10000

# Every parser, led by the branches that it takes: first `pip install atheris` (docs/contributors/proof.md).
parsers: .venv/ready
	$(BIN)/python -m tests.fuzz.long --minutes $(MINUTES)

faults: .venv/ready
	RESTARTS=200 $(BIN)/python -m pytest -q -o faulthandler_timeout=0 tests/faults
