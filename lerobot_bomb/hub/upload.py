"""Upload of files to a repository in one commit: all of them or none."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx
from huggingface_hub import CommitInfo, CommitOperationAdd, CommitOperationDelete, HfApi, constants, get_token
from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled

from lerobot_bomb.data.hub_token import LOG_IN, check_token_characters

OFFLINE = "HF_HUB_OFFLINE is set, so nothing can be pushed"


def check_token() -> None:
    """Raise a ValueError if HF_HUB_OFFLINE is set, or there is no valid token."""
    if constants.HF_HUB_OFFLINE:
        raise ValueError(OFFLINE)
    token = get_token()
    if token is None:
        raise ValueError(f"the Hub asks who you are: {LOG_IN}")
    check_token_characters(token)


def upload(
    repo_id: str,
    repo_type: str,
    files: Mapping[str, Path | bytes],
    replaces: Callable[[str], bool],
    message: str,
    private: bool | None,
) -> CommitInfo:
    """Make the repository unless it exists; in one commit, add all files and delete those they replace.

    ``replaces`` returns True for a path of an older push that would be read as well.
    `HfApi.upload_folder` would make several commits where Xet is installed.

    Raises:
        RuntimeError: the Hub cannot be reached or does not take them.
    """
    api = HfApi()
    with hub_errors(repo_id):
        repo_id = api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True).repo_id
        there = api.list_repo_files(repo_id, repo_type=repo_type)
        operations = [
            *(CommitOperationAdd(name, content) for name, content in files.items()),
            *(CommitOperationDelete(name) for name in there if replaces(name) and name not in files),
        ]
        return api.create_commit(repo_id, operations, commit_message=message, repo_type=repo_type)


@contextmanager
def hub_errors(repo_id: str) -> Iterator[None]:
    """Turn errors of the Hub, or of the connection to it, into one line."""
    try:
        yield
    except OfflineModeIsEnabled:
        raise RuntimeError(OFFLINE) from None
    except HfHubHTTPError as error:
        reason = error.server_message or f"{error.response.status_code} {error.response.reason_phrase}"
        raise RuntimeError(f"{repo_id}: the Hub answers: {' '.join(reason.split())}") from None
    except httpx.HTTPError as error:
        reason = f"the Hub at {constants.ENDPOINT} cannot be reached: {error}"
        raise RuntimeError(f"{repo_id}: {reason}; push again: all is published at once, or nothing") from None
