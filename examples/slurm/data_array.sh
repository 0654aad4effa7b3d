#!/usr/bin/env bash
# A sweep in N independent parts, one process each, over one run directory; they share its cache and wait for each other's stages:
#   sbatch --array=1-16 examples/slurm/data_array.sh experiments/my_sweep.yaml
#SBATCH --job-name=reviv-part
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=12
#SBATCH --time=12:00:00
#SBATCH --output=%x-%A-%a.log
#SBATCH --signal=TERM@120
#SBATCH --array=1-16
set -euo pipefail

experiment=${1:?usage: sbatch --array=1-N data_array.sh EXPERIMENT [OPTION ...]}
shift

# An array's numbers may start anywhere and leave gaps of a step (`--array=0-30:2`); parts are 1 to n.
step=${SLURM_ARRAY_TASK_STEP:-1}
part=$(((SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN) / step + 1))

export RAYON_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}
srun --ntasks=1 reviv run "$experiment" --shard "$part/$SLURM_ARRAY_TASK_COUNT" "$@"
