"""What was made to harm is refused in words, and never run."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from saclab.errors import TrainingFailed, UserError
from saclab.trained_policy import load_policy
from saclab.training.checkpoint import CheckpointError
from saclab.training.logs import LOGS
from saclab.training.run_folder import read_config

from .stage import FIRST, SECOND, change_arrays, newest, older, put, sign


class Harm:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return os.system, (f"touch '{self.path}'",)


def npz_with_objects(harm: Harm) -> bytes:
    file = io.BytesIO()
    np.savez(file, actor=np.array([harm], object))
    return file.getvalue()


HOSTILE = {
    "pickle": pickle.dumps,
    "npz with objects": npz_with_objects,
    "yaml": lambda harm: f"!!python/object/apply:os.system ['touch {harm.path}']\n".encode(),
    "python": lambda harm: f"import os; os.system('touch {harm.path}')\n".encode(),
    "header of an exabyte": lambda harm: struct.pack("<Q", 2**60) + b"{}",
    "header of 90 MB": lambda harm: struct.pack("<Q", 90_000_000) + b'{"a":' + b"[" * 1000,
    "header that is no JSON": lambda harm: struct.pack("<Q", 8) + b"{{{{{{{{",
    "array of an exabyte": lambda harm: tensor_file("F32", [2**58], [0, 2**60]),
    "array that overflows": lambda harm: tensor_file("F32", [2**40, 2**40], [0, 16]),
    "array outside its file": lambda harm: tensor_file("F32", [4], [1000, 1016]),
    "array of an unknown type": lambda harm: tensor_file("PICKLE", [4], [0, 16]),
    "array of a type that NumPy lacks": lambda harm: tensor_file("F8_E4M3", [16], [0, 16]),
    "nothing": lambda harm: b"",
}


def tensor_file(kind: str, shape: list[int], offsets: list[int]) -> bytes:
    header = json.dumps({"metrics": {"dtype": kind, "shape": shape, "data_offsets": offsets}}).encode()
    return struct.pack("<Q", len(header)) + header + bytes(16)


@pytest.mark.parametrize("content", HOSTILE)
@pytest.mark.parametrize("name", ["learner.safetensors", "replay-0000.safetensors"])
def test_a_file_made_to_harm_is_refused_unread(stage, folder, tmp_path, name, content):
    """Its checksum is right."""
    harm = tmp_path / "harmed"
    put(newest(folder), name, HOSTILE[content](Harm(harm)))
    started = stage.continue_from(folder)
    assert started.resumed_at_step == FIRST
    assert any(f"is damaged: {name}" in note for note in started.notes)
    assert not harm.exists()


@pytest.mark.parametrize("content", HOSTILE)
def test_a_manifest_made_to_harm_is_refused(stage, folder, tmp_path, content):
    harm = tmp_path / "harmed"
    sign(newest(folder), HOSTILE[content](Harm(harm)))
    assert stage.continue_from(folder).resumed_at_step == FIRST
    assert not harm.exists()


NAMES = ("../../../secret.safetensors", "/etc/passwd", "learner.safetensors/../../x.safetensors", "a\0.safetensors",
         "learner.npz", "best.pickle", "..", "", "replay-9999.safetensors", "Learner.safetensors")  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_no_checkpoint_has_is_refused(stage, folder, name):
    manifest = json.loads((newest(folder) / "manifest.json").read_text())
    manifest["files"][name] = manifest["files"]["learner.safetensors"]
    sign(newest(folder), manifest)
    started = stage.continue_from(folder)
    assert started.resumed_at_step == FIRST


def test_links_and_pipes_are_not_followed(stage, folder, tmp_path):
    path = newest(folder) / "learner.safetensors"
    outside = tmp_path / "outside"
    path.rename(outside)
    for make in (lambda: path.symlink_to(outside), lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero")):
        make()
        assert stage.continue_from(folder).resumed_at_step == FIRST
        path.parent.with_suffix(".damaged").rename(path.parent)
        path.unlink()


def test_a_file_larger_than_memory_is_not_read(stage, folder):
    path = newest(folder)
    os.truncate(path / "learner.safetensors", 2**42)  # takes no room on the disk
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["files"]["learner.safetensors"]["bytes"] = 2**42
    sign(path, manifest)
    started = stage.continue_from(folder)
    assert any("bytes of memory are free" in note for note in started.notes)
    os.truncate(path.with_suffix(".damaged") / "learner.safetensors", 0)


WRONG_ARRAYS = {
    "learner of another type": ("learner.safetensors", {".temperature.weights": np.zeros((), np.float64)}),
    "learner of another shape": ("learner.safetensors", {".actor.weights": np.zeros(3, np.float32)}),
    "moments of another shape": ("learner.safetensors", {".actor.moments.mu": np.zeros(3, np.float32)}),
    "moments that are not finite": ("learner.safetensors", {".temperature.moments.nu": np.array(np.nan, np.float32)}),
    "a learner that is not finite": ("learner.safetensors", {".temperature.weights": np.array(np.inf, np.float32)}),
    "learner with a part missing": ("learner.safetensors", {".key": None}),
    "window of another width": ("window.safetensors", {"metrics": np.zeros((2, 3), np.float32)}),
    "window of another type": ("window.safetensors", {"metrics": np.zeros((2, 9), np.float64)}),
    "no window": ("window.safetensors", {"metrics": np.zeros((), np.float32)}),
    "best policy of another size": ("best.safetensors", {"actor": np.zeros(5, np.float32)}),
    "no best policy": ("best.safetensors", {"actor": None}),
    "observation of another size": ("environments.safetensors", {"0.observation": np.zeros(4, np.float32)}),
    "no observation": ("environments.safetensors", {"1.observation": None}),
    "simulator of another size": ("environments.safetensors", {"0.physics.state": np.zeros(9)}),
    "simulator of another type": ("environments.safetensors", {"0.physics.state": np.zeros(2, np.float32)}),
    "no simulator": ("environments.safetensors", {"1.physics.state": None}),
}


@pytest.mark.parametrize("what", WRONG_ARRAYS)
def test_arrays_that_do_not_fit_are_named(stage, folder, what):
    name, changes = WRONG_ARRAYS[what]
    change_arrays(newest(folder), name, **changes)
    with pytest.raises(CheckpointError, match=r"cannot continue .*the checkpoint.*remove .*checkpoints"):
        stage.continue_from(folder)


def test_transitions_of_another_type_are_damage(stage, folder):
    change_arrays(newest(folder), "replay-0001.safetensors", rows=np.zeros((40, 9), np.float64))
    assert stage.continue_from(folder).resumed_at_step == FIRST


OTHERS = (None, "text", -1, 1.5, True, [], {}, [None], 10**30, 2**63, "NaN", {"a": []}, 0)


def places(value: object, path: tuple = ()) -> list[tuple]:
    """The path of every entry of a JSON value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [found for key, part in inner for found in places(part, (*path, key))]


