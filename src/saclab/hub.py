"""Models on the Hugging Face Hub: found, downloaded, uploaded; whatever fails there is told in one line.

A repository may be anybody's, so only files that are asked for by name are downloaded, and none larger than it may be.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from saclab.errors import UserError, in_words, printable, require, shown
from saclab.extras import required

SCHEME = "hf:"
FORM = f"{SCHEME}user/name or {SCHEME}user/name@revision"
LOG_IN = "make one that may write at https://huggingface.co/settings/tokens, then run `hf auth login` or set HF_TOKEN"
LONGEST_ANSWER = 500
OFFLINE = "with HF_HUB_OFFLINE=1 what has been downloaded before is used as it is"
BY_THE_HUB = {".gitattributes"}
"""What every repository holds. A README.md may be somebody's own words, and is not replaced."""


class Address(NamedTuple):
    """Where a model lies."""

    repository: str
    """user/name."""
    revision: str | None
    """A branch, a tag or a commit; None for the main branch."""


def is_address(run: Path | str) -> bool:
    """Whether `run` is on the Hub, in place of a folder; a folder of such a name is ./hf:…"""
    return str(run).startswith(SCHEME)


def parsed(address: Path | str) -> Address:
    """The parts of hf:user/name@revision; raises SettingError for another form."""
    name, at, revision = str(address).removeprefix(SCHEME).partition("@")
    require(name.count("/") == 1 and bool(revision) == bool(at), "run", str(address), f"write {FORM}")
    require_name(name)
    return Address(name, revision or None)


def require_name(repository: str) -> None:
    """Raise SettingError for what the Hub takes for no user/name."""
    utils = library().utils
    try:
        utils.validate_repo_id(repository)
        reason = "" if repository.count("/") == 1 else "write user/name"
    except utils.HFValidationError as error:
        reason = f"write user/name: {str(error).rpartition(': ')[0] or error}"
    require(not reason, "repository", repository, reason)


def library() -> Any:
    """huggingface_hub with the modules of it that it does not import by itself; raises UserError if it is missing."""
    hub = required("huggingface_hub", "hub", "the Hugging Face Hub")
    for module in ("constants", "errors", "utils"):
        import_module(f"huggingface_hub.{module}")
    return hub


def download(address: Path | str, largest: Mapping[str, int]) -> Path:
    """The folder of huggingface_hub's cache that holds some files of a model, downloaded if they are not there yet.

    Args:
        address: hf:user/name, or hf:user/name@revision.
        largest: name of each file -> bytes that it may have at most.

    Raises:
        UserError: if there is no such model, a file is missing or too large, or the Hub cannot be reached.
    """
    hub = library()
    repository, revision = parsed(address)
    found = None
    with told(repository, revision):
        with suppress(hub.errors.OfflineModeIsEnabled):
            found = hub.HfApi().model_info(repository, revision=revision, files_metadata=True)
            require_files(str(address), {file.rfilename: file.size for file in found.siblings or ()}, largest)
        folder = Path(hub.snapshot_download(repository, revision=revision, allow_patterns=list(largest)))
    if found is not None and folder.name != found.sha:
        raise UserError(f"{address} has changed while it was looked at: give the same command again")
    return folder


def require_files(address: str, sizes: Mapping[str, int | None], largest: Mapping[str, int]) -> None:
    """Raise UserError unless a repository has files of these names, none too large."""
    for name, limit in largest.items():
        if name not in sizes:
            raise UserError(f"{address} holds no policy of saclab's: it has no {name}")
        size = sizes[name]
        if size is None or size > limit:
            raise UserError(f"{address}: {name} has {size} bytes, more than the {limit} that it can have")


def require_token() -> None:
    """Raise UserError unless huggingface_hub has a token to upload with."""
    if library().get_token() is None:
        raise UserError(f"sharing needs a token of the Hugging Face Hub, and there is none: {LOG_IN}")


def upload(
    repository: str, files: Mapping[str, Path], marks: Set[str], optional: Set[str], private: bool, message: str
) -> str:
    """Put files into a model's repository, which is made if there is none, in one commit: all of them or none.

    Args:
        repository: user/name.
        files: name in the repository -> file.
        marks: names by which an earlier upload is known; other models are not written into.
        optional: names of an earlier upload that are taken away where they are not among `files`, so that nothing
            stays beside what it does not belong to.
        private: make the repository so that only its owner sees it.
        message: of the commit.

    Returns:
        The address of its page.

    Raises:
        UserError: if the token is refused, the Hub cannot be reached, or the repository is there and public where
            `private` is asked for, or holds another model.
    """
    hub = library()
    api = hub.HfApi()
    with told(repository, None):
        page = str(api.create_repo(repository, private=private or None, exist_ok=True))
    with nothing_sent(repository), told(repository, None):
        there = api.model_info(repository)
        names = {file.rfilename for file in there.siblings or ()}
        require_own(repository, names, marks)
        if private and not there.private:
            raise UserError(
                f"{repository} is there already and everybody sees it: make it private on {page}/settings, or name "
                "another repository"
            )
        operations = [hub.CommitOperationAdd(name, str(path)) for name, path in files.items()]
        operations += [hub.CommitOperationDelete(name) for name in sorted((names & optional) - files.keys())]
        api.create_commit(repository, operations, commit_message=message, parent_commit=there.sha)
    return page


@contextmanager
def nothing_sent(repository: str) -> Iterator[None]:
    """Add to an error that the repository is there all the same."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{error} (nothing was sent; if there was no {repository} before, it is there now)") from error


def require_own(repository: str, names: Set[str], marks: Set[str]) -> None:
    """Refuse to write into another model, whose card at least would be replaced."""
    others = names - BY_THE_HUB
    if others and not marks <= names:
        raise UserError(
            f"{repository} is there already and holds something else (it has {shown(min(others))}): name another "
            "repository, or remove that first"
        )


@contextmanager
def told(repository: str, revision: str | None) -> Iterator[None]:
    """Say in one line what went wrong between here and the Hub: raises UserError for whatever huggingface_hub does."""
    hub = library()
    errors, at = hub.errors, hub.constants.ENDPOINT
    try:
        yield
    except UserError:
        raise
    except errors.RevisionNotFoundError as error:
        raise UserError(f"{repository} has no revision {revision!r} at {at}") from error
    except errors.GatedRepoError as error:
        raise UserError(
            f"{repository} is open to those only whom its owner has let in: ask at {at}/{repository}"
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise UserError(
            f"there is no model {repository} at {at}, or it is private and your token may not see it: check the name; "
            "log in with `hf auth login` or HF_TOKEN"
        ) from error
    except errors.HfHubHTTPError as error:
        raise UserError(refusal(repository, at, error)) from error
    except Exception as error:  # of whichever HTTP library it uses, of its transfer protocol, or of the disk
        raise UserError(
            f"{repository}: no exchange with {at} ({in_words(error)}): is there a connection? {OFFLINE}"
        ) from error


def refusal(repository: str, at: str, error: Any) -> str:
    """What the Hub's answer means."""
    status = error.response.status_code
    match status:
        case 401:
            return f"{repository}: {at} refuses the token: {LOG_IN}"
        case 403:
            return f"{repository}: {at} does not let this token do that: is the name yours? Else {LOG_IN}"
    said = printable(str(getattr(error, "server_message", None) or in_words(error)), LONGEST_ANSWER)
    return f"{repository}: {at} answered {status} ({said})"
