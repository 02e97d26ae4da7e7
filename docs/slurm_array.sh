#!/usr/bin/env bash
# One run a job of a SLURM array: sbatch slurm_array.sh FOLDER [flags of codesign optimize]
# When the jobs have ended:       codesign compare FOLDER
#SBATCH --array=0-9%4
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@120
set -uo pipefail
folder=${1:?"sbatch slurm_array.sh FOLDER [flags of codesign optimize]"}
shift
seed=$SLURM_ARRAY_TASK_ID
# Two minutes before the time limit: the run saves its episode and stops with status 143.
trap 'kill -TERM $(jobs -p)' TERM
codesign optimize --seed "$seed" --out "$folder/seed-$seed" "$@" &
run=$!
wait "$run"   # ends early when the signal comes
wait "$run"
status=$?
# The same command resumes a run that was stopped, so the job goes back into the queue.
if [ "$status" -eq 143 ]; then scontrol requeue "$SLURM_JOB_ID"; fi
exit "$status"
