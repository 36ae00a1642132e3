"""A checkpoint's folder, as `lerobot-train` leaves it, and what can be wrong with one."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from fdvla_cases import make_policy as make_fdvla
from safetensors.torch import load_file, save_file
from vla0_smol_cases import STATS, make_policy

from lerobot_policy_vla0_smol import make_vla0_smol_pre_post_processors

type Damage = Callable[[Path], None]

LOCAL = "/data/models/SmolVLM2-500M-Video-Instruct"
WEIGHTS = "model.safetensors"
TOKENIZER = "policy_preprocessor_step_2_bomb_task_tokenizer.safetensors"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"


def write_checkpoint(folder: Path) -> None:
    """Of a `vla0_smol` whose backbone came from a folder, with what belongs to the training beside it."""
    policy = make_policy()
    for processor in make_vla0_smol_pre_post_processors(policy.config, STATS):
        processor.save_pretrained(folder)
    policy.config.vlm_model_name = LOCAL
    policy.save_pretrained(folder)
    (folder / "optimizer.pkl").write_bytes(b"not for others")


def remove(*names: str) -> Damage:
    def damage(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return damage


def truncate(name: str) -> Damage:
    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return damage


def write(name: str, text: str) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).write_text(text)

    return damage


def change_config(**values: Any) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return damage


def take_other_weights(folder: Path) -> None:
    make_fdvla().save_pretrained(folder / "other")
    (folder / "other" / WEIGHTS).rename(folder / WEIGHTS)


def take_other_shape(folder: Path) -> None:
    weights = load_file(folder / WEIGHTS)
    save_file({**weights, min(weights): torch.zeros(1)}, folder / WEIGHTS)
