#!/bin/sh
# Train the bundled weights on a GPU, from pictures to weights:
#   recipes/gpu.sh pack PICTURES ROOMS -o pack.zip     here, on a CPU: one file with all that is read
#   recipes/gpu.sh train pack.zip -o OUT --seconds 540 on the machine with the GPU; --tiny tries it on a CPU
#   recipes/gpu-check.sh pack.zip                      before it: does the GPU compute the same, and how fast
# Rooms: improvo simulate -o ROOMS/rSEED --seed SEED --frames 26 --fps 3 --size 640x480 --grey, one folder each.
set -e
here=$(dirname "$0")
verb=$1
shift
case $verb in
pack) exec "${PYTHON:-python3}" "$here/gpu_pack.py" "$@" ;;
train) exec "${PYTHON:-python3}" "$here/gpu_train.py" "$@" ;;
*) sed -n '2,7s/^# \{0,1\}//p' "$0"; exit 2 ;;
esac
