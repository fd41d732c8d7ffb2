PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: venv demo test lint docs bench clean

demo: venv
	$(BIN)/voxscene demo --out demo

test: venv
	$(BIN)/pytest -n 2

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: venv
	$(BIN)/mkdocs build --strict --quiet

bench: venv
	$(BIN)/voxscene bench speed
	$(BIN)/voxscene bench sampler
	$(BIN)/voxscene bench slam --rooms 2
	$(BIN)/voxscene bench poses --tables 10

venv: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	PYTHON=$(PYTHON) .ci/system-libraries
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/pip install --quiet --constraint constraints.txt --group dev --editable .
	touch $@

clean:
	rm -rf $(VENV) demo
