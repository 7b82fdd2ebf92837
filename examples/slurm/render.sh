#!/bin/bash
# Renders a movie as an array job of SLURM, and joins it when all parts have ended well.
#
#   bash render.sh runs/place movies/flood 32 --flood.level "0.5 m" --frames 960 --size 960x540
#
# The arguments are the run, the folder of the movie, the number of parts, and flags of `climatenerf
# render`. Both folders must be on a disk that all nodes share. Submit it again after a failure: frames
# that are finished are not rendered again.
set -euo pipefail

run=$1 out=$2 parts=$3
shift 3
mkdir -p "$out/logs"

# A part takes every 32nd frame, so that all parts cost about the same. One core per part makes the most
# of a node; the threads of the kernels follow NUMBA_NUM_THREADS and OMP_NUM_THREADS.
array=$(sbatch --parsable --job-name=frames --array="1-$parts" --cpus-per-task=1 --mem=4G \
    --time=12:00:00 --output="$out/logs/%a.log" --export=ALL,NUMBA_NUM_THREADS=1,OMP_NUM_THREADS=1 \
    --wrap="$(printf '%q ' climatenerf render "$run" -o "$out" "$@") --part \$SLURM_ARRAY_TASK_ID/$parts")

sbatch --job-name=join --dependency="afterok:${array%%;*}" --kill-on-invalid-dep=yes \
    --cpus-per-task=1 --mem=4G --time=1:00:00 \
    --output="$out/logs/join.log" \
    --wrap="$(printf '%q ' climatenerf render "$run" -o "$out" "$@" --join)"
