#!/bin/sh
# Two minutes on a GPU before recipes/gpu.sh: gpu-check.sh pack.zip [--compile] [--tiny]
exec "${PYTHON:-python3}" "$(dirname "$0")/gpu_check.py" "$@"
