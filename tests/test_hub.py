"""What can go wrong between here and the Hugging Face Hub is told in one line. Round trips: cli/test_share.py."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import huggingface_hub
import pytest
from hub_server import served

from saclab import hub
from saclab.errors import UserError, for_terminal
from saclab.hub import require_own
from saclab.protocols import make_config
from saclab.records import Prefilled
from saclab.sharing.private import public_config, require_no_paths
from saclab.trained_policy import on_disk


@pytest.fixture
def no_token(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(hub.library().constants, "HF_TOKEN_PATH", str(tmp_path / "token"))


@pytest.mark.usefixtures("no_token")
def test_a_missing_token_is_told_before_anything_is_done() -> None:
    with pytest.raises(UserError, match=r"needs a token .* `hf auth login` or set HF_TOKEN"):
        hub.require_token()


@pytest.mark.usefixtures("no_token")
@pytest.mark.parametrize("token", [None, "hf_wrong"])
def test_a_refused_token_is_one_line(monkeypatch: pytest.MonkeyPatch, token: str | None) -> None:
    if token is not None:
        monkeypatch.setenv("HF_TOKEN", token)
    with served() as (address, there):
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", address)
        with pytest.raises(UserError, match=rf"^user/new: {address} refuses the token: .*HF_TOKEN$"):
            hub.upload("user/new", {}, set(), set(), False, "message")
        assert not there.repositories


@pytest.mark.usefixtures("no_token")
@pytest.mark.parametrize(
    "action",
    [lambda: on_disk("hf:user/name"), lambda: hub.upload("user/name", {}, set(), set(), False, "message")],
    ids=["download", "upload"],
)
def test_no_connection_is_one_line(monkeypatch: pytest.MonkeyPatch, action: Callable[[], object]) -> None:
    with socket.socket() as free:  # bound and not listened at: refuses every connection
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", address)
        with pytest.raises(UserError, match=rf"^user/name: no exchange with {address} .*is there a connection") as told:
            action()
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "text",
    ["/home/ada/robot.xml", "~/robot.xml", "~ada/robot.xml", r"C:\robots\one.xml", "C:/robots", r"\\server\share",
     "file:robot.xml", "file:///home/ada", "//server/share/x", "/-x/y", "replay:/home/ada/runs/a",
     "--model=/data/x", f"{Path.home()}"],
)  # fmt: skip
def test_paths_of_a_machine_are_seen_anywhere(text: str) -> None:
    for values in ({"arguments": {"deep": [1, text]}}, {"arguments": {text: 1}}):
        with pytest.raises(UserError, match=r"^arguments(\.deep)? = .*--paths-too"):
            require_no_paths(values)


@pytest.mark.parametrize(
    "text",
    ["HalfCheetah-v4", "dm_control/cheetah-run-v0", "shimmy:dm_control/x-v0", "own:last_four", "assets/robot.xml",
     "https://example.org/robot.xml", "-1330.2 +/- 223.4", "ant_with_goal.xml", "1/2", "a ~ b", ""],
)  # fmt: skip
def test_names_and_addresses_are_no_paths(text: str) -> None:
    require_no_paths({"environment": text, "arguments": [text]})


def test_what_a_run_began_with_is_published_by_its_content() -> None:
    config = make_config("Pendulum-v1", overrides={"prefill": "replay:/home/ada/runs/a"})
    public = public_config(config, Prefilled(100, "ab" * 32))
    assert public.training.prefill == f"replay:{'ab' * 32}"
    require_no_paths(public.to_dict())
    assert public_config(config, None) == config, "there is nothing to name it by"
    by_id = make_config("Pendulum-v1", overrides={"prefill": "minari:mujoco/hopper/expert-v0"})
    assert public_config(by_id, Prefilled(100, "ab" * 32)) == by_id


def test_what_strangers_write_is_printed_without_control_characters() -> None:
    with pytest.raises(UserError) as told:
        require_own("user/name", {"\x1b[2Jevil\n"}, {"policy.json"})
    assert for_terminal(told.value, str(told.value)).isprintable()
    assert for_terminal(UserError(""), "one\x1b[2J\ntwo") == "saclab: one\ufffd[2J\ntwo"
