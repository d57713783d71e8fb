"""Policies go to the Hugging Face Hub and come back: against a local server that speaks the part of its protocol used.

See hub_server.py. What is not shown here is that the Hub itself answers so.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from hub_server import TOKEN, Hub, served

from saclab.environments.make import EnvironmentSpec
from saclab.protocols import make_config
from saclab.trained_policy import TrainedPolicy, load_policy, save_policy
from saclab.training.run_folder import read_run

from .conftest import Told, one_process

SHORT = (
    "--random-steps", "200", "--batch-size", "32", "--hidden-layers", "16", "16", "--evaluation-episodes", "2",
    "--max-updates", "300", "--evaluation-interval-steps", "250",
)  # fmt: skip
POLICY = ("policy.json", "policy.safetensors")


class Workplace(NamedTuple):
    hub: Hub
    run: Callable[..., Told]
    """A command in a process that knows no other Hub, and has the owner's token."""
    trained: Path
    """The folder of a finished run."""
    cache: Path


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workplace]:
    folder = tmp_path_factory.mktemp("shared")
    with served() as (address, hub), pytest.MonkeyPatch.context() as patch:
        settings = {"HF_ENDPOINT": address, "HF_HOME": str(folder / "home"), "HF_TOKEN": TOKEN}
        for name, value in (settings | {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}).items():
            patch.setenv(name, value)
        with one_process() as (_, run):
            told = run("train", "Pendulum-v1", "--protocol", "quick", *SHORT, folder=folder)
            assert told.status == 0, told.errors
            trained = folder / "runs/Pendulum-v1/sac-auto/quick/seed-0"
            (trained / "best" / "video.mp4").write_bytes(b"a film")
            yield Workplace(hub, run, trained, folder / "home" / "hub")


@pytest.fixture(scope="module")
def shared(workplace: Workplace) -> Told:
    return workplace.run("share", workplace.trained, "user/swing", "--episodes", "3", "--onnx")


def returns_of(told: Told) -> list[float]:
    assert told.status == 0, told.errors
    return json.loads(told.output)["total_rewards"]


def test_what_is_shared_evaluates_as_it_does_here(workplace: Workplace, shared: Told) -> None:
    assert shared.status == 0, shared.errors
    here = workplace.run("evaluate", workplace.trained, "--episodes", "3", "--json")
    there = workplace.run("evaluate", "hf:user/swing", "--episodes", "3", "--json")
    assert returns_of(there) == returns_of(here)
    files = workplace.hub.repositories["user/swing"].files
    for name in POLICY:
        original = (workplace.trained / "best" / name).read_bytes()
        assert files[name] == original
        assert [path.read_bytes() for path in workplace.cache.rglob(f"snapshots/*/{name}")] == [original]
    assert not list(workplace.cache.rglob("snapshots/*/README.md")), "nothing but the policy is downloaded"


def test_what_is_sent_is_told_and_nothing_else_is_sent(workplace: Workplace, shared: Told) -> None:
    sent = {*POLICY, "README.md", "config.json", "evaluations.csv", "policy.onnx", "replay.mp4", "result.json"}
    assert set(re.findall(r"^  (\S+) +[\d,]+ bytes$", shared.output, re.M)) == sent
    assert workplace.hub.repositories["user/swing"].files.keys() - {".gitattributes"} == sent
    assert shared.output.strip().endswith("/user/swing")


def test_nothing_that_is_sent_tells_of_the_machine(workplace: Workplace, shared: Told) -> None:
    files = workplace.hub.repositories["user/swing"].files
    machine = json.loads((workplace.trained / "config.json").read_text())["machine"]
    private = [machine["processor"], machine["system"], str(Path.home()), str(workplace.trained.parents[4])]
    for name, content in files.items():
        assert [text for text in private if text.encode() in content] == [], name
    assert json.loads(files["config.json"])["machine"] == {}


