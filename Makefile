PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: venv demo test lint docs bench pictures clean \
    docs/camera.png docs/truth.png docs/learned.png docs/clutter.png docs/run-mcap.png docs/photo.png

demo: venv
	$(BIN)/voxscene demo --out demo

test: venv
	$(BIN)/pytest -n 2 --dist loadfile  # tests of a file share kernels

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads 2
	$(BIN)/lint-imports

docs: venv
	$(BIN)/mkdocs build --strict --quiet

bench: venv
	$(BIN)/voxscene bench speed
	$(BIN)/voxscene bench sampler
	$(BIN)/voxscene bench slam --rooms 2
	$(BIN)/voxscene bench poses --tables 10

# The pictures in docs/, of real recordings in DATA (7-Scenes, the hand-held shelf, YCB-Video).
DATA ?= ../shared/data
RUNS := build/pictures

pictures: docs/camera.png docs/truth.png docs/learned.png docs/clutter.png docs/run-mcap.png docs/photo.png

docs/camera.png: venv
	mkdir -p $(RUNS)
	$(BIN)/voxscene import 7scenes $(DATA)/sevenscenes_redkitchen $(RUNS)/kitchen.mcap --frames 0:60
	$(BIN)/voxscene slam $(RUNS)/kitchen.mcap -o $(RUNS)/kitchen.run
	$(BIN)/voxscene review $(RUNS)/kitchen.run --screenshot $@

docs/truth.png: docs/camera.png
	$(BIN)/voxscene review $(RUNS)/kitchen.run --truth $(RUNS)/kitchen.mcap --screenshot $@

docs/learned.png: venv
	mkdir -p $(RUNS)
	$(BIN)/voxscene import 7scenes $(DATA)/apc_shelf_handheld $(RUNS)/shelf.mcap
	$(BIN)/voxscene learn $(RUNS)/shelf.mcap --name shelf -o $(RUNS)/shelf.run
	$(BIN)/voxscene review $(RUNS)/shelf.run --screenshot $@

docs/clutter.png: venv
	mkdir -p $(RUNS)
	$(BIN)/voxscene import bop $(DATA)/ycbv/scenes/0001 $(RUNS)/clutter.mcap
	$(BIN)/voxscene parse $(RUNS)/clutter.mcap --shapes $(DATA)/ycbv/models -o $(RUNS)/clutter.run \
	    --objects 002_master_chef_can,003_cracker_box,004_sugar_box,006_mustard_bottle
	$(BIN)/voxscene review $(RUNS)/clutter.run --screenshot $@

docs/run-mcap.png: docs/clutter.png
	$(BIN)/python -c "from pathlib import Path; from pipeline.views.screenshot import take_screenshot as take; \
	    take([Path('$(RUNS)/clutter.run/run.mcap')], Path('$@'), (1600, 1000), None)"

docs/photo.png: venv
	mkdir -p $(RUNS)/simple
	$(BIN)/voxscene synth air $(RUNS)/photo --scenes 1 --seed 102 --size 320x240
	$(BIN)/python -c "from pipeline.synthesis.air import air_meshes; \
	    [mesh.export(f'$(RUNS)/simple/{name}.ply') for name, mesh in air_meshes().items()]"
	$(BIN)/voxscene parse $(RUNS)/photo/air_000102.mcap --shapes $(RUNS)/simple --colour only -s parse.gamma=1 \
	    --light=-0.4,-0.5,0.77,0.4 -o $(RUNS)/photo.run
	$(BIN)/voxscene review $(RUNS)/photo.run --screenshot $@ --size 1200x760

venv: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	PYTHON=$(PYTHON) .ci/system-libraries
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --group dev --editable .
	$(BIN)/python -m compileall -q -j 0 $(VENV)/lib || true  # on all cores; some files are of other Pythons
	touch $@

clean:
	rm -rf $(VENV) demo
