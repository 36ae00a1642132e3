"""Errors in a config are one line, wherever the config was written."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from draccus.utils import DecodingError
from lerobot.configs.default import EvalConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs import make_env_config

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands.main import main
from lerobot_bomb.compat.hooks.errors import tell_refusals
from lerobot_bomb.compat.use import use
from lerobot_bomb.flag_errors import FlagError, nearest_flags
from lerobot_bomb.vlm.backbone import build_backbone
from lerobot_bomb.vlm.paligemma import build_paligemma
from lerobot_bomb.vlm.presets import nano_config, nano_paligemma_config, nano_qwen_config
from lerobot_bomb.vlm.qwen import build_qwen
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer

CONFIGS = {
    "lerobot-eval": {"env": {"type": "bomb", "image_size": -3}},
    "lerobot-train": {
        "dataset": {"repo_id": "test/x"},
        "policy": {"type": "vla0_smol", "chunk_size": 0, "device": "cpu"},
    },
}
MESSAGES = {
    "lerobot-eval": "--env.image_size=-3 must lie in 32..1024 pixels",
    "lerobot-train": "--policy.chunk_size=0 must be at least 1",
}


@pytest.mark.parametrize("command", CONFIGS)
def test_a_wrong_flag_in_a_config_file_is_one_line(
    command: str, stock_cli: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "config.json"
    path.write_text(json.dumps(CONFIGS[command]))
    with pytest.raises(SystemExit, match="1"):
        stock_cli(command, f"--config_path={path}")
    assert capsys.readouterr().err.strip().splitlines()[-1] == f"error: {MESSAGES[command]}"
    if command == "lerobot-eval":
        with pytest.raises(SystemExit, match="1"):
            cli.main(["results", "actions", str(tmp_path / "actions.jsonl"), f"--config_path={path}"])
        assert capsys.readouterr().err.strip().splitlines()[-1] == f"error: {MESSAGES[command]}"


def test_an_evaluation_has_episodes() -> None:
    with pytest.raises(FlagError, match=r"--eval\.n_episodes=0 must be at least 1"):
        EvalPipelineConfig(env=make_env_config("bomb"), eval=EvalConfig(n_episodes=0, batch_size=1))


@pytest.mark.parametrize("env_type", ["bomb", "bomb_pusht", "bomb_libero"])
def test_several_episodes_of_an_environment_are_not_recorded_under_one_instruction(
    env_type: str, stock_cli: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = (
        r"^--eval\.recording=true with --eval\.n_episodes=3: .* Give --eval\.n_episodes=1, and --seed=NUMBER"
    )
    for batch_size in (1, 3):
        of_eval = EvalConfig(recording=True, n_episodes=3, batch_size=batch_size)
        with pytest.raises(FlagError, match=told):
            EvalPipelineConfig(env=make_env_config(env_type), eval=of_eval)
        EvalPipelineConfig(env=make_env_config("pusht"), eval=of_eval)
    one = EvalConfig(recording=True, n_episodes=1)
    assert EvalPipelineConfig(env=make_env_config(env_type), eval=one).eval.recording
    flags = [f"--env.type={env_type}", "--policy.type=act", "--eval.recording=true", "--eval.n_episodes=3"]
    with pytest.raises(SystemExit, match="1"):
        stock_cli("lerobot-eval", *flags, f"--output_dir={tmp_path / 'eval'}")
    assert re.search(told.replace("^", "^error: "), capsys.readouterr().err.strip().splitlines()[-1])
    assert not (tmp_path / "eval").exists()


def test_what_lerobots_parser_does_not_catch_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """lerobot-train reads a checkpoint's config after its parser."""
    monkeypatch.setattr(sys, "argv", ["src/lerobot/scripts/lerobot_train.py"])
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    tell_refusals()
    error = DecodingError((), "--policy.chunk_size=0 must be at least 1")
    sys.excepthook(DecodingError, error, None)
    assert capsys.readouterr().err == f"error: {error}\n"
    sys.excepthook(KeyError, KeyError("other errors keep their traceback"), None)
    assert "KeyError" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("part", "name", "value", "message"),
    [
        ("text_config", "hidden_size", 10**9, "GiB, and this machine has"),
        ("text_config", "num_hidden_layers", 10**9, "GiB, and this machine has"),
        ("text_config", "vocab_size", 10**13, "GiB, and this machine has"),
        ("text_config", "hidden_size", "wide", "no model"),
    ],
)
@pytest.mark.parametrize(
    ("config", "build"),
    [
        (nano_config, build_backbone),
        (nano_paligemma_config, build_paligemma),
        (nano_qwen_config, lambda vlm_config: build_qwen(vlm_config, 56)),
    ],
    ids=["smolvlm", "paligemma", "qwen"],
)
def test_a_model_that_no_machine_holds_is_refused_before_it_is_built(
    part: str, name: str, value: Any, message: str, config: Callable, build: Callable
) -> None:
    vlm_config = json.loads(json.dumps(config(load_tokenizer(NANO))))
    vlm_config[part][name] = value
    with pytest.raises(ValueError, match=f"--policy.vlm_config describes .*{message}"):
        build(vlm_config)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--env.type=bomb", "--env.tsak=place"),
            "unrecognized arguments: --env.tsak=place; nearest: --env.task",
        ),
        # near one of `bomb`, which this type would refuse
        (("--env.type=bomb_pusht", "--env.render_presets=fast"), "--env.render_presets=fast; --policy.type="),
        (
            ("--env.type=bomb_pusht", "--env.render_preset=fast"),
            "--env.render_preset is no flag of this type",
        ),
        (("--env.type=bomb_libero", "--env.image_size=64"), "--env.image_size is no flag of this type"),
        (("--sed=3", "--env.type=bomb"), "unrecognized arguments: --sed=3; nearest: --seed; "),
        (("--env.type=bmob",), "argument --env.type: invalid choice: 'bmob'"),
    ],
)
def test_an_unknown_flag_is_one_line_with_the_nearest_and_where_all_are(
    flags: tuple[str, ...], message: str, stock_cli: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        stock_cli("lerobot-eval", "--policy.type=bomb_random", *flags)
    errors = [line for line in capsys.readouterr().err.splitlines() if "error: " in line or "usage" in line]
    assert len(errors) == 1 and message in errors[0]
    (env_type,) = [flag for flag in flags if flag.startswith("--env.type")]
    types = ["--policy.type=bomb_random", *([] if env_type.endswith("bmob") else [env_type])]
    assert errors[0].endswith(f"; {' '.join(types)} --help lists all flags")


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--env.tsak=PushT-v0", "unrecognized arguments: --env.tsak=PushT-v0\n"),
        ("--env.results_path=x", "The fields `results_path` are not valid for PushtEnv\n"),
    ],
)
def test_a_wrong_flag_of_other_types_is_told_as_lerobot_tells_it(
    flag: str, message: str, stock_cli: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    use()
    with pytest.raises(SystemExit):
        stock_cli("lerobot-eval", "--policy.type=act", "--env.type=pusht", flag)
    errors = capsys.readouterr().err
    assert errors.endswith(message)
    assert ("usage: " in errors) is ("unrecognized" in message)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("view --sed=9", "unrecognized arguments: --sed=9; nearest: --seed"),
        # not that one of --episodes and --static is required
        ("record --repo_id=a/b --epsiodes=2", "unrecognized arguments: --epsiodes=2; nearest: --episodes"),
        ("sweep out --polices=act", "unrecognized arguments: --polices=act; nearest: --policies"),
        ("record --repo_id=a/b", "one of the arguments --episodes --static is required"),
    ],
)
def test_our_commands_name_the_nearest_flag_too(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(words.split())
    command = f"lerobot-bomb {words.split()[0]}"
    assert capsys.readouterr().err == f"{command}: {message} (`{command} --help` lists all flags)\n"


def test_a_flag_of_a_group_is_compared_with_those_of_the_group() -> None:
    flags = ["--env.task", "--env.fps", "--policy.task", "--seed"]
    assert nearest_flags("--env.tsk=place", flags) == ["--env.task"]
    assert nearest_flags("--evn.task", flags) == ["--env.task"]
    assert nearest_flags("--sede=3", flags) == ["--seed"]
    assert nearest_flags("--env.zzzzzzz", flags) == []


@pytest.mark.parametrize(
    ("module", "code", "told"),
    [
        ("lerobot_bomb.made", "raise ValueError('give --flag')", "lerobot-eval: error: give --flag\n"),
        ("lerobot_bomb.made", "raise KeyboardInterrupt", "lerobot-eval: interrupted\n"),
        ("lerobot_bomb.made", "raise AssertionError('a mistake of ours')", ""),
        ("lerobot_bomb.made", "int('not raised on purpose')", ""),
        ("lerobot_bomber", "raise ValueError('of others')", ""),
    ],
)
def test_a_refusal_is_told_without_a_traceback_and_a_mistake_with_one(
    module: str,
    code: str,
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    passed_on: list[type[BaseException]] = []
    monkeypatch.setattr(sys, "argv", ["bin/lerobot-eval"])
    monkeypatch.setattr(sys, "excepthook", lambda kind, error, traceback: passed_on.append(kind))
    tell_refusals()
    with pytest.raises(BaseException) as raised:  # any
        exec(code, {"__name__": module})
    sys.excepthook(raised.type, raised.value, raised.tb)
    assert capsys.readouterr().err == told
    assert passed_on == ([] if told else [raised.type])


@pytest.mark.parametrize(("command", "variable"), [("pytest", ""), ("lerobot-eval", "1")])
def test_elsewhere_and_where_asked_tracebacks_are_as_usual(
    command: str, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = sys.excepthook
    monkeypatch.setattr(sys, "argv", [command])
    monkeypatch.setenv("LEROBOT_BOMB_TRACEBACK", variable)
    tell_refusals()
    assert sys.excepthook is usual
