"""Callables of LeRobot and of its dependencies that the plugin replaces, and when."""

import gc
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fresh_processes import FreshProcess
from lerobot.common import train_utils
from lerobot.configs import parser
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.act.modeling_act import ACTPolicy

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.compat.hooks.paths import names_ours
from lerobot_bomb.compat.hooks.policies import _living_policies
from lerobot_bomb.compat.hooks.replace import replace

ALWAYS = {"lerobot.configs.parser.get_path_arg"}
MODULES = ("common.train_utils", "scripts.lerobot_train")
PUBLISHES = hasattr(train_utils, "publish_trained_model")  # LeRobot 0.6.2
ON_FIRST_USE = {
    "draccus.parsers.decoding.decode_dataclass",
    "draccus.wrappers.suppressing_argparse.SuppressingArgumentParser.error",
    "huggingface_hub.utils._headers.get_token_to_send",
    "lerobot.configs.eval.EvalPipelineConfig.__post_init__",
    "lerobot.configs.policies.PreTrainedConfig.from_pretrained",
    "lerobot.datasets.dataset_metadata.LeRobotDatasetMetadata.__init__",
    "lerobot.datasets.dataset_reader.DatasetReader._load_hf_dataset",
    "lerobot.policies.pretrained.PreTrainedPolicy.__init__",
    "lerobot.scripts.lerobot_train.get_step_identifier",
    "lerobot.processor.pipeline.DataProcessorPipeline._build_steps_with_overrides",
    "sys.excepthook",
    "the filters of lerobot.utils.import_utils' logger",
}
WITH_OUR_POLICY = "lerobot.scripts.lerobot_eval.eval_policy_all"
WITH_OUR_ENVS = {f"lerobot.scripts.lerobot_eval.{name}" for name in ("eval_policy", "rollout", "close_envs")}
PUBLISHING = {f"lerobot.{name}.publish_trained_model" for name in MODULES}

PROGRAM = '''
import inspect, json, logging, sys
sys.argv = ["lerobot-eval", "--env.type=pusht"]
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.envs.configs import PushtEnv
from lerobot.scripts import lerobot_eval, lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins

THEIRS = {"lerobot", "draccus", "argparse", "huggingface_hub", "datasets", "accelerate", "safetensors"}

def held():
    """{name: callable}, of their modules and of the classes in them."""
    found = {"sys.excepthook": sys.excepthook}
    logger = logging.getLogger("lerobot.utils.import_utils")
    found["the filters of lerobot.utils.import_utils' logger"] = tuple(logger.filters)
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] not in THEIRS:
            continue
        for key, value in list(vars(module).items()):
            if callable(value):
                found[f"{name}.{key}"] = value
            if inspect.isclass(value) and value.__module__ == name:
                members = {k: v for k, v in vars(value).items() if callable(v) or isinstance(v, classmethod)}
                found |= {f"{name}.{key}.{k}": v for k, v in members.items()}
    return found

before = held()

def changed():
    now = held()
    return sorted(
        key for key, value in now.items()
        if (key in before and before[key] is not value and before[key] != value)
        or (key not in before and key.rpartition(".")[0] in before)
    )

from lerobot.configs import parser
register_third_party_plugins()
assert "lerobot_policy_bomb" in sys.modules
registered = changed()
from lerobot.policies import make_policy
small = dict(device="cpu", pretrained_backbone_weights=None, dim_model=8, n_heads=1, dim_feedforward=8)
policy = make_policy(ACTConfig(**small), env_cfg=PushtEnv())
assert parser.get_path_arg("policy", ["--policy.path=me/x"]) == "me/x"
stock = changed()
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
config = BombEnvConfig()
used = changed()
config.create_envs(n_envs=1)
evaluating = sorted({*changed()} - {*used})
from lerobot_bomb.compat.hooks.policies import built_policies
known_before = built_policies() == [policy]
print("RESULT" + json.dumps([registered, stock, used, known_before, evaluating]))
'''


@pytest.fixture(scope="module")
def seen() -> list[Any]:
    ended = FreshProcess(PROGRAM).wait()
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.partition("RESULT")[2])


def test_who_does_not_use_the_plugin_has_lerobots_own_functions(seen: list[Any]) -> None:
    registered, stock, *_ = seen
    assert set(registered) == set(stock) == ALWAYS