def with_entry(value: dict, path: tuple, *new: object) -> dict:
    """A copy with another value, or none, in one place."""
    copy = json.loads(json.dumps(value))
    holder = copy
    for key in path[:-1]:
        holder = holder[key]
    if new:
        holder[path[-1]] = new[0]
    else:
        del holder[path[-1]]
    return copy


@pytest.mark.parametrize("count", [40, pytest.param(600, marks=pytest.mark.slow)])
def test_any_other_value_in_the_manifest_is_an_error_in_words(stage, folder, count):
    """Every entry replaced by values of every kind, or removed, with the right checksum: never a traceback."""
    manifest = json.loads((newest(folder) / "manifest.json").read_text())
    shutil.rmtree(older(folder))
    chance = random.Random(count)
    outcomes = {"read": 0, "refused": 0}
    everything = [(path, new) for path in places(manifest) for new in [(), *((other,) for other in OTHERS)]]
    for path, new in chance.sample(everything, count):
        sign(newest(folder), with_entry(manifest, path, *new))
        try:
            stage.continue_from(folder)
            outcomes["read"] += 1
        except (TrainingFailed, UserError):
            outcomes["refused"] += 1
    assert outcomes["refused"] > count / 2, outcomes
    for name in LOGS:  # a smaller length of a log is a valid one, and has cut it
        shutil.copy(stage.saved / name, folder / name)
    sign(newest(folder), manifest)
    assert stage.continue_from(folder).resumed_at_step == SECOND