def test_the_folder_that_is_shared_is_read_as_a_run(workplace: Workplace, tmp_path: Path) -> None:
    told = workplace.run("share", workplace.trained, "user/x", "--folder", tmp_path / "out", "--episodes", "1")
    assert told.status == 0, told.errors
    assert "user/x" not in workplace.hub.repositories
    here, there = read_run(workplace.trained), read_run(tmp_path / "out")
    assert there.config == here.config
    np.testing.assert_array_equal(there.evaluations["returns"], here.evaluations["returns"])
    again = workplace.run("share", workplace.trained, "user/x", "--folder", tmp_path / "out")
    assert again.status == 2
    assert "there is something already" in again.errors


def test_the_card_tells_the_fresh_score(workplace: Workplace, shared: Told) -> None:
    card = workplace.hub.repositories["user/swing"].files["README.md"].decode()
    metadata = yaml.safe_load(card.split("---\n")[1])
    returns = returns_of(workplace.run("evaluate", workplace.trained, "--episodes", "3", "--json"))
    (result,) = metadata["model-index"][0]["results"]
    assert result["task"]["type"] == "reinforcement-learning"
    assert result["dataset"] == {"name": "Pendulum-v1", "type": "Pendulum-v1"}
    (metric,) = result["metrics"]
    assert (metric["type"], metric["args"]["episodes"]) == ("mean_reward", 3)
    assert metric["value"] == f"{np.mean(returns):.2f} +/- {np.std(returns):.2f}"
    assert metadata["library_name"] == "saclab"
    assert {"Pendulum-v1", "reinforcement-learning", "deep-reinforcement-learning"} <= set(metadata["tags"])
    evaluations = read_run(workplace.trained).evaluations["mean_return"]
    for said in (
        "saclab evaluate hf:user/swing --episodes 3 --seed 1000000", "replay.mp4", "over 3 fresh episodes",
        f"best of {len(evaluations)} evaluations",
        "saclab train Pendulum-v1 --variant sac-auto --protocol quick --seed 0",
    ):  # fmt: skip
        assert said in card


def test_an_earlier_upload_leaves_nothing_beside_a_later_one(workplace: Workplace, tmp_path: Path) -> None:
    run = shutil.copytree(workplace.trained, tmp_path / "run")
    assert workplace.run("share", run, "user/again", "--episodes", "1", "--onnx").status == 0
    first = workplace.hub.repositories["user/again"].head
    (run / "best" / "video.mp4").unlink()
    assert workplace.run("share", run, "user/again", "--episodes", "1").status == 0
    assert not {"policy.onnx", "replay.mp4"} & workplace.hub.repositories["user/again"].files.keys()
    assert workplace.run("evaluate", f"hf:user/again@{first}", "--episodes", "1").status == 0
    unknown = workplace.run("evaluate", "hf:user/again@v2", "--episodes", "1")
    assert (unknown.status, unknown.errors.count("\n")) == (2, 1)
    assert "user/again has no revision 'v2'" in unknown.errors


def test_a_film_that_is_older_than_the_policy_is_left_out(workplace: Workplace, tmp_path: Path) -> None:
    run = shutil.copytree(workplace.trained, tmp_path / "run")
    (run / "best" / "policy.json").touch()
    told = workplace.run("share", run, "user/x", "--folder", tmp_path / "out", "--episodes", "1")
    assert "is older than the policy, and left out" in told.output
    assert not (tmp_path / "out" / "replay.mp4").exists()


def test_export_and_load_take_an_address_too(workplace: Workplace, shared: Told, tmp_path: Path) -> None:
    assert workplace.run("export", "hf:user/swing", folder=tmp_path).status == 0
    assert (tmp_path / "swing.onnx").read_bytes() == workplace.hub.repositories["user/swing"].files["policy.onnx"]
    assert not list(workplace.cache.rglob("*.onnx"))


