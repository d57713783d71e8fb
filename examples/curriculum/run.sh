#!/usr/bin/env bash
# Trains the runs of one stage of docs/curriculum.md, two at a time, seed by seed: those on HalfCheetah-v4, or, once
# their results let it be (H1 of the page), those on Humanoid-v4. Stop it at any instant (Ctrl-C, SIGTERM to the
# process group, a power cut): the same command goes on, finished runs are skipped, and those whose results lie in
# examples/curriculum/runs beside this file already.
#
#   examples/curriculum/run.sh RUNS [half-cheetah|humanoid [SEEDS]]
#
# SACLAB names the program, if it is not on the PATH.
set -euo pipefail
runs=${1:?the folder that holds the runs}
kept=$(dirname "$(realpath "$0")")/runs
stage=${2:-half-cheetah}
seeds=${3:-}

# jaxlib 0.10.2 can compile large matrix products wrongly through these fusions (jax issue 39103): not used here.
export XLA_FLAGS="--xla_cpu_experimental_ynn_fusion_type="

# Linux weighs sessions against each other before it weighs processes, so nice gives way only within its own: started
# as a session of its own (setsid examples/curriculum/run.sh RUNS &), this one gives way as a whole.
if [[ $(ps -o sid= -p $$) -eq $$ ]]; then
  { echo 19 >/proc/self/autogroup; } 2>/dev/null || true
fi
if command -v ionice >/dev/null; then
  ionice -c 3 -p $$ 2>/dev/null || true
fi

humanoid() {  # name, variant and settings of an arm; xargs takes what stands between quotes as one word
  cat <<'ARMS'
sac-auto sac-auto --reward-terms reward_linvel reward_quadctrl reward_alive
curriculum curriculum
curriculum-slow curriculum --reward-schedule 'reward_linvel: 0.2@0.3 1@0.8'
ARMS
}

half_cheetah() {
  cat <<'ARMS'
sac-auto sac-auto --reward-terms reward_run reward_ctrl
control-late sac-auto --reward-terms reward_run reward_ctrl --reward-schedule 'reward_ctrl: 0@0.4 4@0.6'
ARMS
}

commands() {  # environment, number of seeds, limits of the run; the arms come on standard input
  local environment=$1 seeds=${seeds:-$2} arms seed name variant settings
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

case $stage in
  half-cheetah) planned=$(half_cheetah | commands HalfCheetah-v4 3 --max-updates 30000) ;;
  humanoid)
    planned=$(humanoid | commands Humanoid-v4 4 --max-updates 100000 --max-episodes None --patience-episodes None)
    ;;
  *)
    echo "unknown stage $stage: use half-cheetah or humanoid" >&2
    exit 2
    ;;
esac
[[ -n $planned ]] || exit 0  # all results lie beside this file

mkdir -p "$runs"
echo "$planned" | xargs -P 2 -L 1 --process-slot-var=CORE \
  bash -c 'exec taskset --cpu-list "$CORE" nice -n 19 "${SACLAB:-saclab}" "$@" >>"$0/log.txt" 2>&1' "$runs"
