"""A checkpoint's vision-language model as a folder of its own."""

from pathlib import Path

from lerobot.policies import PreTrainedPolicy, get_policy_class
from tokenizers import Tokenizer

from lerobot_bomb.checkpoints.folder import Preprocessor, load_processors, read_config
from lerobot_bomb.files import written_whole
from lerobot_bomb.vlm.backbone import SmolVLMBackbone
from lerobot_bomb.vlm.paligemma import PaliGemmaBackbone
from lerobot_bomb.vlm.qwen import QwenBackbone


def export_backbone(checkpoint: Path, output: Path) -> None:
    """Write config, weights and tokenizer in transformers' format.

    Raises:
        ValueError: the policy holds no such model, or its processors no tokenizer.
    """
    config = read_config(checkpoint, "cpu")
    policy = get_policy_class(config.type).from_pretrained(str(checkpoint), config=config)
    backbone = _backbone(policy)
    preprocessor, _ = load_processors(config)
    with written_whole(output) as (folder,):
        backbone.vlm.save_pretrained(folder)
        _tokenizer(preprocessor).save(str(folder / "tokenizer.json"))


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
