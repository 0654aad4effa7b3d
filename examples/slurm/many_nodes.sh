#!/usr/bin/env bash
# Many nodes. The same experiment as on one, whatever the number of processes, as long as they divide its batch:
#   sbatch --nodes=32 examples/slurm/many_nodes.sh experiments/my.yaml
#SBATCH --job-name=reviv
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=8
#SBATCH --cpus-per-task=12
#SBATCH --time=24:00:00
#SBATCH --output=%x-%j.log
#SBATCH --signal=TERM@120
# When a node fails, or the time is over, the job is queued again and continues from its last checkpoint.
#SBATCH --requeue
#SBATCH --open-mode=append
set -euo pipefail

experiment=${1:?usage: sbatch --nodes=N many_nodes.sh EXPERIMENT [OPTION ...]}
shift

export RAYON_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}
# Seconds that a process may be silent, or behind the others in a step; more where a shared file system stalls.
export REVIV_PATIENCE=${REVIV_PATIENCE:-25}
srun --mpi=pmix --kill-on-bad-exit=1 reviv run "$experiment" "$@"
