#!/bin/sh
# The first minutes on a GPU: does it compute what CPUs compute, and how fast? Some three minutes on an H200.
#
#     sh benchmarks/first_minutes_on_a_gpu.sh [FOLDER]    # times.json and the tests' output go there
#
# Then, anywhere: python benchmarks/gpu.py --times FOLDER/times.json writes benchmarks/gpu.md.
set -eu
folder=${1:-first-minutes}
python=${PYTHON:-python}
mkdir -p "$folder"
nvidia-smi -L
"$python" -m pytest -q tests/native/test_on_gpu.py | tee "$folder/tests.txt"
"$python" benchmarks/gpu.py --times-to "$folder/times.json"
