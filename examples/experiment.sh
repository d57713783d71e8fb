# What the experiments' run.sh scripts have in common; each sources this file and sets `runs` and `kept`, the folder of
# results that lie in the repository already. SACLAB names the program, if it is not on the PATH.
set -euo pipefail

# jaxlib 0.10.2 can compile large matrix products wrongly through these fusions (jax issue 39103): not used here.
export XLA_FLAGS="--xla_cpu_experimental_ynn_fusion_type="

# Commands for every seed of every arm that is not kept yet, one a line, seed by seed. Arms come on standard input: a name,
# a variant, and settings of its own.
planned() {  # environment, number of seeds, protocol, settings of all arms
  local environment=$1 seeds=$2 protocol=$3 arms seed name variant settings
  shift 3
  arms=$(cat)
  for ((seed = 0; seed < seeds; seed++)); do
    while read -r name variant settings; do
      [[ -e "$kept/$environment/$name/$protocol/seed-$seed" ]] && continue
      echo "train $environment --variant $variant --name $name $settings --seed $seed --protocol $protocol" \
        "$* --threads 1 --checkpoint-minutes 5 --runs $runs"
    done <<<"$arms"
  done
}

# Carry out commands from standard input, two at a time, each on a core of its own. Stop it at any instant (Ctrl-C,
# SIGTERM to the process group, a power cut): the same command goes on, and finished runs are skipped.
train_two_at_a_time() {
  if [[ $runs == *[[:space:]\"\'\\]* ]]; then
    echo "the folder of the runs is $runs: use one without blanks, quotes and backslashes" >&2
    return 2
  fi
  give_way
  mkdir -p "$runs"
  xargs -r -P 2 -L 1 --process-slot-var=CORE \
    bash -c 'exec taskset --cpu-list "$CORE" nice -n 19 "${SACLAB:-saclab}" "$@" >>"$0/log.txt" 2>&1' "$runs"
}

# Linux weighs sessions against each other before it weighs processes, so nice gives way only within its own: started as
# a session of its own (setsid examples/averaging/run.sh RUNS &), a script gives way as a whole.
give_way() {
  if [[ $(ps -o sid= -p $$) -eq $$ ]]; then
    { echo 19 >/proc/self/autogroup; } 2>/dev/null || true
  fi
  if command -v ionice >/dev/null; then
    ionice -c 3 -p "$BASHPID" 2>/dev/null || true
  fi
}
