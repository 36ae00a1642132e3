"""Train, push, forget all, evaluate by name, fine-tune from there: LeRobot's own commands on our types."""

from pathlib import Path

import pytest
import yaml

from hub.runner import FORGET, Ended, run
from hub.server import TOKEN, LoopbackHub

DATASET = "me/bomb_place"
FIRST, SECOND = "me/first", "me/second"
CARD_PARTS = ("lerobot-train --policy.type=", f"--policy.path={FIRST}", "pip install .", "@misc{")
# what the card says of Python, but for the observation that it supposes
CARD_CODE = """
from huggingface_hub import hf_hub_download
text = open(hf_hub_download("me/first", "README.md")).read()
code = text.split("```python\\n")[1].split("```")[0]
exec(code[: code.index("action = ")])
assert policy.config.repo_id == "me/first"
assert preprocess.steps and postprocess.steps
"""
TAG = "v1"
TAG_CODE = f"from huggingface_hub import HfApi; HfApi().create_tag('{FIRST}', tag='{TAG}')"
SMALL = {
    "vla0_smol": "--policy.chunk_size=2 --policy.n_action_steps=2",
    "spatialvla_grid": "--policy.chunk_size=2 --policy.n_action_steps=2",
    "fdvla": "--policy.dtype=float32 --policy.freeze_vision_encoder=false --policy.num_inference_steps=2",
}


def record(root: Path) -> list[str]:
    flags = ["--episodes=1", "--seed=7", "--image_size=64", "--images"]
    return ["lerobot-bomb", "record", f"--repo_id={DATASET}", f"--root={root}", *flags]


def train(folder: Path, name: str, *flags: str) -> list[str]:
    own = "--policy.device=cpu --batch_size=2 --num_workers=0 --steps=2 --policy.push_to_hub=true"
    data = [f"--dataset.repo_id={DATASET}", f"--output_dir={folder / name}"]
    return ["lerobot-train", *own.split(), *data, *flags]


def evaluate(repo_id: str, output_dir: Path, *flags: str) -> list[str]:
    own = "--env.type=bomb --env.task=place --env.image_size=64 --env.fps=2 --policy.device=cpu"
    own += " --env.ignore_checkpoint=true"  # of the recording at 10 Hz
    own += " --eval.n_episodes=1 --eval.batch_size=1 --eval.use_async_envs=false"
    return ["lerobot-eval", f"--policy.path={repo_id}", f"--output_dir={output_dir}", *own.split(), *flags]


def check_no_secret(hub: LoopbackHub, ended: Ended, folder: Path) -> None:
    """Check that nothing printed, published or written tells the token, and that no path is published."""
    assert TOKEN not in ended.text
    for repository in hub.repositories.values():
        for files in repository.commits.values():
            for private in (TOKEN, str(folder)):
                assert not any(private.encode() in content for content in files.values())
    assert hub.betrayals == []
    assert not any(TOKEN.encode() in path.read_bytes() for path in folder.rglob("*") if path.is_file())


def loop(hub: LoopbackHub, folder: Path, policy_type: str) -> str:
    """The card that was published; what comes after it starts from the Hub alone."""
    flags = [f"--policy.type={policy_type}", "--policy.vlm_model_name=nano", *SMALL[policy_type].split()]
    root = f"--dataset.root={folder / 'dataset'}"  # after that the dataset is the Hub's
    ended = run(
        [
            record(folder / "dataset"),
            ["lerobot-bomb", "push", f"{folder / 'dataset'}", f"--repo_id={DATASET}"],
            train(folder, "first", *flags, f"--policy.repo_id={FIRST}", root),
            ["python", TAG_CODE],
            FORGET,
            evaluate(FIRST, folder / "eval", f"--policy.pretrained_revision={TAG}"),
            ["python", CARD_CODE],
            train(folder, "second", f"--policy.path={FIRST}", f"--policy.repo_id={SECOND}"),
        ],
        hub.endpoint,
        folder / "home",
        TOKEN,
    )
    assert ended.code == 0, ended.text
    assert (folder / "eval" / "eval_info.json").is_file()
    # of all files LeRobot 0.6.1's evaluation takes these alone from a revision
    assert f"HEAD /{FIRST}/resolve/{TAG}/model.safetensors" in hub.requests
    for repo_id in (FIRST, SECOND):
        assert len(hub.model(repo_id).messages) == 1
        endings = {Path(path).suffix for path in hub.model(repo_id).files()}
        assert endings == {".json", ".safetensors", ".md"}
    assert not any("Instruct" in request or "paligemma" in request for request in hub.requests)
    check_no_secret(hub, ended, folder)
    return hub.model(FIRST).files()["README.md"].decode()


def check_card(card: str, policy_type: str) -> None:
    metadata = yaml.safe_load(card.split("---\n")[1])
    assert metadata["datasets"] == [DATASET]
    assert policy_type in metadata["tags"]
    assert "base_model" not in metadata  # nano is none
    for part in (*CARD_PARTS, "--env.control_mode=relative", "--env.image_size=64", "task version 1.0"):
        assert part in card


@pytest.mark.long
def test_train_push_forget_evaluate_and_fine_tune(policy_type: str, hub: LoopbackHub, tmp_path: Path) -> None:
    check_card(loop(hub, tmp_path, policy_type), policy_type)
