#!/usr/bin/env bash
# Trains every run of docs/averaging.md, two at a time, seed by seed. Stop it at any instant (Ctrl-C, SIGTERM to the
# process group, a power cut): the same command goes on, finished runs are skipped, and those whose results lie in
# examples/averaging/runs beside this file already.
#
#   examples/averaging/run.sh RUNS [SEEDS_OF_STAGE_1 [SEEDS_OF_STAGE_2]]
#
# SACLAB names the program, if it is not on the PATH.
set -euo pipefail
runs=${1:?the folder that holds the runs}
kept=$(dirname "$(realpath "$0")")/runs
stage_1_seeds=${2:-5}
stage_2_seeds=${3:-3}

# jaxlib 0.10.2 can compile large matrix products wrongly through these fusions (jax issue 39103): not used here.
export XLA_FLAGS="--xla_cpu_experimental_ynn_fusion_type="

# Linux weighs sessions against each other before it weighs processes, so nice gives way only within its own: started
# as a session of its own (setsid examples/averaging/run.sh RUNS &), this one gives way as a whole.
if [[ $(ps -o sid= -p $$) -eq $$ ]]; then
  { echo 19 >/proc/self/autogroup; } 2>/dev/null || true
fi

half_cheetah() {  # name, variant and settings of an arm; the slow arms first, so that the two workers end together
  cat <<'ARMS'
averaged averaged
averaged-spacing-200 averaged --snapshot-interval 200
averaged-auto averaged-auto
sac sac
sac-lag sac --polyak-rate 0.0009
averaged-entropy averaged-entropy
sac-auto sac-auto
ARMS
}

humanoid() {
  cat <<'ARMS'
averaged averaged
averaged-auto averaged-auto
sac sac
sac-auto sac-auto
ARMS
}

commands() {  # environment, number of seeds, limits of the run; the arms come on standard input
  local environment=$1 seeds=$2 arms seed name variant settings
  shift 2
  arms=$(cat)
  for ((seed = 0; seed < seeds; seed++)); do
    while read -r name variant settings; do
      [[ -e "$kept/$environment/$name/paper/seed-$seed" ]] && continue
      echo "train $environment --variant $variant --name $name $settings --seed $seed --protocol paper" \
        "$* --q-bias-episodes 2 --threads 1 --checkpoint-minutes 5 --runs $runs"
    done <<<"$arms"
  done
}

mkdir -p "$runs"
{
  half_cheetah | commands HalfCheetah-v4 "$stage_1_seeds" --max-episodes 500
  humanoid | commands Humanoid-v4 "$stage_2_seeds" --max-updates 100000 --patience-episodes None
} | xargs -P 2 -L 1 --process-slot-var=CORE \
  bash -c 'exec taskset --cpu-list "$CORE" nice -n 19 "${SACLAB:-saclab}" "$@" >>"$0/log.txt" 2>&1' "$runs"
