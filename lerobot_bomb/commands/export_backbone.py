"""``lerobot-bomb export-backbone``: a checkpoint's vision-language model as a folder, a base for others.

A policy of any type that reads the same family of models can start from it:
``--policy.vlm_model_name=FOLDER``.
"""

import argparse

from lerobot.policies import PreTrainedPolicy, get_policy_class
from tokenizers import Tokenizer

from lerobot_bomb.checkpoints.folder import Preprocessor, load_processors, read_config
from lerobot_bomb.commands.arguments import add_folder_arguments
from lerobot_bomb.files import check_new_folder, written_whole
from lerobot_bomb.vlm.backbone import SmolVLMBackbone
from lerobot_bomb.vlm.paligemma import PaliGemmaBackbone
from lerobot_bomb.vlm.qwen import QwenBackbone


def add_export_backbone_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb export-backbone``."""
    add_folder_arguments(parser, "the checkpoint", "new folder")


def run_export_backbone(args: argparse.Namespace) -> int:
    """Write config, weights and tokenizer in transformers' format."""
    check_new_folder("--output", args.output)
    config = read_config(args.policy_path, "cpu")
    policy = get_policy_class(config.type).from_pretrained(str(args.policy_path), config=config)
    backbone = _backbone(policy)
    preprocessor, _ = load_processors(config)
    with written_whole(args.output) as (folder,):
        backbone.vlm.save_pretrained(folder)
        _tokenizer(preprocessor).save(str(folder / "tokenizer.json"))
    print(f"written to {args.output}: start from it with --policy.vlm_model_name={args.output}")
    return 0


def _backbone(policy: PreTrainedPolicy) -> SmolVLMBackbone | PaliGemmaBackbone | QwenBackbone:
    for module in policy.modules():
        if isinstance(module, SmolVLMBackbone | PaliGemmaBackbone | QwenBackbone):
            return module
    raise ValueError(f"a policy of type {policy.config.type} holds no vision-language model to export")


def _tokenizer(preprocessor: Preprocessor) -> Tokenizer:
    for step in preprocessor.steps:
        tokenizer = getattr(step, "tokenizer", None)
        if isinstance(tokenizer, Tokenizer):
            return tokenizer
    raise ValueError("the checkpoint's preprocessor holds no tokenizer")
