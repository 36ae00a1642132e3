"""The only place that reaches into names of LeRobot and `datasets` that are not their public interface."""

import json
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from datasets import config
from huggingface_hub import hf_hub_download
from lerobot.datasets import LeRobotDataset, aggregate, compute_stats, dataset_writer
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import to_parquet_with_hf_images
from lerobot.utils.constants import DEFAULT_FEATURES

STATISTICS_SIZE = 128  # pixels


def sample_pixels(image: np.ndarray) -> np.ndarray:
    """(C, H, W) -> every n-th pixel of every n-th row, so that about STATISTICS_SIZE of each are left."""
    stride = max(1, max(image.shape[1:]) // STATISTICS_SIZE)
    return image[:, ::stride, ::stride]


@contextmanager
def sampled_image_statistics() -> Iterator[None]:
    """Let LeRobot's video encoder take image statistics from a sample of the pixels.

    It samples so itself from 300 pixels on; all pixels of a 256x256 frame cost 5 ms of one core.
    """
    usual = compute_stats.auto_downsample_height_width
    compute_stats.auto_downsample_height_width = sample_pixels
    try:
        yield
    finally:
        compute_stats.auto_downsample_height_width = usual


@contextmanager
def without_statistics(keys: Collection[str]) -> Iterator[None]:
    """Let LeRobot write no statistics of these features, and so normalise none of them.

    It would take them of every pixel apart: gigabytes of histograms for one depth picture.
    """
    usual = dataset_writer.compute_episode_stats

    def compute(data: dict[str, Any], features: dict[str, dict]) -> dict[str, dict]:
        return usual({key: values for key, values in data.items() if key not in keys}, features)

    dataset_writer.compute_episode_stats = compute
    try:
        yield
    finally:
        dataset_writer.compute_episode_stats = usual


@contextmanager
def mergeable_arrays(features: dict[str, dict]) -> Iterator[None]:
    """Let LeRobot merge tables that hold arrays of two dimensions.

    It can where they hold images too, because it then names their types; elsewhere pyarrow must guess them.
    """
    usual = aggregate.to_parquet_one_row_group_per_episode
    types = get_hf_features_from_features(features | DEFAULT_FEATURES)
    aggregate.to_parquet_one_row_group_per_episode = partial(to_parquet_with_hf_images, features=types)
    try:
        yield
    finally:
        aggregate.to_parquet_one_row_group_per_episode = usual


def abandon(dataset: LeRobotDataset) -> None:
    """End the threads of a dataset that is being written, and let none of it be written later.

    When it is garbage collected, LeRobot would write its table of episodes, and make the folder for it anew.
    """
    dataset.clear_episode_buffer()
    dataset.meta._finalized = True


@contextmanager
def datasets_cache(folder: Path) -> Iterator[None]:
    """Let `datasets` cache what it reads here only; in the user's cache a copy of it would stay."""
    usual = config.HF_DATASETS_CACHE
    config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        config.HF_DATASETS_CACHE = usual
        shutil.rmtree(folder, ignore_errors=True)


def lerobot_eval_with(flags: Sequence[str], wrap: Callable[[Any, Any], Any]) -> None:
    """Run lerobot-eval with these flags, on what `wrap(config, environments)` makes of its environments."""
    from lerobot.scripts import lerobot_eval

    usual, argv = lerobot_eval.make_env, sys.argv
    lerobot_eval.make_env = lambda config, **options: wrap(config, usual(config, **options))
    sys.argv = ["lerobot-eval", *flags]  # which LeRobot's parser also reads elsewhere
    try:
        lerobot_eval.main()
    finally:
        lerobot_eval.make_env, sys.argv = usual, argv


def serve_registered_policies(config: Any) -> None:
    """Run LeRobot's policy server, a PolicyServerConfig's, for every registered policy type until Ctrl-C.

    It knows a list of LeRobot's own types, and imports no plugins.
    """
    from lerobot.async_inference import policy_server
    from lerobot.configs import PreTrainedConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    policy_server.SUPPORTED_POLICIES[:] = sorted(PreTrainedConfig.get_known_choices())
    policy_server.serve(config)


def check_processors_before_use(
    check: Callable[[dict[str, Any], str, object], Any],
    check_loaded: Callable[[Sequence[Any], str, object], None],
) -> None:
    """Let LeRobot's loader build no step of a saved processor before `check(its JSON, where, type)`.

    Here what is checked is what will be built; `type` is the checkpoint's. Then `check_loaded(steps, where,
    type)`. From the Hub, states are of the commit that the JSON is of.
    """
    from lerobot.processor import DataProcessorPipeline

    usual: Any = DataProcessorPipeline._build_steps_with_overrides

    def build(
        cls: type,
        loaded_config: dict[str, Any],
        overrides: dict[str, Any],
        model_id: str,
        base_path: Path,
        hub_download_kwargs: dict[str, Any],
        is_local_source: bool = False,
    ) -> Any:
        commits = [part for part in base_path.parts if re.fullmatch("[0-9a-f]{40}", part)]
        if commits and not is_local_source:
            hub_download_kwargs = hub_download_kwargs | {"revision": commits[-1]}
        policy_type = _policy_type(model_id, base_path, hub_download_kwargs, is_local_source)
        where = f"{model_id}, {loaded_config.get('name')}"
        check(loaded_config, where, policy_type)
        steps, unused = usual.__func__(
            cls, loaded_config, overrides, model_id, base_path, hub_download_kwargs, is_local_source
        )
        check_loaded(steps, where, policy_type)
        return steps, unused

    DataProcessorPipeline._build_steps_with_overrides = classmethod(build)  # pyright: ignore[reportAttributeAccessIssue]


def _policy_type(model_id: str, folder: Path, download: dict[str, Any], is_local: bool) -> object:
    """What the config.json beside a processor says; None without one."""
    path = folder / "config.json"
    if not path.is_file() and not is_local:
        with suppress(OSError):
            path = Path(hf_hub_download(model_id, path.name, **download))
    try:
        return json.loads(path.read_text()).get("type")
    except (OSError, ValueError, AttributeError):
        return None
