# Everything starts from Python 3.11 and pip; no system packages are needed.
PYTHON ?= python3.11
BIN = .venv/bin
# Small dense matrices: one BLAS thread is 3 to 10 times faster than several.
export OPENBLAS_NUM_THREADS = 1
export OMP_NUM_THREADS = 1

.PHONY: install test fast test-slow demo docs gallery lint bench clean

$(BIN)/.installed: pyproject.toml constraints.txt
	@echo "Installing into .venv: a minute or two"
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	@echo "Compiling the numerical kernels once, and checking that all works here"
	$(BIN)/avis doctor
	touch $@

install: $(BIN)/.installed

lint: $(BIN)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# By file, so that what the tests of a file share is computed once; in the order of the folders, because files with few
# tests, the slowest among them, would otherwise come last.
TEST = $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

# The linters take one core for a minute and a half: side by side with the tests.
test: $(BIN)/.installed
	$(MAKE) --no-print-directory --jobs 2 lint fast

fast: $(BIN)/.installed
	$(TEST) -m "not slow"

test-slow: lint
	AVIS_EXPLORE=1 $(TEST)

demo: $(BIN)/.installed
	$(BIN)/avis design designs/avis_z_phix.toml --out reports/avis_z_phix
	$(BIN)/avis simulate-campaign --rig avis --plan designs/plans/lagging_amplifiers.toml --out reports/lagging_amplifiers.h5
	$(BIN)/avis gap reports/lagging_amplifiers.h5 --rig avis --out reports/lagging_amplifiers

# Every example is run, so that no figure is older than the code; AVIS_DOCS=check builds without running them.
docs: $(BIN)/.installed
	PATH=$(BIN):$$PATH PYTHONPATH=. NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "Open build/site/index.html; the search needs a server: $(BIN)/python -m http.server -d build/site"

gallery: export AVIS_DOCS = gallery
gallery: docs

# Minutes each; the campaigns of hours beside them (gates, random_plants, sound_campaigns, mutations, own_tables, blind)
# and those of half an hour (design_orders, shipped_designs) are started by hand.
BENCHMARKS = ekf_vs_filterpy hinfsyn interval_coverage maximum_likelihood mu_upper musyn_vs_dkpy sequential sweep

# The peers that we measure ourselves against are no dependency of the product.
bench: $(BIN)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[benchmarks]"
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name || exit 1; done

clean:
	rm -rf .venv build *.egg-info