@pytest.mark.parametrize(
    ("repository", "said"),
    [
        ("swing", "write user/name"),
        ("a/b/c", "write user/name"),
        ("user/a--b", "Cannot have -- or .."),
        ("../../etc", "write user/name"),
        ("somebody/else", "does not let this token do that"),
        ("user/foreign", "holds something else (it has 'config.json')"),
    ],
)
def test_a_repository_that_cannot_be_written_is_one_line(workplace: Workplace, repository: str, said: str) -> None:
    before = workplace.hub.make("user/foreign", {"model.bin": b"x", "config.json": b"{}"}).files
    told = workplace.run("share", workplace.trained, repository, "--episodes", "1")
    assert (told.status, told.errors.count("\n")) == (2, 1), told.errors
    assert said in told.errors
    assert workplace.hub.repositories["user/foreign"].files == before


def test_private_is_private_or_refused(workplace: Workplace) -> None:
    assert workplace.run("share", workplace.trained, "user/secret", "--private", "--episodes", "1").status == 0
    assert workplace.hub.repositories["user/secret"].private
    before = workplace.hub.make("user/public", {}).files
    told = workplace.run("share", workplace.trained, "user/public", "--private", "--episodes", "1")
    assert told.status == 2
    assert "everybody sees it" in told.errors
    assert workplace.hub.repositories["user/public"].files == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"xml_file": "/home/ada/robot.xml"}, "environment_arguments.xml_file"),
        ({"options": ["--model=~/robot.xml"]}, "environment_arguments.options"),
    ],
)
def test_paths_of_this_machine_are_not_published(
    workplace: Workplace, tmp_path: Path, arguments: dict[str, object], named: str
) -> None:
    run = shutil.copytree(workplace.trained, tmp_path / "run")
    for name in ("config.json", "best/policy.json"):
        told = json.loads((run / name).read_text())
        told.get("config", told)["environment_arguments"] = arguments
        (run / name).write_text(json.dumps(told))
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"files": {}}))
    shutil.rmtree(run / "checkpoints")  # which know what config.json was
    told = workplace.run("share", run, "user/paths", "--episodes", "1")
    assert told.status == 2
    assert f"{named} = " in told.errors
    assert "user/paths" not in workplace.hub.repositories
    allowed = workplace.run("share", run, "user/paths", "--episodes", "1", "--paths-too")
    assert "is a path of this machine" not in allowed.errors, "it goes on, to a checksum that is not this file's"


LOADED = """
import saclab
print(saclab.load_policy("hf:user/swing").predict([1.0, 0.0, 0.5])[0][0])
"""


def test_load_policy_takes_an_address_and_offline_what_is_cached(workplace: Workplace, shared: Told) -> None:
    def loaded(**environment: str) -> float:
        process = subprocess.run(
            [sys.executable, "-c", LOADED], env=os.environ | environment, capture_output=True, text=True, timeout=600
        )
        assert process.returncode == 0, process.stderr
        return float(process.stdout)

    expected = load_policy(workplace.trained).predict(np.array([1.0, 0.0, 0.5]))[0][0]
    assert loaded() == expected
    before = len(workplace.hub.asked)
    assert loaded(HF_HUB_OFFLINE="1") == expected
    assert len(workplace.hub.asked) == before


# --- what somebody else has put there


ONE = np.ones(1, np.float32)


def foreign(hub: Hub, name: str, folder: Path, environment: str, wrappers: tuple[str, ...] = ()) -> None:
    """A repository of a policy that does nothing, for any environment."""
    config = make_config(environment, overrides={"hidden_layers": (4,), "wrappers": wrappers})
    spec = EnvironmentSpec(3, 1, -2 * ONE, 2 * ONE)
    size = TrainedPolicy(config.algorithm, spec, np.zeros(0)).policy.network.size
    save_policy(folder, config, spec, np.zeros(size, np.float32), {})
    hub.make(name, {path.name: path.read_bytes() for path in folder.iterdir()})


