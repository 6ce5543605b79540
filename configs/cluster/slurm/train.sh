#!/bin/bash
# Trains, and resumes after preemption, a time limit, or a failed node. From the repository root:
#
#   sbatch configs/cluster/slurm/train.sh --config configs/demc.toml
#   sbatch --ntasks=4 configs/cluster/slurm/train.sh --config configs/demc.toml  # with --features mpi
#
#SBATCH --job-name=demc-train
#SBATCH --output=%x-%j.log
#SBATCH --open-mode=append
#SBATCH --cpus-per-task=2
#SBATCH --time=24:00:00
#SBATCH --requeue
# SIGTERM 5 minutes before the time limit: demc-train saves a checkpoint and exits with code 143.
#SBATCH --signal=TERM@300
export RAYON_NUM_THREADS=$SLURM_CPUS_PER_TASK SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK
# `srun --mpi=list` shows what this cluster has.
if [ "${SLURM_NTASKS:-1}" -gt 1 ]; then
    export SLURM_MPI_TYPE=${SLURM_MPI_TYPE:-pmix}
fi
# --resume starts a run that does not exist yet.
srun demc-train "$@" --resume
code=$?
if [ "$code" = 143 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
