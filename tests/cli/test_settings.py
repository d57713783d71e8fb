"""What the command line makes of its words: the command, and the settings that were given and no others."""

from __future__ import annotations

import pytest

from saclab.cli.main import parse
from saclab.cli.settings import docstrings, named_config
from saclab.errors import UserError
from saclab.other_names import OTHER_NAMES
from saclab.protocols import make_config
from saclab.settings import AlgorithmSettings, TrainingSettings, field_names


def settings_of(*words: str) -> dict[str, object]:
    command = parse(words)
    return {**command.algorithm, **command.training}


@pytest.mark.parametrize(
    "environment", [("train", "--seed", "3", "Humanoid-v4"), ("train", "Humanoid-v4"), ("compare", "A-v0")]
)
def test_only_what_is_given_comes_back(environment):
    assert settings_of(*environment) == {}
    assert settings_of(*environment, "--discount", "0.98", "--max-steps=None") == {"discount": 0.98, "max_steps": None}
    assert settings_of(*environment, "--hidden-layers", "512", "256", "--snapshots=1") == {
        "hidden_layers": (512, 256), "snapshots": 1,
    }  # fmt: skip
    assert settings_of(*environment, "--target-entropy", "-3.5", "--temperature", "learned") == {
        "target_entropy": -3.5, "temperature": "learned",
    }  # fmt: skip
    assert settings_of(*environment, "--batch_size", "7") == {"batch_size": 7}


def test_the_environment_may_stand_anywhere_and_so_may_the_names():
    command = parse(["train", "--seed", "3", "Humanoid-v4", "--protocol=paper", "--variant", "sac"])
    assert (command.environment, command.seed, command.protocol, command.variant) == ("Humanoid-v4", 3, "paper", "sac")
    assert parse(["compare", "A-v0", "B-v0", "--variants", "sac", "averaged"]).environments == ("A-v0", "B-v0")


def test_help_shows_what_the_named_variant_and_protocol_have(capsys):
    for words in (["train", "--seed", "3", "Humanoid-v4", "--variant=averaged"], ["compare", "--variant", "averaged"]):
        with pytest.raises(SystemExit):
            parse([*words, "--protocol", "quick", "--help"])
        told = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "Transitions per update. (default: 64)" in told
        assert "the critics themselves value the next state. (default: 10)" in told
        assert f"or its first value if it is learned. (default: {0.1 if words[0] == 'train' else 0.2})" in told
    with pytest.raises(UserError, match="did you mean 'averaged'"):
        named_config(["train", "--variant", "averagd"])


@pytest.mark.parametrize("words", [("train", "A-v0", "--gamma", "0.9"), ("compare", "A-v0", "--gamma=0.9")])
def test_another_librarys_name_is_told_as_ours(words):
    with pytest.raises(UserError, match=r"^unknown option --gamma: here it is --discount$"):
        parse(words)
    with pytest.raises(
        UserError, match=r"^unknown setting 'lr': here it is actor_learning_rate, critic_learning_rate,"
    ):
        make_config("Pendulum-v1", overrides={"lr": 1e-3})


def test_other_names_lead_to_settings_and_are_none():
    ours = {*field_names(AlgorithmSettings), *field_names(TrainingSettings)}
    assert {name for names in OTHER_NAMES.values() for name in names} <= ours
    assert not OTHER_NAMES.keys() & ours


def test_a_wrong_option_is_told_of_for_its_own_command_alone(capsys):
    with pytest.raises(SystemExit):
        parse(["compare", "A-v0", "--seed", "3"])
    told = capsys.readouterr()
    told = told.out + told.err
    assert "--first-seed" in told
    assert "saclab compare --help" in told
    assert "--search-seed" not in told, "which is tune's"


def test_every_setting_has_an_explanation():
    for kind in (AlgorithmSettings, TrainingSettings):
        assert set(docstrings(kind)) == set(field_names(kind))
