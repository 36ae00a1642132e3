"""LeRobot's datasets: frames are read from memory, and a missing dataset is an error of one line."""

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.utils import INFO_PATH

from lerobot_bomb.compat.hooks.replace import replace


def keep_frames_in_memory(keep: Callable[[Any], Any]) -> None:
    """Put `keep(frames)` in the place of the Hugging Face dataset that LeRobot takes samples from."""

    def around(usual: Callable[..., Any]) -> Callable[..., Any]:
        def load(self: DatasetReader) -> Any:
            return keep(usual(self))

        return load

    replace(DatasetReader, "_load_hf_dataset", around)


def explain_missing_datasets(explain: Callable[[str, Path, Exception], str]) -> None:
    """Turn the error of a dataset that is neither here nor on the Hub into `explain(repo_id, root, error)`.

    LeRobot asks the Hub for whatever it does not find, and ends in a hundred lines of the HTTP library.
    """

    def around(usual: Callable[..., None]) -> Callable[..., None]:
        def load(self: LeRobotDatasetMetadata, *args: Any, **kwargs: Any) -> None:
            try:
                usual(self, *args, **kwargs)
            except ValueError:  # the arguments are wrong
                raise
            except Exception as error:
                root = getattr(self, "root", None)
                if root is None or (root / INFO_PATH).is_file():
                    raise
                repo_id = signature(usual).bind(self, *args, **kwargs).arguments["repo_id"]
                raise FileNotFoundError(explain(repo_id, root, error)) from None

        return load

    replace(LeRobotDatasetMetadata, "__init__", around)
