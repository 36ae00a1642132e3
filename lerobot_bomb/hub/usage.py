"""Commands and code that use a checkpoint."""

from collections.abc import Sequence

from lerobot_bomb.bomb.environment import SUITE
from lerobot_bomb.environments import env_type
from lerobot_bomb.hub.markdown import command, fenced


def how_to_use(repo_id: str, flags: Sequence[str] | None, is_adapters: bool) -> str:
    """Install, evaluate and see the rate, as Markdown; `flags` of the environment, None: it is unknown."""
    package = "'.[lora]'" if is_adapters else "."
    types = [flag.partition("=")[2] for flag in flags or () if flag.startswith("--env.type=")]
    is_ours = any(env_type(each).record.has_results_path for each in types)
    lines = [
        f"pip install {package}  # in a checkout of lerobot_bomb",
        command(
            "lerobot-eval",
            f"--policy.path={repo_id}",
            *(["--env.type=ENV"] if flags is None else flags),
            "--eval.n_episodes=200" if is_ours else "--eval.n_episodes=50",
            "--eval.batch_size=10",
            *(["--env.results_path=results.jsonl"] if is_ours else []),
        ),
        *(["lerobot-bomb results results.jsonl"] if is_ours else []),
    ]
    text = fenced("\n".join(lines))
    if flags is None:
        return f"{text}\n\n`ENV` is an environment with the dataset's cameras, state and action."
    is_open = any(flag.endswith(f"={SUITE}") for flag in flags)
    return text + f"\n\n`{SUITE}` is that of its training, which the dataset does not say." * is_open


def in_python(policy_type: str, repo_id: str, is_adapters: bool) -> str:
    """Load the policy and act once, as Markdown."""
    load = f'policy = get_policy_class("{policy_type}").from_pretrained("{repo_id}")\n'
    imported = ""
    if is_adapters:
        imported = "from peft import PeftConfig, PeftModel\n"
        load = (
            f'base = PeftConfig.from_pretrained("{repo_id}")\n'
            f'policy = get_policy_class("{policy_type}").from_pretrained(\n'
            "    base.base_model_name_or_path, revision=base.revision\n"
            ")\n"
            f'policy = PeftModel.from_pretrained(policy, "{repo_id}")\n'
        )
    return fenced(
        "from lerobot.policies.factory import get_policy_class, make_pre_post_processors\n"
        f"from lerobot.utils.import_utils import register_third_party_plugins\n{imported}\n"
        f"register_third_party_plugins()\n{load}"
        'device = {"device_processor": {"device": policy.config.device}}\n'
        "preprocess, postprocess = make_pre_post_processors(\n"
        f'    policy.config, "{repo_id}", preprocessor_overrides=device\n'
        ")\n"
        "action = postprocess(policy.select_action(preprocess(observation)))",
        "python",
    )
