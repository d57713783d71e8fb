#!/usr/bin/env bash
# Trains the runs of one stage of docs/curriculum.md, two at a time, seed by seed: those on HalfCheetah-v4, or, once
# their results let it be (H1 of the page), those on Humanoid-v4; but for those whose results lie in
# examples/curriculum/runs already. Stop it at any instant: the same command goes on.
#
#   examples/curriculum/run.sh RUNS [half-cheetah|humanoid [SEEDS]]
#
# SACLAB names the program, if it is not on the PATH.
here=$(dirname "$(realpath "$0")")
source "$here/../experiment.sh"
runs=${1:?the folder that holds the runs}
kept=$here/runs
stage=${2:-half-cheetah}
seeds=${3:-}

humanoid() {  # xargs takes what stands between quotes as one word
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

case $stage in
  half-cheetah) commands=$(half_cheetah | planned HalfCheetah-v4 "${seeds:-3}" paper --max-updates 30000 --q-bias-episodes 2) ;;
  humanoid)
    commands=$(humanoid | planned Humanoid-v4 "${seeds:-4}" paper --max-updates 100000 --max-episodes None \
      --patience-episodes None --q-bias-episodes 2)
    ;;
  *)
    echo "unknown stage $stage: use half-cheetah or humanoid" >&2
    exit 2
    ;;
esac
train_two_at_a_time <<<"$commands"