WRONG_STATES = {
    "steps": (("counters", "steps"), -1, r"Expected `int` >= 0 - at `\$\.counters\.steps`"),
    "updates of another kind": (("counters", "updates"), 1.5, r"\$\.counters\.updates"),
    "a length": (("environments", 1, "length"), True, r"\$\.environments\[1\]\.length"),
    "elapsed steps": (("environments", 0, "elapsed_steps"), ["7"], r"\$\.environments\[0\]\.elapsed_steps"),
    "another generator": (("sampling", "bit_generator"), "MT19937", r"\$\.sampling\.bit_generator"),
    "a generator's words": (("exploration", "state", "inc"), "1", r"\$\.exploration\.state\.inc"),
    "a generator that NumPy refuses": (("exploration", "state", "inc"), 2**128, "the generator 'exploration'"),
    "the machine": (("facts", "machine", "threads"), [1], r"\$\.facts\.machine"),
    "a log": (("logs", "metrics.jsonl", "sha256"), "0", r"\$\.logs\[\.\.\.\]\.sha256"),
}


@pytest.mark.parametrize("what", WRONG_STATES)
def test_a_state_that_does_not_fit_is_named_with_its_place(stage, folder, what):
    path, value, words = WRONG_STATES[what]
    manifest = json.loads((newest(folder) / "manifest.json").read_text())
    sign(newest(folder), with_entry(manifest, ("state", *path), value))
    with pytest.raises(CheckpointError, match=f"cannot continue .*{words}.*remove .*checkpoints"):
        stage.continue_from(folder)


def test_any_other_value_in_the_configuration_is_read_or_refused(folder):
    """Read as it stands, or refused with an error in words: never a traceback. Checkpoints know what it was."""
    path = folder / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"config\.json is damaged \(it has \d+ bytes, and \d+ were written\)"):
        read_config(folder)
    shutil.rmtree(folder / "checkpoints")
    outcomes = {"read": 0, "refused": 0}
    for place in places(config):
        for new in [(), *((other,) for other in OTHERS)]:
            changed = with_entry(config, place, *new)
            path.write_text(json.dumps(changed))
            try:
                read = read_config(folder).to_dict()
                outcomes["read"] += 1
            except UserError:
                outcomes["refused"] += 1
                continue
            if new not in ((), ({},), (10**30,)):  # what is missing has its default; 10**30 is read as 1e30
                assert read == changed["config"], place
    assert min(outcomes.values()) > 50, outcomes


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"format": 1}', b"1" * 5000]
)
@pytest.mark.parametrize("name", ["config.json", "best/policy.json"])
def test_a_damaged_description_is_named(stage, folder, name, content):
    (folder / name).write_bytes(content)
    with pytest.raises(UserError, match=name):
        stage.continue_from(folder) if name == "config.json" else load_policy(folder)


@pytest.mark.parametrize("content", HOSTILE)
def test_a_policy_made_to_harm_is_refused(folder, tmp_path, content):
    harm = tmp_path / "harmed"
    (folder / "best" / "policy.safetensors").write_bytes(HOSTILE[content](Harm(harm)))
    with pytest.raises(UserError, match="is damaged"):
        load_policy(folder)
    assert not harm.exists()
