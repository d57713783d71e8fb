#!/usr/bin/env bash
# Trains every run of docs/averaging.md, two at a time, seed by seed, but for those whose results lie in
# examples/averaging/runs already. Stop it at any instant: the same command goes on.
#
#   examples/averaging/run.sh RUNS [SEEDS_OF_STAGE_1 [SEEDS_OF_STAGE_2]]
#
# SACLAB names the program, if it is not on the PATH.
here=$(dirname "$(realpath "$0")")
source "$here/../experiment.sh"
runs=${1:?the folder that holds the runs}
kept=$here/runs

half_cheetah() {  # the slow arms first, so that the two workers end together
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

{
  half_cheetah | planned HalfCheetah-v4 "${2:-5}" paper --max-episodes 500 --q-bias-episodes 2
  humanoid | planned Humanoid-v4 "${3:-3}" paper --max-updates 100000 --patience-episodes None --q-bias-episodes 2
} | train_two_at_a_time
