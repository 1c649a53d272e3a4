#!/bin/sh
# Build the wheel, install it into an environment of its own, and run the suite against it from a
# folder that holds nothing but the tests.
set -eu
work=build/wheel-test
rm -rf "$work"
mkdir -p "$work/run"
if command -v uv >/dev/null 2>&1; then
  uv build --quiet --wheel --out-dir "$work"
  uv venv --quiet --python .venv/bin/python "$work/venv"
  uv pip install --quiet --python "$work/venv/bin/python" "$(echo "$work"/*.whl)[plots]" --group dev
else
  .venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir "$work" .
  .venv/bin/python -m venv "$work/venv"
  "$work/venv/bin/python" -m pip install --quiet --upgrade 'pip>=25.1'
  "$work/venv/bin/python" -m pip install --quiet "$(echo "$work"/*.whl)[plots]" --group dev
fi
cp -R tests pyproject.toml "$work/run"
cd "$work/run"
../venv/bin/python -c 'import trigpoint; assert "site-packages" in trigpoint.__file__, trigpoint'
# The code that trains, or measures, is in no wheel; accuracy is that of the checkout.
exec ../venv/bin/python -m pytest -n auto --dist loadfile -o pythonpath=. -p no:cacheprovider \
  --ignore tests/training --ignore tests/benchmarks --ignore tests/data
