"""A checkpoint's folder, as `lerobot-train` leaves it, and what can be wrong with one."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from fdvla_cases import make_policy as make_fdvla
from safetensors.torch import load_file, save_file
from vla0_smol_cases import STATS, make_policy

from lerobot_policy_bomb.vla0_smol import make_vla0_smol_pre_post_processors

type Damage = Callable[[Path], None]
type Tensors = dict[str, torch.Tensor]

LOCAL = "/data/models/SmolVLM2-500M-Video-Instruct"
WEIGHTS = "model.safetensors"
TOKENIZER = "policy_preprocessor_step_2_bomb_task_tokenizer.safetensors"
NORMALIZER = "policy_preprocessor_step_4_normalizer_processor.safetensors"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"


def write_checkpoint(folder: Path) -> None:
    """Write a `vla0_smol` whose backbone came from a folder, with what belongs to its training beside it."""
    policy = make_policy(nano_config=None)  # another model has its own layers
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


def insert_step(name: str, step: dict[str, Any]) -> Damage:
    def damage(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        content["steps"].insert(0, step)
        (folder / name).write_text(json.dumps(content))

    return damage


def insert_code(name: str) -> Damage:
    """A step that makes the folder `ran` beside the checkpoint, without another process to wait for."""

    def damage(folder: Path) -> None:
        insert_step(name, {"class": "os.mkdir", "config": {"path": str(folder.parent / "ran")}})(folder)

    return damage


def change_step(name: str, registry_name: str, **values: Any) -> Damage:
    """Return a damage that changes values of a processor's step; None removes a value."""

    def damage(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        [step] = [each for each in content["steps"] if each["registry_name"] == registry_name]
        step |= values
        for key in [key for key, value in step.items() if value is None]:
            del step[key]
        (folder / name).write_text(json.dumps(content))

    return damage


def change_state(name: str, **values: torch.Tensor | None) -> Damage:
    """Return a damage that changes tensors of a state; None removes one, `__` stands for a dot."""

    def damage(folder: Path) -> None:
        state: dict[str, Any] = load_file(folder / name) | {
            key.replace("__", "."): value for key, value in values.items()
        }
        save_file({key: value for key, value in state.items() if value is not None}, folder / name)

    return damage


def take_other_weights(folder: Path) -> None:
    make_fdvla().save_pretrained(folder / "other")
    (folder / "other" / WEIGHTS).rename(folder / WEIGHTS)


def take_other_shape(folder: Path) -> None:
    weights = load_file(folder / WEIGHTS)
    save_file({**weights, min(weights): torch.zeros(1)}, folder / WEIGHTS)


def change_tensors(name: str, change: Callable[[Tensors], Tensors]) -> Damage:
    def damage(folder: Path) -> None:
        save_file(change(load_file(folder / name)), folder / name)

    return damage


def one_nan(tensors: Tensors) -> Tensors:
    """Put a NaN into the first tensor of floats that is not a scalar."""
    name = min(name for name, tensor in tensors.items() if tensor.is_floating_point() and tensor.ndim)
    tensors[name].view(-1)[1] = torch.nan
    return tensors


def half_of_each(tensors: Tensors) -> Tensors:
    return {name: tensor[: len(tensor) // 2].clone() for name, tensor in tensors.items()}


def renamed(tensors: Tensors) -> Tensors:
    return {f"other_{name}": tensor for name, tensor in tensors.items()}


def without_state(tensors: Tensors) -> Tensors:
    return {name: tensor for name, tensor in tensors.items() if not name.startswith("observation.state")}


def every_other(tensors: Tensors) -> Tensors:
    return {name: tensors[name] for name in sorted(tensors)[::2]}


def name_other_step(folder: Path) -> None:
    path = folder / PREPROCESSOR
    values = json.loads(path.read_text())
    values["steps"][0]["registry_name"] = "bomb_unknown"
    path.write_text(json.dumps(values))
