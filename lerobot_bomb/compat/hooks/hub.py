"""Uploads to the Hub: no token that a header cannot hold, and a trained policy of ours as one commit."""

import sys
from collections.abc import Callable
from inspect import signature
from typing import Any

from huggingface_hub.utils import _headers
from torch import distributed

from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_ours


def check_tokens_before_use(check: Callable[[str], None]) -> None:
    """Let huggingface_hub send no token before `check(token)`."""

    def around(usual: Callable[..., str | None]) -> Callable[..., str | None]:
        def get_token_to_send(*args: Any, **kwargs: Any) -> str | None:
            found = usual(*args, **kwargs)
            if found is not None:
                check(found)
            return found

        return get_token_to_send

    replace(_headers, "get_token_to_send", around)


def publish_as_the_policy_says() -> None:
    """Let lerobot-train publish a policy of ours by its `push_model_to_hub`, as LeRobot 0.6.1 does.

    0.6.2 uploads four commits with a card of its own, and does not call the method. All processes call it.
    """
    from lerobot.common import train_utils

    if not hasattr(train_utils, "publish_trained_model"):
        return

    def around(usual: Callable[..., None]) -> Callable[..., None]:
        def publish_trained_model(*args: Any, **kwargs: Any) -> None:
            given = signature(usual).bind(*args, **kwargs).arguments
            model = given["model"]
            if not is_ours(type(model)):
                return usual(*args, **kwargs)
            model.push_model_to_hub(
                given["cfg"], peft_model=given.get("peft_model"), dataset_meta=given["dataset_meta"]
            )
            for processor in (given["preprocessor"], given["postprocessor"]):
                if processor is not None:
                    processor.push_to_hub(model.config.repo_id, private=model.config.private)
            if distributed.is_initialized():
                distributed.barrier()

        return publish_trained_model

    for module in (train_utils, sys.modules.get("lerobot.scripts.lerobot_train")):
        if module is not None:
            replace(module, "publish_trained_model", around)
