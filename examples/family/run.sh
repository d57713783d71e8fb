#!/usr/bin/env bash
# Trains every variant of the family on HalfCheetah-v4 for as many environment steps as a core makes in about an hour, or
# up to a point of its published curve near that, two at a time, evaluated at that curve's steps; but for those whose
# results lie in examples/family/runs already. Stop it at any instant: the same command goes on.
#
#   examples/family/run.sh RUNS [SEEDS]
#
# SACLAB names the program, if it is not on the PATH.
here=$(dirname "$(realpath "$0")")
source "$here/../experiment.sh"
runs=${1:?the folder that holds the runs}
kept=$here/runs

# Episodes of 1000 steps after the random ones (10,000 steps; 5,000 of xqc, simbav2, crossq, droq and redq). The protocol's
# limit of a million steps stays, and with it the learning rates' schedules. The slow arms first, so that the two workers
# end together.
family() {
  cat <<'ARMS'
xqc xqc --max-episodes 45 --evaluation-interval-steps 10000
simbav2 simbav2 --max-episodes 8 --evaluation-interval-steps 1000
flashsac flashsac --max-episodes 24 --evaluation-interval-steps 2000
crossq crossq --max-episodes 13 --evaluation-interval-steps 2000
tqc tqc --max-episodes 40 --evaluation-interval-steps 10000
droq droq --max-episodes 29 --evaluation-interval-steps 8333
redq redq --max-episodes 12 --evaluation-interval-steps 8333
sac-auto sac-auto --max-episodes 90 --evaluation-interval-steps 8333
ARMS
}

family | planned HalfCheetah-v4 "${2:-1}" standard | train_two_at_a_time
