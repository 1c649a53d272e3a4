# `make demo` and `make test` need Python >= 3.11 and make; the rest is installed into .venv.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
DEMO := build/demo
# Posed images to measure on, where there are any: folders with images/ and sparse/.
DATA := ../shared/data
KITCHEN := $(DATA)/7scenes_redkitchen
# Everyday pictures without poses, a tenth of which no training sees.
PHOTOGRAPHS := ../shared/train_images/images
# `make install`, docs/install.md: packages set DESTDIR and PREFIX=/usr; EXTRAS=oak,foxglove (pyproject.toml).
PREFIX ?= /usr/local
EXTRAS ?=
# `make soak`.
SECONDS ?= 600
LIB = $(DESTDIR)$(PREFIX)/lib
SETTINGS = $(DESTDIR)/etc/trigpoint/trigpoint.toml

.PHONY: demo test kill-test test-oak test-systemd test-v4l2 check golden
.PHONY: bench bench-building bench-models bench-localizer bench-daemon bench-maps walkthrough soak wheel-test clean
.PHONY: experiments
.PHONY: install install-program install-units uninstall

# uv where it is installed, else venv and pip.
$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@echo "Installing into .venv..."
	@if command -v uv >/dev/null 2>&1; then \
	  test -x $(BIN)/python || uv venv --quiet --python $(PYTHON) .venv; \
	  uv pip install --quiet --python $(BIN)/python --editable '.[plots]' --group dev; \
	else \
	  test -x $(BIN)/pip || $(PYTHON) -m venv .venv; \
	  $(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'; \
	  $(BIN)/python -m pip install --quiet --editable '.[plots]' --group dev; \
	fi
	@touch $@

demo: $(READY)
	@PATH="$(CURDIR)/$(BIN):$$PATH" sh demo.sh $(DEMO)

test: $(READY)
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(READY)
	$(BIN)/ruff format --no-cache --check .
	$(BIN)/ruff check --no-cache .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python -m pytest -n auto --dist loadfile

# A map changed by processes that are killed at random moments; half a minute.
kill-test: $(READY)
	$(BIN)/python -m tests.unit.run_kills 200

# The camera source on a real kernel's virtual camera, in qemu; about a minute.
test-v4l2: $(READY)
	sh tests/v4l2/boot.sh $(abspath $(BIN))/python

# The installed service under a real systemd, in qemu.
test-systemd: $(READY)
	sh tests/systemd/boot.sh $(abspath $(BIN))/python

# Re-record the poses that the replay tests compare with.
golden: $(READY)
	$(BIN)/python -m pytest tests/replay --golden

# Stage times on the real kitchen where the data are, else on the demo's room.
bench: $(READY)
	@mkdir -p build/bench && rm -f build/bench/map.tpmap
	@if test -d $(KITCHEN); then \
	  $(BIN)/trigpoint-db build build/bench/map.tpmap $(KITCHEN) \
	    --list $(KITCHEN)/map.txt >/dev/null && \
	  $(BIN)/python benchmarks/stage_times.py build/bench/map.tpmap \
	    --images $(KITCHEN)/images --queries $(KITCHEN)/queries.txt; \
	else \
	  test -f $(DEMO)/map.tpmap || $(BIN)/trigpoint-db demo $(DEMO); \
	  $(BIN)/python benchmarks/stage_times.py $(DEMO)/map.tpmap \
	    --images $(DEMO)/flight --queries $(DEMO)/queries.txt; \
	fi

# Images a second that maps are built with, on the same data.
bench-building: $(READY)
	test -d $(KITCHEN) || test -d $(DEMO)/survey || $(BIN)/trigpoint-db demo $(DEMO)
	$(BIN)/python -m benchmarks.building \
	  $(if $(wildcard $(KITCHEN)),$(KITCHEN),$(DEMO))

# Our networks beside RootSIFT and, where its checkout is named, EdgePoint2, which needs torch:
# make bench-models EDGEPOINT2=../EdgePoint2 FP32=build/fp32
bench-models: $(READY)
	@mkdir -p build/bench
	$(BIN)/python -m benchmarks.models $(DATA) \
	  $(if $(wildcard $(PHOTOGRAPHS)),--photographs $(PHOTOGRAPHS)) \
	  $(if $(EDGEPOINT2),--edgepoint2 '$(EDGEPOINT2)') $(if $(FP32),--fp32 '$(FP32)') \
	  --output build/bench/models.md --json build/bench/models.json

# The localizer: accuracy and speed beside hloc where its checkout is named (it needs the extra
# `colmap`, h5py, tqdm and packaging), the K sweep, the covariance, wrong poses, memory:
# make bench-localizer HLOC=../Hierarchical-Localization EDGEPOINT2=../EdgePoint2
bench-localizer: $(READY)
	@mkdir -p build/bench
	$(BIN)/python -m benchmarks.localizer $(DATA) \
	  $(if $(HLOC),--hloc '$(HLOC)') $(if $(EDGEPOINT2),--edgepoint2 '$(EDGEPOINT2)') \
	  --output build/bench/localizer.md --picture build/bench/reliability.png

# What the daemon adds to the localizer's time, from a camera to a subscriber; about 6 minutes.
bench-daemon: $(READY) $(DEMO)/map.tpmap
	@mkdir -p build/bench
	$(BIN)/python -m benchmarks.daemon.overhead $(DEMO) --output build/bench/daemon.md

# Whether memory and latency stay flat: make soak SECONDS=86400
soak: $(READY) $(DEMO)/map.tpmap
	$(BIN)/python -m benchmarks.daemon.soak $(DEMO) build/soak --seconds $(SECONDS)

$(DEMO)/map.tpmap: | $(READY)
	$(BIN)/trigpoint-db demo $(DEMO)

# The paper's experiments, as far as they need no public data set, and docs/experiments.md; about
# 14 minutes. What is interrupted goes on. INT8 is compared with FP32 where that network is, times with
# hloc's where its checkout is named (it needs h5py, tqdm and packaging):
# make experiments HLOC=../Hierarchical-Localization
EXPERIMENTS := build/experiments
FLOAT = $(or $(FP32),$(wildcard build/fp32))
experiments: $(READY)
	$(BIN)/trigpoint-db experiment noise --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment averaging --data $(DATA) --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment anchors --data $(DATA) --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment ablation --data $(DATA) --output $(EXPERIMENTS) \
	  $(if $(FLOAT),--fp32 '$(FLOAT)') >/dev/null
	$(BIN)/trigpoint-db experiment methods --data $(DATA) --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment timing --data $(DATA) --output $(EXPERIMENTS) \
	  $(if $(HLOC),--hloc '$(HLOC)') >/dev/null
	$(BIN)/trigpoint-db experiment redkitchen --data $(DATA) --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment recall --data $(DATA) --output $(EXPERIMENTS) >/dev/null
	$(BIN)/trigpoint-db experiment page $(EXPERIMENTS) docs
	rm -rf $(EXPERIMENTS)/maps $(EXPERIMENTS)/room # the next run measures anew

# Profiles of maps, and retrieval in maps of up to a million images; ten minutes and 2 GB.
bench-maps: $(READY)
	@mkdir -p build/bench
	$(BIN)/python -m benchmarks.maps $(DATA) --output build/bench/maps.md

# What the commands on maps print on real sets, into docs/maps.md; some five minutes.
walkthrough: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m benchmarks.maps.walkthrough $(DATA)

# The suite against the installed wheel, not the checkout.
wheel-test: $(READY)
	sh tests/run_against_wheel.sh

# OAK cameras, without one: DepthAI is 350 MB, so the other targets leave it out.
test-oak: $(READY)
	@if command -v uv >/dev/null 2>&1; then \
	  uv pip install --quiet --python $(BIN)/python --editable '.[oak]'; \
	else \
	  $(BIN)/python -m pip install --quiet --editable '.[oak]'; \
	fi
	$(BIN)/python -m pytest tests/daemon/test_depthai_source.py

install: install-program install-units

install-program:
	$(PYTHON) -m venv --clear '$(LIB)/trigpoint'
	'$(LIB)/trigpoint/bin/python' -m pip install --quiet '.$(if $(EXTRAS),[$(EXTRAS)])'
ifneq ($(DESTDIR),) # where scripts look for their interpreter
	grep -rlI '$(abspath $(DESTDIR))' '$(LIB)/trigpoint/bin' | xargs sed -i 's|$(abspath $(DESTDIR))||g'
endif
	install -d '$(DESTDIR)$(PREFIX)/bin'
	ln -sf ../lib/trigpoint/bin/trigpointd ../lib/trigpoint/bin/trigpoint-db '$(DESTDIR)$(PREFIX)/bin'

# Settings that are there already stay.
install-units:
	install -d '$(LIB)/systemd/system'
	for unit in trigpointd trigpointd@ trigpoint-fetch@; do \
	  sed 's|/usr/local|$(PREFIX)|' systemd/$$unit.service >'$(LIB)/systemd/system/'$$unit.service; done
	install -Dm644 systemd/70-trigpoint.rules '$(LIB)/udev/rules.d/70-trigpoint.rules'
	install -Dm644 systemd/trigpoint.sysusers '$(LIB)/sysusers.d/trigpoint.conf'
	install -Dm644 systemd/trigpoint.tmpfiles '$(LIB)/tmpfiles.d/trigpoint.conf'
	test -e '$(SETTINGS)' || install -Dm644 systemd/trigpoint.toml '$(SETTINGS)'

# Leaves settings, maps and logs.
uninstall:
	rm -rf '$(LIB)/trigpoint'
	rm -f '$(DESTDIR)$(PREFIX)/bin/trigpointd' '$(DESTDIR)$(PREFIX)/bin/trigpoint-db' \
	  '$(LIB)/systemd/system/trigpointd.service' '$(LIB)/systemd/system/trigpointd@.service' \
	  '$(LIB)/systemd/system/trigpoint-fetch@.service' \
	  '$(LIB)/udev/rules.d/70-trigpoint.rules' '$(LIB)/sysusers.d/trigpoint.conf' \
	  '$(LIB)/tmpfiles.d/trigpoint.conf'

clean:
	rm -rf .venv build dist
