"""Check of a saved processor, before LeRobot calls the code that it names; which statistics it gets."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.constants import CONFIG_NAME
from lerobot.processor import DataProcessorPipeline

from lerobot_bomb.compat.hooks.replace import replace


def check_processors_before_use(
    check: Callable[[dict[str, Any], str, Path], Any],
    check_loaded: Callable[[Sequence[Any], str, Path], None],
    statistics_to_set: Callable[[dict[str, Any]], dict[str, Any] | None],
) -> None:
    """Have saved processors checked before LeRobot's loader builds their steps, and again once loaded.

    First `check(its JSON, where, config.json)` sees what will be built, then `check_loaded(steps, where,
    config.json)`. From the Hub, states and config.json, which may be missing, are of the JSON's commit.
    Where `lerobot-train` would set its dataset's statistics, it sets `statistics_to_set(those)`; None: the
    saved ones stay.
    """

    def with_statistics(values: dict[str, Any]) -> dict[str, Any]:
        if "stats" not in values:
            return values
        others = {name: value for name, value in values.items() if name != "stats"}
        statistics = statistics_to_set(values["stats"])
        return others if statistics is None else {**others, "stats": statistics}

    def around(usual: Callable[..., Any]) -> Callable[..., Any]:
        def build(cls: type, *args: Any, **kwargs: Any) -> Any:
            bound = signature(usual).bind(cls, *args, **kwargs)
            given = bound.arguments
            content = given["loaded_config"]
            commits = [part for part in given["base_path"].parts if re.fullmatch("[0-9a-f]{40}", part)]
            if commits and not given.get("is_local_source"):
                given["hub_download_kwargs"] = given["hub_download_kwargs"] | {"revision": commits[-1]}
            where, config_file = f"{given['model_id']}, {content.get('name')}", _config_file(given)
            check(content, where, config_file)
            given["overrides"] = {
                step: with_statistics(values) for step, values in given["overrides"].items()
            }
            steps, unused = usual(*bound.args, **bound.kwargs)
            check_loaded(steps, where, config_file)
            return steps, unused

        return build

    replace(DataProcessorPipeline, "_build_steps_with_overrides", around)


def _config_file(given: dict[str, Any]) -> Path:
    """Return where the config.json beside a processor is, or would be."""
    path = given["base_path"] / CONFIG_NAME
    if not given.get("is_local_source") and not path.is_file():
        # LeRobot 0.6.2 says in which folder of the repository; earlier ones read its root
        name = (Path(given.get("config_filename", "")).parent / CONFIG_NAME).as_posix()
        with suppress(OSError):
            return Path(hf_hub_download(given["model_id"], name, **given["hub_download_kwargs"]))
    return path