def test_the_first_use_of_a_type_of_ours_installs_the_others(seen: list[Any]) -> None:
    assert set(seen[2]) == ALWAYS | ON_FIRST_USE | (PUBLISHING if PUBLISHES else set())


def test_environments_of_ours_are_told_of_their_evaluation(seen: list[Any]) -> None:
    assert set(seen[4]) == WITH_OUR_ENVS


def test_a_policy_that_was_built_before_the_first_use_is_known(seen: list[Any]) -> None:
    assert seen[3]


def test_a_policy_that_grows_old_while_policies_are_looked_for_is_known() -> None:
    thresholds = gc.get_threshold()
    gc.collect()
    policy = ACTPolicy.__new__(ACTPolicy)
    vars(policy)["config"] = None
    gc.set_threshold(1, 1, 1)  # collects again and again while the generations are read
    try:
        living = [each is policy for each in _living_policies()]
    finally:
        gc.set_threshold(*thresholds)
    assert any(living)


def test_the_documentation_lists_each() -> None:
    page = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text()
    section = page.partition("\n## Hooks into LeRobot\n")[2].partition("\n## ")[0]
    listed = set(re.findall(r"^\| `([\w.]+)`", section, re.MULTILINE))
    later = {WITH_OUR_POLICY} | WITH_OUR_ENVS
    short = {".".join(name.split(".")[-2:]) for name in ALWAYS | ON_FIRST_USE | PUBLISHING | later}
    assert listed == {name for name in short if "'" not in name} - {"lerobot_train.publish_trained_model"}


@pytest.mark.parametrize(
    ("flags", "is_named"),
    [
        (["--env.type=bomb"], True),
        (["--env.type", "bomb_pusht"], True),
        (["--policy.type=fdvla"], True),
        (["--config_path={}/ours.yaml"], True),
        (["--policy.path={}/checkpoint"], True),
        (["--env.type=pusht", "--policy.type=act", "--job_name=bomb"], False),
        (["--config_path={}/stock.json", "--policy.path={}"], False),
        (["--policy.path=me/bomb", "--config_path=\0"], False),
    ],
)
def test_flags_that_name_a_type_of_ours(flags: list[str], is_named: bool, tmp_path: Path) -> None:
    (tmp_path / "ours.yaml").write_text("env:\n  type: bomb\n")
    (tmp_path / "stock.json").write_text('{"env": {"type": "pusht"}, "job_name": "bomb"}')
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "config.json").write_text('{"type": "vla0_smol"}')
    assert names_ours([flag.replace("{}", str(tmp_path)) for flag in flags]) is is_named


def test_paths_of_others_stay_as_they_are() -> None:
    assert parser.get_path_arg("policy", ["--policy.path=./bomb:x"]) == "./bomb:x"
    assert parser.get_path_arg("policy", args=["--policy.path", "me/x"]) == "me/x"
    assert parser.get_path_arg("policy", ["--policy.type=act"]) is None
    with pytest.raises(SystemExit, match=r"--policy\.path=bomb:none: no checkpoint 'none'"):
        parser.get_path_arg("policy", ["--policy.path=bomb:none"])


def test_a_function_is_replaced_once_and_a_missing_one_is_an_error() -> None:
    def double(number: int) -> int:
        return 2 * number

    owner = SimpleNamespace(__name__="lerobot.made", double=double)
    for _ in range(2):
        replace(owner, "double", lambda usual: lambda number: usual(number) + 1)
    assert owner.double(3) == 7 and owner.double.__name__ == "double"
    with pytest.raises(RuntimeError, match=r"lerobot.made has no _double in the installed version"):
        replace(owner, "_double", lambda usual: usual)


@pytest.mark.skipif(not PUBLISHES, reason="LeRobot 0.6.1 asks the policy itself")
def test_policies_of_others_are_published_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot_bomb.compat.hooks.hub import publish_as_the_policy_says

    asked = []
    monkeypatch.setattr(train_utils, "publish_trained_model", lambda cfg, model, *rest: asked.append(model))
    publish_as_the_policy_says()
    train_utils.publish_trained_model(None, PreTrainedPolicy, None, None, None)  # pyright: ignore
    assert asked == [PreTrainedPolicy]