@pytest.mark.parametrize("command", ["evaluate", "record", "play"])
@pytest.mark.parametrize(
    ("environment", "wrappers"), [("evil_module:Env-v0", ()), ("Pendulum-v1", ("evil_module:wrapper",))]
)
def test_what_is_downloaded_imports_nothing_by_itself(
    workplace: Workplace, tmp_path: Path, command: str, environment: str, wrappers: tuple[str, ...]
) -> None:
    foreign(workplace.hub, "mallory/evil", tmp_path / "evil", environment, wrappers)
    evil = f"open({str(tmp_path / 'was here')!r}, 'w')\nwrapper = lambda inner: inner"
    (tmp_path / "evil_module.py").write_text(evil)
    told = workplace.run(command, "hf:mallory/evil", folder=tmp_path)
    assert (told.status, told.errors.count("\n")) == (2, 1), told.errors
    assert "if you trust it, add --imports evil_module" in told.errors
    assert not (tmp_path / "was here").exists()


def test_only_the_policys_own_files_are_fetched(workplace: Workplace, tmp_path: Path) -> None:
    foreign(workplace.hub, "mallory/more", tmp_path / "more", "Pendulum-v1")
    strange = {"../../outside.txt": b"x", "best/policy.json": b"{}", "evil.py": b"x", "policy.pkl": b"x"}
    workplace.hub.repositories["mallory/more"].files.update(strange)
    before = len(workplace.hub.asked)
    assert workplace.run("evaluate", "hf:mallory/more", "--episodes", "1").status == 0
    fetched = {line.rpartition("/")[2] for line in workplace.hub.asked[before:] if "/resolve/" in line}
    assert fetched == set(POLICY)
    assert not list(tmp_path.parent.rglob("outside.txt"))


def test_what_is_too_large_is_not_fetched(workplace: Workplace, tmp_path: Path) -> None:
    foreign(workplace.hub, "mallory/huge", tmp_path / "huge", "Pendulum-v1")
    workplace.hub.claimed_sizes["policy.safetensors"] = 2**40
    before = len(workplace.hub.asked)
    try:
        told = workplace.run("evaluate", "hf:mallory/huge")
    finally:
        workplace.hub.claimed_sizes.clear()
    assert told.status == 2
    assert "policy.safetensors has 1099511627776 bytes" in told.errors
    assert not [line for line in workplace.hub.asked[before:] if "/resolve/" in line]


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ({"policy.json": b"{}"}, "policy.json is damaged"),
        ({"policy.safetensors": b"\x80\x04pickled"}, "is damaged"),
        ({"policy.json": b"../../../etc/passwd"}, "policy.json is damaged"),
        (None, "holds no policy of saclab's: it has no policy.json"),
    ],
    ids=["no description", "no arrays", "a link's target", "no policy"],
)
def test_what_is_no_policy_is_one_line(
    workplace: Workplace, tmp_path: Path, spoilt: dict[str, bytes] | None, said: str
) -> None:
    foreign(workplace.hub, "mallory/spoilt", tmp_path / "spoilt", "Pendulum-v1")
    good = workplace.hub.repositories["mallory/spoilt"].files
    workplace.hub.make("mallory/spoilt", {} if spoilt is None else good | spoilt)
    told = workplace.run("evaluate", "hf:mallory/spoilt")
    assert (told.status, told.errors.count("\n")) == (2, 1), told.errors
    assert said in told.errors


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("hf:user", "write hf:user/name or hf:user/name@revision"),
        ("hf:user/name@", "write hf:user/name or hf:user/name@revision"),
        ("hf:user/nothing", "there is no model user/nothing at http://127.0.0.1"),
    ],
)
def test_an_address_of_nothing_is_one_line(workplace: Workplace, address: str, said: str) -> None:
    told = workplace.run("evaluate", address)
    assert (told.status, told.errors.count("\n")) == (2, 1), told.errors
    assert said in told.errors
