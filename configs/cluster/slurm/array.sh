#!/bin/bash
# Renders, cleans references, or denoises: task I of an array of N does --shard I/N of a command.
# Without --array it does the whole command. From the repository root:
#
#   sbatch --array=1-8 configs/cluster/slurm/array.sh demc-infer denoise renders/ -o denoised/
#   SHARDS=8 sbatch --array=3 configs/cluster/slurm/array.sh ...  # task 3 of 8 again
#
#SBATCH --job-name=demc
#SBATCH --output=%x-%A-%a.log
#SBATCH --open-mode=append
#SBATCH --cpus-per-task=1
#SBATCH --time=04:00:00
#SBATCH --requeue
export RAYON_NUM_THREADS=$SLURM_CPUS_PER_TASK SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK
shard=()
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
    shard=(--shard "$SLURM_ARRAY_TASK_ID/${SHARDS:-$SLURM_ARRAY_TASK_COUNT}")
fi
srun "$@" "${shard[@]}"
