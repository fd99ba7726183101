# make demo | make test | make check: each makes .venv where it is missing and installs everything it needs.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
NATIVE := CMakeLists.txt $(wildcard meshanim/native/*.* meshanim/native/*/*.*)

.PHONY: demo test check install clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt $(NATIVE)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,speech,encoders,cluster,data,serve,usd]"
	touch $@

test: install
	$(BIN)/python -m pytest -n 2

demo: install
	$(BIN)/meshanim demo -o demo.mp4

# Lint, format, and types of the installed layout.
check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build/typecheck
	MESHANIM_NATIVE=0 $(BIN)/pip install --quiet --disable-pip-version-check --no-deps --target build/typecheck .
	cd build/typecheck && $(abspath $(BIN))/mypy --config-file $(abspath pyproject.toml) -p meshanim

clean:
	rm -rf $(VENV) build
