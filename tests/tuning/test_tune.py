"""Whole tunes, with real runs in real workers: what they leave, that they go on, what they give up."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import saclab
from saclab.grid.launch import Grid
from saclab.grid.pool import End
from saclab.grid.resources import chosen_resources
from saclab.grid.tasks import RunStatus, make_statuses, make_tasks
from saclab.tuning.open_trial import OpenTrial
from saclab.tuning.page import folded
from saclab.tuning.plan import make_plan
from saclab.tuning.study import (
    TRIALS_BEFORE_PRUNING,
    WAY,
    best_trial,
    drawn_settings,
    is_complete,
    mend_end,
    open_study,
    trials_under_way,
)

SETTINGS = {
    "hidden_layers": (8,), "random_steps": 100, "max_updates": 60, "update_interval": 1,
    "evaluation_interval_steps": 40, "evaluation_episodes": 1,
}  # fmt: skip
SPACE = {"defaults": False, "batch_size": [16, 64], "critic_learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}


def plan_of(objective="mean", score=None, pruning=True, seeds=1):
    return make_plan("Pendulum-v1", "sac-auto", "quick", seeds, objective, score, SPACE, SETTINGS, {}, 0, pruning)


def tune(folder: Path, trials: int, **how) -> saclab.Tuned:
    return saclab.tune("Pendulum-v1", "sac-auto", "quick", trials, out=folder, **{"space": SPACE, **SETTINGS, **how})


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tune")
    return folder, tune(folder, 2, seeds=2, pruning=False)


def test_a_tune_tries_the_variants_own_settings_first_and_finds_the_best(tuned):
    folder, result = tuned
    study = open_study(folder, plan_of(seeds=2, pruning=False))
    values = [trial.value for trial in study.trials]
    assert result.trials == len(values) == 2
    assert study.trials[0].params == {"batch_size": 64, "critic_learning_rate": 1e-3}, "of sac-auto under quick"
    assert result.own_value == values[0]
    assert result.value == max(values)
    assert result.best == study.trials[values.index(max(values))].params


def test_a_trials_value_is_the_mean_of_its_runs(tuned):
    folder, _ = tuned
    study = open_study(folder, plan_of(seeds=2, pruning=False))
    for trial in study.trials:
        folders = sorted(folder.glob(f"runs/Pendulum-v1/trial-{trial.number:04d}/quick/seed-*"))
        runs = [saclab.read_run(run) for run in folders]
        assert [run.config.seed for run in runs] == [0, 1]
        assert all(run.config.algorithm.batch_size == trial.params["batch_size"] for run in runs)
        means = [run.evaluations["mean_return"].mean() for run in runs]
        assert trial.value == pytest.approx(sum(means) / 2)
        assert not list(folder.glob(f"runs/*/trial-{trial.number:04d}/*/*/checkpoints")), "large, and of no more use"


def test_the_page_shows_the_search_and_needs_nothing_else(tuned):
    folder, result = tuned
    page = (folder / "index.html").read_text()
    assert result.page == folder / "index.html"
    assert page.count("data:image/png;base64,") >= 3
    assert "http://" not in page
    assert "https://" not in page
    if result.best == {"batch_size": 64, "critic_learning_rate": 1e-3}:
        assert result.commands == [], "the variant's own settings are the best"
    else:
        assert [words[1] for words in result.commands] == ["compare", "compare", "report"]
        assert str(result.best["critic_learning_rate"]) in result.commands[1]
        assert str(folder / "judged") in result.commands[0]


def test_the_same_call_trains_nothing_anew_and_more_trials_go_on(tuned):
    folder, result = tuned
    began = time.monotonic()
    assert tune(folder, 2, seeds=2, pruning=False)._replace(page=None) == result._replace(page=None)
    assert time.monotonic() - began < 120


def test_a_folder_with_another_tune_is_refused(tuned):
    folder, _ = tuned
    with pytest.raises(saclab.UserError, match="holds a tune with another objective"):
        tune(folder, 2, seeds=2, pruning=False, objective="final")
    with pytest.raises(saclab.UserError, match="holds a tune with another overrides, max_updates: 60 there, 70 here"):
        tune(folder, 2, seeds=2, pruning=False, max_updates=70)


def test_what_cannot_work_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(saclab.UserError, match="score = None: objective steps needs one"):
        tune(tmp_path / "tune", 1, objective="steps")
    with pytest.raises(saclab.UserError, match="trials = 0"):
        tune(tmp_path / "tune", 0)
    assert not (tmp_path / "tune").exists()


def test_without_optuna_the_command_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(saclab.UserError, match=r"saclab tune needs the package optuna: pip install '\.\[tune\]'"):
        tune(tmp_path / "tune", 1)


def test_a_run_at_its_score_is_worth_the_way_there(tmp_path):
    """Every evaluation of Pendulum-v1 is above −2000: each run is at its score at once."""
    result = tune(tmp_path, 2, objective="steps", score=-2000.0)
    assert result.value == 40, "the first evaluation, of the policy as it starts"
    never = tune(tmp_path / "never", 1, objective="steps", score=0.0)
    assert never.own_value == 2 * 160, "PAR2 of a run of 160 steps"
    assert (never.best, never.commands) == (None, []), "what was never reached is no result"
    assert "with all of its runs at the score yet" in never.page.read_text()


@pytest.mark.slow
def test_a_tune_without_the_variants_own_settings_goes_on_too(tmp_path):
    space = {"defaults": False, "batch_size": [16, 32]}
    first = tune(tmp_path, 1, space=space)
    assert first.own_value is None
    assert tune(tmp_path, 2, space=space).trials == 2


def test_a_folded_command_is_the_same_to_a_shell():
    words = ["saclab", "compare", "--environment-arguments", json.dumps({"a": 1.5, "b": "x y " * 30}), "--seeds", "5"]
    printed = subprocess.run(["bash", "-c", f"printf '%s\\n' {folded(words)}"], capture_output=True, text=True)
    assert printed.stdout.splitlines() == words


def trial_with(study, columns, at_rest):
    """An open trial of runs with these evaluation returns, seen all at once."""
    runs = [RunStatus(None, "finished" if at_rest else "running") for _ in columns]
    opened = OpenTrial(study.ask(), runs)
    opened.evaluations = [{"mean_return": np.array(column), "steps": 10 * (1 + np.arange(len(column)))}
                          for column in columns]  # fmt: skip
    return opened


@pytest.mark.parametrize("at_rest", [False, True])
def test_a_trial_below_the_median_is_given_up_however_much_was_seen(tmp_path, at_rest):
    study = open_study(tmp_path, plan_of())
    for level in range(TRIALS_BEFORE_PRUNING):
        trial = study.ask()
        for step in range(1, 7):
            trial.report(float(level), step)
        study.tell(trial, float(level))
    rises = [-10.0, -10.0, -10.0, 100.0, 100.0, 100.0]
    slow = trial_with(study, [rises], at_rest)
    assert slow.hopeless(plan_of(), study) == "it was below the median of the trials before it"
    assert len(study.trials[slow.trial.number].intermediate_values) == 2, "the first evaluation is too early"
    assert slow.hopeless(plan_of(), study), "after a kill between the report and its verdict too"
    assert not trial_with(study, [[5.0] * 6], at_rest).hopeless(plan_of(), study)
    assert not trial_with(study, [rises, []], at_rest).hopeless(plan_of(), study), "not all runs have got there"


@pytest.mark.parametrize("at_rest", [False, True])
def test_a_trial_slower_than_the_best_is_given_up_at_rest_too(tmp_path, at_rest):
    plan = plan_of("steps", 0.0)
    study = open_study(tmp_path, plan)
    never = study.ask()
    never.set_user_attr(WAY, 0)
    study.tell(never, 35.0)
    assert not trial_with(study, [[-1.0] * 4], at_rest).hopeless(plan, study), "the best one never got there either"
    best = study.ask()
    best.set_user_attr(WAY, 1)
    study.tell(best, 30.0)
    short = study.ask()
    short.set_user_attr(WAY, 0)
    study.tell(short, 5.0)  # PAR2 of a run that broke off early: no way to the score
    assert best_trial(study, plan).number == best.number
    assert not trial_with(study, [[-1.0, -1.0, 1.0]], at_rest).hopeless(plan, study), "at its score after 30 steps"
    assert not trial_with(study, [[-1.0, -1.0, -1.0, 1.0]], at_rest).hopeless(plan, study)
    slower = trial_with(study, [[-1.0] * 4 + [1.0]], at_rest)
    assert slower.hopeless(plan, study) == "it needs more than the best so far, 30"
    assert trial_with(study, [[-1.0] * 4], at_rest).hopeless(plan, study)


class Told:
    """A pool whose workers never begin."""

    places, note, replaces_lost = 2, "no machine is large enough", False

    def __init__(self):
        self.stopped = []

    def start(self, task):
        return True

    def stop(self, task):
        self.stopped.append(task)
        return True

    def poll(self):
        return []


def test_runs_that_are_given_up_go_no_further_and_others_do(tmp_path):
    cells = plan_of(seeds=3).cells(tmp_path, "arm", {})
    statuses, pool = make_statuses(cells), Told()
    grid = Grid(pool, make_tasks(statuses, 0), 0)
    grid.start()  # two of the three have a place
    first, second = grid.running
    grid.give_up([statuses[0], statuses[2]])
    assert pool.stopped == [first]
    assert statuses[2].status == "interrupted", "it waited"
    assert grid.waiting == []
    grid.give_up([statuses[0]])
    assert pool.stopped == [first], "it was told already"
    grid._ended(first, End(-signal.SIGTERM, ""))
    assert statuses[0].status == "interrupted"
    assert statuses[1].status == "running"
    assert second in grid.running


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_stopped_from_outside_ends_the_tune_and_loses_no_trial(tmp_path, number):
    """The trial is not judged by it: the same call goes on with it, and the first trial keeps its value."""
    killed = []

    def kill_the_first(stream):
        for state in stream:
            workers = list(state.grid.pool.workers.values())
            if not killed and workers and workers[0].task.runs[0].evaluations:
                killed.append(workers[0].process.process.pid)
                os.kill(killed[0], number)
        return state

    how = {"max_updates": 3000, "resources": chosen_resources(workers=1)}
    stopped = tune(tmp_path, 2, show=kill_the_first, **how)
    assert set(stopped.hindered) == {0}
    assert stopped.trials == 0
    assert stopped.page is None
    gone_on = tune(tmp_path, 2, **how)
    assert (gone_on.hindered, gone_on.trials) == ({}, 2)
    assert gone_on.own_value is not None


def test_evaluations_that_cannot_be_read_stop_their_trial_only(tmp_path):
    tune(tmp_path, 1)
    (evaluations,) = tmp_path.glob("runs/*/trial-0000/*/seed-0/evaluations.csv")
    journal = tmp_path / "trials.jsonl"
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:-1]))  # the value was not told yet
    whole = evaluations.read_text()
    evaluations.write_text(whole.replace("1,", "x,", 1))
    hindered = tune(tmp_path, 1).hindered
    assert "evaluations.csv is damaged" in hindered[0]
    evaluations.write_text(whole)
    assert tune(tmp_path, 1).trials == 1


def test_a_damaged_journal_is_a_users_error(tmp_path):
    for content in ("[]\n", '{"op_code": 99, "worker_id": "x"}\n', "no json\n{}\n"):
        (tmp_path / "trials.jsonl").write_text(content)
        with pytest.raises(saclab.UserError, match="is damaged, or no journal of Optuna's"):
            open_study(tmp_path, plan_of())


def test_seeds_and_settings_that_cannot_be_are_refused():
    with pytest.raises(saclab.UserError, match=r"seeds = \(0, 0\): name each once"):
        plan_of(seeds=[0, 0])
    with pytest.raises(saclab.UserError, match="polyak_rate = 'fast': Expected `float`"):
        make_plan("Pendulum-v1", "sac", "quick", 1, "mean", None, {}, {"polyak_rate": "fast"}, {}, 0, True)


def test_a_torn_last_line_of_the_journal_is_cut_off(tmp_path):
    journal = tmp_path / "trials.jsonl"
    plan = plan_of()
    open_study(tmp_path, plan)
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 4, "wor')
    study = open_study(tmp_path, plan)
    assert study.ask().number == 0
    assert all(json.loads(line) for line in journal.read_text().splitlines())
    mend_end(tmp_path / "not-there")


def test_no_settings_of_a_trial_depend_on_when_they_are_drawn(tmp_path):
    """A new process draws what the one before it would have: the trial's number and the values before it decide."""
    plan, drawn = plan_of(), {}
    for folder, anew in (tmp_path / "one", False), (tmp_path / "two", True):
        folder.mkdir()
        study = open_study(folder, plan)
        drawn[folder.name] = []
        for number in range(24):
            trial = study.ask()
            if anew and number % 3 == 1:  # killed after the first setting was drawn
                first = dataclasses.replace(plan, space={"batch_size": plan.space["batch_size"]})
                drawn_settings(study, first, trial)
                study = open_study(folder, plan)
                (trial,) = trials_under_way(study)
            settings = drawn_settings(study, plan, trial)
            drawn[folder.name].append(settings)
            study.tell(trial.number, -abs(settings["critic_learning_rate"] - 3e-3))
    assert drawn["one"] == drawn["two"]
    assert len({str(settings) for settings in drawn["one"]}) == 24


