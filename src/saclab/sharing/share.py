"""Share a run's best policy: a folder with all that belongs to it, and its upload to the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from saclab.errors import SettingError, UserError, require
from saclab.files import replace_file, write_json
from saclab.hub import require_name, require_token, upload
from saclab.playback import evaluate, record
from saclab.records import is_there, read_bytes
from saclab.sharing.model_card import VIDEO, Card
from saclab.sharing.private import public_config, public_description, public_result, require_no_paths
from saclab.trained_policy import POLICY_BYTES, load_policy, policy_folder
from saclab.trained_policy import read_description as read_policy_description
from saclab.training.logs import OF_TERMS
from saclab.training.run_folder import RunRecord, read_description, read_result, read_run

CARD, ONNX = "README.md", "policy.onnx"
RESULTS = ("config.json", "result.json", "evaluations.csv", OF_TERMS)
TEXTS = (".json", ".md")
ATTEMPTS = 3
FILM_STEPS, FILM_SIZE = 1000, 320
"""Of a film that is made for sharing: an episode of most environments, in steps; pixels."""

Tell = Callable[[str], None]


def share(
    run: Path,
    repository: str,
    folder: Path | None = None,
    *,
    private: bool = False,
    license: str | None = None,
    video: bool = False,
    onnx: bool = False,
    episodes: int = 20,
    seed: int = 1_000_000,
    imports: Sequence[str] = (),
    paths_too: bool = False,
    tell: Tell = print,
) -> str:
    """Put a run's best policy, its results and a model card on the Hugging Face Hub, or into a folder.

    Args:
        run: the run folder.
        repository: user/name on the Hub, made if there is none.
        folder: write there what would be sent, and send nothing.
        private: make the repository so that only its owner sees it.
        license: an identifier of the Hub's for the card, such as mit.
        video: film an episode anew; else video.mp4 in best is taken if there is one.
        onnx: add the policy as an ONNX file.
        episodes: fresh ones, of which the card tells the score.
        seed: of those episodes.
        imports: packages that the run's environment may import.
        paths_too: publish paths of this machine that the configuration holds.
        tell: takes what is done, and what is sent before it is.

    Returns:
        Where it lies: the address of the page, or the folder.

    Raises:
        UserError: if there is no token, the Hub refuses or cannot be reached, the run has no policy, its configuration
            names a path of this machine, or `folder` is not empty. Nothing has been sent then.
    """
    require(episodes >= 1, "episodes", episodes, "use at least 1")
    require_name(repository)
    require_fresh(folder) if folder is not None else require_token()
    found = public_record(run, paths_too)
    with TemporaryDirectory(prefix="saclab-share-") as name:
        copy = Path(name)
        copy_policy(run, copy)  # what is sent is what is evaluated, whatever a run that goes on finds meanwhile
        tell(f"evaluating the best policy on {episodes} fresh episodes …")
        score = evaluate(copy, episodes, seed, imports=imports, left_in=run)
        files = collect(run, copy, Card(repository, found, score, seed, imports, license), video, onnx, tell)
        if not paths_too:
            require_no_paths({name: path.read_text() for name, path in files.items() if path.suffix in TEXTS})
        tell("\n".join(f"  {path.name:<20} {path.stat().st_size:>12,} bytes" for path in files.values()))
        return str(written(files, folder)) if folder is not None else sent(repository, files, found, private, tell)


def public_record(run: Path, paths_too: bool) -> RunRecord:
    """A run with its configuration as it may be published; raises UserError for a path of this machine in it."""
    found = read_run(run)
    found = found._replace(config=public_config(found.config, found.prefill))
    if not paths_too:
        require_no_paths(found.config.to_dict() | msgspec.to_builtins(read_policy_description(run)))
    return found


def sent(repository: str, files: dict[str, Path], found: RunRecord, private: bool, tell: Tell) -> str:
    """Upload the files; the address of the page."""
    seen = "which only you will see" if private else "for everybody to see, unless the repository is private"
    tell(f"sending these to {repository}, {seen} …")
    message = f"{found.config.variant} on {found.config.environment}, trained and shared by saclab"
    return upload(repository, files, POLICY_BYTES.keys(), {VIDEO, ONNX, *RESULTS}, private, message)


def require_fresh(folder: Path) -> None:
    """Raise SettingError for a folder that holds something."""
    if is_there(folder) and not (folder.is_dir() and not any(folder.iterdir())):
        raise SettingError("folder", str(folder), "there is something already: name a new folder")


def copy_policy(run: Path, folder: Path) -> None:
    """Copy the two files of a policy, which belong together, from a run that may find a better one meanwhile."""
    for attempt in range(ATTEMPTS):
        for name in POLICY_BYTES:
            replace_file(folder / name, read_bytes(policy_folder(run) / name))
        try:
            load_policy(folder)
            return
        except UserError:
            if attempt + 1 == ATTEMPTS:
                load_policy(run)  # says what is wrong there
                raise


def collect(run: Path, folder: Path, card: Card, video: bool, onnx: bool, tell: Tell) -> dict[str, Path]:
    """All that is shared, by name, put beside the policy in a folder."""
    copy_results(run, card.run, folder)
    add_film(run, folder, video, card, tell)
    if onnx:
        from saclab.onnx_export import export_onnx

        export_onnx(folder, folder / ONNX)
    names = [path.name for path in folder.iterdir()]
    replace_file(folder / CARD, card.text(names).encode())
    return {file: folder / file for file in sorted([*names, CARD])}


def copy_results(run: Path, found: RunRecord, folder: Path) -> None:
    """The configuration, the evaluations and the result, without what tells of the machine."""
    write_json(folder / "config.json", public_description(read_description(run, {})))
    for name in ("evaluations.csv", *([OF_TERMS] if found.reward_terms else [])):
        replace_file(folder / name, read_bytes(run / name))
    result = read_result(run)
    if result is not None:
        write_json(folder / "result.json", public_result(result))


def add_film(run: Path, folder: Path, anew: bool, card: Card, tell: Tell) -> None:
    """A film of the policy: a new one, or that in the run folder unless a better policy has been found since."""
    best = policy_folder(run)
    filmed = best / "video.mp4"
    if anew:
        tell("filming an episode …")
        record(folder, folder / VIDEO, FILM_STEPS, card.seed, FILM_SIZE, card.imports, left_in=run)
    elif is_there(filmed):
        if filmed.stat().st_mtime < max((best / name).stat().st_mtime for name in POLICY_BYTES):
            tell(f"{filmed} is older than the policy, and left out: --video films it anew")
        else:
            replace_file(folder / VIDEO, read_bytes(filmed))


def written(files: dict[str, Path], folder: Path) -> Path:
    """The folder with copies of these files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, path in files.items():
            replace_file(folder / name, path.read_bytes())
    except OSError as error:
        raise SettingError("folder", str(folder), f"{error.strerror or error}; name another") from error
    return folder
