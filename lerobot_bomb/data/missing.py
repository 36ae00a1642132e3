"""Error of one line for a dataset that is neither on this machine nor on the Hub, with likely causes."""

from pathlib import Path

from lerobot_bomb.data.unfinished import parameters_file, parts_folder, unfinished_folder

RESUMED_BY = {
    "recording": "lerobot-bomb record",
    "conversion": "lerobot-bomb convert",
}


def describe_missing_dataset(repo_id: str, root: Path, error: Exception) -> str:
    """Describe what is missing, and an unfinished dataset of that name if there is one."""
    for kind, command in RESUMED_BY.items():
        folder = unfinished_folder(root, kind)
        if parameters_file(folder).is_file():
            return f"the {kind} {root} is not finished ({folder}): resume by `{command} ... --resume`"
    if parts_folder(root).is_dir():
        return (
            f"the recording {root} lies in parts ({parts_folder(root)}): join them with "
            "`lerobot-bomb record ... --join`"
        )
    reason = str(error).strip().splitlines() or [""]
    return (
        f"{root} holds no dataset (meta/info.json), and {repo_id} cannot be had from the Hub "
        f"({type(error).__name__}: {reason[0]}); is --dataset.root, or --dataset.repo_id, misspelt?"
    )