@pytest.mark.slow
def test_a_killed_tune_goes_on_as_if_nothing_had_happened(tmp_path):
    """One worker: trials, values and runs after six `kill -9` equal those of a tune that was left alone."""
    words = [
        "tune", "Pendulum-v1", "--protocol", "quick", "--trials", "6", "--workers", "1", "--seeds", "2",
        "--hidden-layers", "8", "--random-steps", "100", "--max-updates", "1500", "--evaluation-interval-steps", "200",
        "--evaluation-episodes", "1", "--checkpoint-minutes", "0.01", "--space", str(tmp_path / "space.toml"),
    ]  # fmt: skip
    (tmp_path / "space.toml").write_text("defaults = false\nbatch_size = [16, 64]\ndiscount = [0.9, 0.99]\n")

    def start(folder: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "saclab", *words, "--out", str(tmp_path / folder)]
        return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)

    assert start("straight").wait() == 0
    for seconds in (4, 6, 9, 5, 12, 7):
        process = start("killed")
        time.sleep(seconds)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert start("killed").wait() == 0
    trials = {}
    for folder in ("straight", "killed"):
        plan = make_plan_of(tmp_path / folder)
        trials[folder] = [
            (trial.number, trial.params, trial.value, trial.state.name)
            for trial in open_study(tmp_path / folder, plan).trials
        ]
    assert trials["straight"] == trials["killed"]
    for run in sorted((tmp_path / "straight").glob("runs/*/*/*/seed-*")):
        other = tmp_path / "killed" / run.relative_to(tmp_path / "straight")
        mine, theirs = saclab.read_run(run).evaluations, saclab.read_run(other).evaluations
        if not all((folder / "result.json").exists() for folder in (run, other)):
            continue  # given up: at which of its steps is a matter of time
        assert mine["returns"].tolist() == theirs["returns"].tolist()


def make_plan_of(folder: Path):
    """The plan that the command above makes."""
    settings = {
        "hidden_layers": (8,), "random_steps": 100, "max_updates": 1500, "evaluation_interval_steps": 200,
        "evaluation_episodes": 1,
    }  # fmt: skip
    space = {"defaults": False, "batch_size": [16, 64], "discount": [0.9, 0.99]}
    return make_plan("Pendulum-v1", "sac-auto", "quick", 2, "mean", None, space, settings, {}, 0, True)


def test_the_best_of_no_trials_is_none(tmp_path):
    study = open_study(tmp_path, plan_of())
    assert best_trial(study, plan_of()) is None
    assert not any(map(is_complete, study.trials))
