"""Publishing of an environment on the Hub, as the file `env.py` from which LeRobot's `make_env` builds it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pprint import pformat
from typing import Any

import yaml
from huggingface_hub import CommitInfo, HfApi, ModelCardData

from lerobot_bomb.environments import env_type
from lerobot_bomb.hub.markdown import command, fenced
from lerobot_bomb.hub.push import CARD
from lerobot_bomb.hub.upload import check_token, hub_errors, upload

ENV_FILE = "env.py"
PREFIX = "--env."
LOCAL = ("results_path",)  # flags whose values are paths of one machine
FILES = {ENV_FILE, CARD, ".gitattributes"}
# LeRobot runs this file on the machines of others, so it only names flags; the package does the rest
TEMPLATE = '''\
"""An environment of lerobot_bomb: lerobot.envs.factory.make_env("{repo_id}", trust_remote_code=True)."""

from importlib.util import find_spec
from typing import Any

FLAGS = {flags}


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> Any:
    """Return {{group: {{number of a task: vector environment of n_envs}}}}."""
    if find_spec("lerobot_policy_bomb") is None:
        raise ModuleNotFoundError("this environment needs lerobot_bomb: pip install lerobot_policy_bomb")
    import draccus
    import lerobot_policy_bomb  # noqa: F401  registers the type
    from lerobot.envs import EnvConfig

    return draccus.decode(EnvConfig, FLAGS).create_envs(n_envs, use_async_envs)
'''


@dataclass(frozen=True)
class PublishedEnvironment:
    """An environment with its flags, as it is published."""

    repo_id: str
    flags: dict[str, Any]  # "type" and what else --env.* gave, by name

    @property
    def code(self) -> str:
        """Content of `env.py`."""
        return TEMPLATE.format(repo_id=self.repo_id, flags=pformat(self.flags, sort_dicts=False))

    @property
    def card(self) -> str:
        """Content of the card: how to use the environment, and what it needs."""
        metadata = ModelCardData(license="apache-2.0", tags=["LeRobot", "lerobot_bomb", "envhub"])
        code = "\n".join(
            (
                "from lerobot.envs.factory import make_env",
                "",
                f'environments = make_env("{self.repo_id}", n_envs=4, trust_remote_code=True)',
                "for group, tasks in environments.items():",
                "    for task_id, environment in tasks.items():",
                "        observation, info = environment.reset(seed=1000)",
            )
        )
        values = {name: value for name, value in self.flags.items() if name != "type"}
        given = env_type(self.flags["type"]).record.env_flags(values)
        evaluation = command("lerobot-eval", "--policy.path=CHECKPOINT", *given)
        return (
            f"---\n{metadata.to_yaml()}\n---\n\n# {self.repo_id.split('/')[-1]}\n\n"
            f"The environment `{self.flags['type']}` of the package lerobot_bomb, which `env.py` builds "
            f"with these flags. It needs `pip install lerobot_policy_bomb`.\n\n{fenced(code, 'python')}\n\n"
            f"`trust_remote_code=True` runs `env.py`: read it first, and name the commit that you read "
            f"(`{self.repo_id}@COMMIT`). The same episodes without this repository, with records and "
            f"failure classes (`--env.results_path=FILE`):\n\n{fenced(evaluation)}\n"
        )


def read_environment(repo_id: str, flags: Sequence[str]) -> PublishedEnvironment:
    """Read and check the flags of an environment, as --env.type=bomb --env.task=goal.

    Raises:
        ValueError: a flag is unknown, is not of an environment, or has a value that is not allowed.
    """
    from lerobot_bomb.checkpoints.env_config import EvaluatedEnv, decode_env  # LeRobot: seconds

    pairs = [flag.partition("=")[::2] for flag in flags]
    if wrong := [name for name, _ in pairs if not name.startswith(PREFIX)]:
        raise ValueError(f"{wrong[0]} is no flag of an environment: they start with {PREFIX}")
    values = {name.removeprefix(PREFIX): yaml.safe_load(text) for name, text in pairs}
    for name in LOCAL:
        if name in values:
            raise ValueError(f"{PREFIX}{name} is a path of this machine; drop it")
    if "type" not in values:
        raise ValueError(f"{PREFIX}type is missing: it names the environment, as {PREFIX}type=bomb")
    env_type(values["type"]).check()
    if not isinstance(decode_env(values), EvaluatedEnv):
        raise ValueError(f"{PREFIX}type={values['type']} is no environment of lerobot_bomb")
    return PublishedEnvironment(repo_id, {"type": values.pop("type"), **values})


def publish_environment(environment: PublishedEnvironment, private: bool | None) -> CommitInfo:
    """Publish `env.py` and card in one commit.

    Raises:
        ValueError: the repository holds something else, such as a checkpoint.
        RuntimeError: the Hub cannot be reached or does not take them.
    """
    check_token()
    repo_id, api = environment.repo_id, HfApi()
    with hub_errors(repo_id):
        others = {*api.list_repo_files(repo_id)} - FILES if api.repo_exists(repo_id) else set()
    if others:
        raise ValueError(f"{repo_id} holds {min(others)}, so it is no environment's; give another --repo_id")
    contents = {ENV_FILE: environment.code.encode(), CARD: environment.card.encode()}
    message = f"{environment.flags['type']}: {ENV_FILE} and card"
    return upload(repo_id, "model", contents, lambda path: False, message, private)
