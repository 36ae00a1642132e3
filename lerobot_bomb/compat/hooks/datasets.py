"""LeRobot's datasets: fewer images are decoded, and a missing dataset is an error of one line."""

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.utils import INFO_PATH

from lerobot_bomb.compat.hooks.replace import replace


def read_asked_columns() -> None:
    """Let LeRobot read only the requested columns of a sample's other frames, not their images.

    Otherwise a chunk of 16 actions decodes the images of all its 16 frames, and throws them away.
    """

    def around(usual: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
        def query(self: Any, query_indices: dict[str, list[int]]) -> dict[str, Any]:
            whole = self.hf_dataset
            columns = vars(self).setdefault("_columns", {})
            result: dict[str, Any] = {}
            try:
                for key, indices in query_indices.items():
                    if key in whole.column_names and columns.get(key, (None,))[0] is not whole:
                        columns[key] = whole, whole.select_columns(key)
                    self.hf_dataset = columns[key][1] if key in columns else whole
                    result |= usual(self, {key: indices})
            finally:
                self.hf_dataset = whole
            return result

        return query

    replace(DatasetReader, "_query_hf_dataset", around)


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
