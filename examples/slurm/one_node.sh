#!/usr/bin/env bash
# One node, one process per device (or per part of the processor):
#   sbatch examples/slurm/one_node.sh experiments/my.yaml
#SBATCH --job-name=reviv
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=8
#SBATCH --cpus-per-task=12
#SBATCH --time=24:00:00
#SBATCH --output=%x-%j.log
# Two minutes before the end: the run leaves a checkpoint and continues when it is asked for again.
#SBATCH --signal=TERM@120
# With GPUs:
##SBATCH --gpus-per-node=8
set -euo pipefail

experiment=${1:?usage: sbatch one_node.sh EXPERIMENT [OPTION ...]}
shift

# Threads of one process; without this every process takes what it is bound to.
export RAYON_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}
# --kill-on-bad-exit: a process that ends wrongly ends the job, whatever the others wait for.
srun --mpi=pmix --kill-on-bad-exit=1 reviv run "$experiment" "$@"
