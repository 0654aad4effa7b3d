#!/bin/bash
# Converts a data set with as many processes as the array has, each a part of the shards, into one folder on a shared disk:
#   sbatch --array=1-16 examples/slurm/convert.sh /data/nymeria /scratch/nymeria_clips --kind nymeria
# A part that is stopped goes on where it was when it is submitted again; `reviv data verify` says what is missing.
#SBATCH --job-name=reviv-convert
#SBATCH --cpus-per-task=8
#SBATCH --mem=16G
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail

recordings=$1
clips=$2
shift 2
# An array's numbers may start anywhere and leave gaps of a step (`--array=0-30:2`); parts are 1 to n.
parts=${SLURM_ARRAY_TASK_COUNT:-1}
part=$(((${SLURM_ARRAY_TASK_ID:-1} - ${SLURM_ARRAY_TASK_MIN:-1}) / ${SLURM_ARRAY_TASK_STEP:-1} + 1))

exec reviv data convert "$recordings" -o "$clips" --shard "$part/$parts" "$@"
