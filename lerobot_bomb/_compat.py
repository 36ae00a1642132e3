"""The only place that reaches into names of LeRobot, `datasets` and huggingface_hub that are not public."""

import gc
import logging
import os
import pickle
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial, wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn, get_origin
from weakref import ref

import numpy as np
from datasets import config
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import (
    LeRobotDataset,
    LeRobotDatasetMetadata,
    aggregate,
    compute_stats,
    dataset_writer,
)
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import to_parquet_with_hf_images
from lerobot.datasets.utils import INFO_PATH
from lerobot.policies import PreTrainedPolicy
from lerobot.utils import import_utils
from lerobot.utils.constants import DEFAULT_FEATURES

_BUILT: list[ref[PreTrainedPolicy]] = []  # by `remember_policies`

_EVALUATIONS: dict[type, Callable[[Any], None]] = {}  # by `check_evaluations`

STATISTICS_SIZE = 128  # pixels
# what LeRobot's warning ends in, below a hundred lines of torchcodec's own
NO_TORCHCODEC = "'torchcodec' is installed but cannot be loaded"
NO_TORCHCODEC_IN_SHORT = (
    "torchcodec cannot be loaded, usually because FFmpeg's libraries are missing; videos are read with PyAV "
    "(the cause: python -c 'import torchcodec')"
)


def sample_pixels(image: np.ndarray) -> np.ndarray:
    """(C, H, W) -> every n-th pixel of every n-th row, so that about STATISTICS_SIZE of each are left."""
    stride = max(1, max(image.shape[1:]) // STATISTICS_SIZE)
    return image[:, ::stride, ::stride]


@contextmanager
def sampled_image_statistics() -> Iterator[None]:
    """Let LeRobot's video encoder take image statistics from a sample of the pixels.

    It samples so itself from 300 pixels on; all pixels of a 256x256 frame cost 5 ms of one core.
    """
    usual = compute_stats.auto_downsample_height_width
    compute_stats.auto_downsample_height_width = sample_pixels
    try:
        yield
    finally:
        compute_stats.auto_downsample_height_width = usual


@contextmanager
def without_statistics(keys: Collection[str]) -> Iterator[None]:
    """Let LeRobot write no statistics of these features, and so normalise none of them.

    It would take them of every pixel apart: gigabytes of histograms for one depth image.
    """
    usual = dataset_writer.compute_episode_stats

    def compute(data: dict[str, Any], features: dict[str, dict]) -> dict[str, dict]:
        return usual({key: values for key, values in data.items() if key not in keys}, features)

    dataset_writer.compute_episode_stats = compute
    try:
        yield
    finally:
        dataset_writer.compute_episode_stats = usual


@contextmanager
def mergeable_arrays(features: dict[str, dict]) -> Iterator[None]:
    """Let LeRobot merge tables that hold arrays of two dimensions.

    It can where they hold images too, because it then names their types; elsewhere pyarrow must guess them.
    """
    usual = aggregate.to_parquet_one_row_group_per_episode
    types = get_hf_features_from_features(features | DEFAULT_FEATURES)
    aggregate.to_parquet_one_row_group_per_episode = partial(to_parquet_with_hf_images, features=types)
    try:
        yield
    finally:
        aggregate.to_parquet_one_row_group_per_episode = usual


def abandon(dataset: LeRobotDataset) -> None:
    """End the threads of a dataset that is being written, and let none of it be written later.

    When it is garbage collected, LeRobot would write its table of episodes, and make the folder for it anew.
    """
    dataset.clear_episode_buffer()
    dataset.meta._finalized = True


@contextmanager
def datasets_cache(folder: Path) -> Iterator[None]:
    """Let `datasets` cache what it reads here only; in the user's cache a copy of it would stay."""
    usual = config.HF_DATASETS_CACHE
    config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        config.HF_DATASETS_CACHE = usual
        shutil.rmtree(folder, ignore_errors=True)


def lerobot_eval_with(flags: Sequence[str], wrap: Callable[[Any, Any], Any]) -> None:
    """Run lerobot-eval with these flags, on what `wrap(config, environments)` makes of its environments."""
    from lerobot.scripts import lerobot_eval

    make_env = lerobot_eval.make_env
    _run_lerobot_eval(flags, make_env=lambda config, **options: wrap(config, make_env(config, **options)))


class KeptPolicy:
    """Runs lerobot-eval several times in one process; a policy stays as long as the same one is asked for.

    What is random goes on from where it was when the policy had been built, so that an evaluation gives what
    it gives in a process of its own.
    """

    def __init__(self) -> None:
        self._asked: object = None
        self.policy: PreTrainedPolicy | None = None
        self._random_state: dict[str, Any] = {}
        self.env_config: Any = None  # LeRobot's, of the last evaluation
        self.has_begun = False  # whether the last evaluation came as far as to play

    def evaluate(self, flags: Sequence[str], asked: object, first: int = 0) -> None:
        """Run lerobot-eval, which draws no video and plays one task after another.

        `asked` is equal where it needs the policy of before, built with the same seed. `first` is the number
        of an episode that is played alone out of a longer evaluation.
        """
        from lerobot.scripts import lerobot_eval
        from lerobot.utils.random_utils import get_rng_state, set_rng_state

        make_env = lerobot_eval.make_env
        make_policy, evaluate_all = lerobot_eval.make_policy, lerobot_eval.eval_policy_all

        def begun(config: Any, **options: Any) -> Any:
            self.env_config = config
            envs = make_env(config, **options)
            if not hasattr(config, "results_path"):  # ours check actions themselves
                for env in (env for of_group in envs.values() for env in of_group.values()):
                    _refuse_not_finite(env)
                    _start_with(env, first)
            return envs

        def kept(**options: Any) -> PreTrainedPolicy:
            if self.policy is None or self._asked != asked:
                self.policy = None  # the process then holds one at a time
                gc.collect()
                self.policy, self._asked = make_policy(**options), asked
                self._random_state = get_rng_state()
            set_rng_state(self._random_state)
            return self.policy

        def without_videos(*args: Any, **options: Any) -> dict[str, Any]:
            self.has_begun = True
            options |= {"max_episodes_rendered": 0, "videos_dir": None, "max_parallel_tasks": 1}
            return evaluate_all(*args, **options)

        self.has_begun = False
        replaced = {"make_env": begun, "make_policy": kept, "eval_policy_all": without_videos}
        _run_lerobot_eval(flags, init_logging=lambda: None, **replaced)


def _refuse_not_finite(env: Any) -> None:
    """Let a vector env raise an ArithmeticError for such an action; LeRobot's own may end the process."""
    step = env.step

    def checked(actions: np.ndarray) -> Any:
        if not np.isfinite(actions).all():
            raise ArithmeticError("an action of the policy is not finite")
        return step(actions)

    env.step = checked


def _start_with(env: Any, number: int) -> None:
    """Let LeRobot's LIBERO start in the initial state of this number; it takes the first, then the next."""
    if any(hasattr(each.unwrapped, "init_state_id") for each in getattr(env, "envs", ())):
        env.set_attr("init_state_id", [number + row for row in range(env.num_envs)])


def eval_config(flags: Sequence[str]) -> Any:
    """LeRobot's EvalPipelineConfig, as lerobot-eval reads it from these flags.

    Raises:
        SystemExit: the flags are wrong; its parser has said why.
    """
    from lerobot.configs import parser
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    def read(config: EvalPipelineConfig) -> EvalPipelineConfig:
        return config

    register_third_party_plugins()
    with _argv("lerobot-eval", flags):
        read_flags: Any = parser.wrap()(read)
        return read_flags()


def check_evaluations(env_config: type, check: Callable[[Any], None]) -> None:
    """Let `check` see each EvalPipelineConfig, as it is made, whose environment's config is of this class.

    An environment is told nothing of LeRobot's --eval flags but the number of copies. Doing it again changes
    nothing.
    """
    from lerobot.configs.eval import EvalPipelineConfig  # imports environments and policies

    if not _EVALUATIONS:
        usual = EvalPipelineConfig.__post_init__

        @wraps(usual)
        def checked(self: EvalPipelineConfig) -> None:
            usual(self)
            for kind, check_one in _EVALUATIONS.items():
                if isinstance(self.env, kind):
                    check_one(self)

        EvalPipelineConfig.__post_init__ = checked
    _EVALUATIONS[env_config] = check


def _run_lerobot_eval(flags: Sequence[str], **replaced: Any) -> None:
    """In this process, with other functions of these names."""
    from lerobot.scripts import lerobot_eval

    usual = {name: getattr(lerobot_eval, name) for name in replaced}
    try:
        for name, function in replaced.items():
            setattr(lerobot_eval, name, function)
        with _argv("lerobot-eval", flags):
            lerobot_eval.main()
    finally:
        for name, function in usual.items():
            setattr(lerobot_eval, name, function)


@contextmanager
def _argv(command: str, flags: Sequence[str]) -> Iterator[None]:
    """LeRobot's parser reads it in several places."""
    usual, sys.argv = sys.argv, [command, *flags]
    try:
        yield
    finally:
        sys.argv = usual


def serve_registered_policies(
    config: Any, address: str, loads: Callable[[bytes], Any], interceptor: Any, workers: int
) -> Any:
    """Start LeRobot's policy server, a PolicyServerConfig's, for every registered policy type.

    Its own knows a list of LeRobot's types, imports no plugins, unpickles whatever it receives, and four
    requests that never end stop it. Returns gRPC's server.

    Raises:
        ValueError: the address cannot be had.
    """
    import grpc
    from lerobot.async_inference import policy_server
    from lerobot.configs import PreTrainedConfig
    from lerobot.transport import services_pb2_grpc
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    policy_server.SUPPORTED_POLICIES[:] = sorted(PreTrainedConfig.get_known_choices())
    policy_server.pickle = SimpleNamespace(loads=loads, dumps=pickle.dumps)  # pyright: ignore
    server = grpc.server(
        ThreadPoolExecutor(workers), interceptors=[interceptor], options=[("grpc.so_reuseport", 0)]
    )
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(policy_server.PolicyServer(config), server)
    usual = os.umask(0o177)  # a Unix socket lets in its owner only
    try:
        server.add_insecure_port(address)
    except RuntimeError:
        raise ValueError(f"{address} cannot be listened on") from None
    finally:
        os.umask(usual)
    server.start()
    return server


def check_tokens_before_use(check: Callable[[str], None]) -> None:
    """Let huggingface_hub send no token before `check(token)`; doing it again changes nothing."""
    from huggingface_hub.utils import _headers

    usual: Any = getattr(_headers.get_token_to_send, "__wrapped__", _headers.get_token_to_send)

    @wraps(usual)
    def get_token_to_send(token: bool | str | None) -> str | None:
        found = usual(token)
        if found is not None:
            check(found)
        return found

    _headers.get_token_to_send = get_token_to_send


def shorten_torchcodec_warning() -> None:
    """Let LeRobot say in one line that it reads videos with PyAV; doing it again changes nothing."""
    logging.getLogger(import_utils.__name__).addFilter(_shorten_torchcodec_warning)


def _shorten_torchcodec_warning(record: logging.LogRecord) -> bool:
    if NO_TORCHCODEC in record.getMessage():
        record.msg, record.args = NO_TORCHCODEC_IN_SHORT, None
    return True


def tell_wrong_flags(
    hint: Callable[[Sequence[str], Collection[str], Sequence[str]], str],
    refuse_unknown: Callable[[str, Collection[str], Sequence[str]], NoReturn],
) -> None:
    """Let LeRobot's commands say in one line which flag is wrong; doing it again changes nothing.

    Their parser prints hundreds of lines of usage first. `hint(words, flags, argv)` follows on what it says;
    `refuse_unknown(flag, flags, argv)` raises for a flag that only other types than the chosen one have.
    """
    from draccus.parsers import decoding
    from draccus.wrappers.suppressing_argparse import SuppressingArgumentParser

    def error(self: Any, message: str) -> NoReturn:
        words = message.partition("unrecognized arguments: ")[2].split()
        flags = _flags_of_chosen_types(self._option_string_actions, sys.argv)
        known = [word for word in sys.argv if repr(word.partition("=")[2]) not in message]
        print(f"{self.prog}: error: {message}{hint(words, flags, known)}", file=sys.stderr)
        raise SystemExit(2)

    usual: Any = getattr(decoding.decode_dataclass, "__wrapped__", decoding.decode_dataclass)

    @wraps(usual)
    def decode(cls: Any, values: Any, path: Sequence[str] = ()) -> Any:
        names = [each.name for each in fields(get_origin(cls) or cls)]
        unknown = [name for name in values if name not in names] if isinstance(values, dict) else []
        if path and unknown:  # without a path they are of a checkpoint's file
            flag, *flags = [f"--{'.'.join((*path, name))}" for name in (unknown[0], *names)]
            refuse_unknown(flag, flags, sys.argv)
        return usual(cls, values, path)

    SuppressingArgumentParser.error = error
    decoding.decode_dataclass = decode


def _flags_of_chosen_types(flags: Collection[str], argv: Sequence[str]) -> list[str]:
    """LeRobot's parser knows those of all types of environments and policies."""
    from lerobot.configs import PreTrainedConfig, parser
    from lerobot.envs import EnvConfig

    left = list(flags)
    registries: dict[str, Any] = {"env": EnvConfig, "policy": PreTrainedConfig}
    for group, registry in registries.items():
        chosen = registry.get_known_choices().get(parser.get_type_arg(group, argv))
        if chosen is not None:
            names = {each.name for each in fields(chosen)}
            left = [
                flag for flag in left if not flag.startswith(f"--{group}.") or flag.split(".")[1] in names
            ]
    return left


def resolve_checkpoints(resolve: Callable[[str], str]) -> None:
    """Let `--policy.path` of LeRobot's commands, and of their config files, be what `resolve` makes of it.

    A ValueError of it ends the command in one line.
    """
    from lerobot.configs import parser

    usual = parser.get_path_arg

    @wraps(usual)
    def get_path_arg(field_name: str, args: Sequence[str] | None = None) -> str | None:
        path = usual(field_name, args)
        try:
            return path if path is None else resolve(path)
        except ValueError as error:
            sys.exit(f"--{field_name}.path={path}: {error}")

    parser.get_path_arg = get_path_arg


def remember_policies() -> None:
    """Let `built_policies` know every policy that this process builds, LeRobot's own types too.

    LeRobot tells an environment nothing of the policy that will act in it. `lerobot-eval` and `lerobot-train`
    build it before the first reset of an environment.
    """
    usual = PreTrainedPolicy.__init__

    @wraps(usual)
    def remembered(self: PreTrainedPolicy, *args: Any, **kwargs: Any) -> None:
        usual(self, *args, **kwargs)
        _BUILT.append(ref(self))

    PreTrainedPolicy.__init__ = remembered


def read_asked_columns() -> None:
    """Let LeRobot read of the other frames of a sample only what was asked of them, not their images too.

    A chunk of 16 actions decodes the images of all its 16 frames otherwise, and throws them away.
    """
    usual = DatasetReader._query_hf_dataset

    @wraps(usual)
    def query(self: Any, query_indices: dict[str, list[int]]) -> dict[str, Any]:
        whole = self.hf_dataset
        columns = vars(self).setdefault("_columns", {})
        result: dict[str, Any] = {}
        try:
            for key, indices in query_indices.items():
                if key in whole.column_names and columns.get(key, (None,))[0] is not whole:
                    columns[key] = whole, whole.select_columns(key)
                self.hf_dataset = columns[key][1] if key in columns else whole
                result |= usual(self, {key: indices})
        finally:
            self.hf_dataset = whole
        return result

    DatasetReader._query_hf_dataset = query


def explain_missing_datasets(explain: Callable[[str, Path, Exception], str]) -> None:
    """Let a dataset that is neither here nor on the Hub be an error with `explain(repo_id, root, error)`.

    LeRobot asks the Hub for whatever it does not find, and ends in a hundred lines of the HTTP library.
    """
    usual = getattr(LeRobotDatasetMetadata.__init__, "__wrapped__", LeRobotDatasetMetadata.__init__)

    @wraps(usual)
    def load(self: LeRobotDatasetMetadata, repo_id: str, *args: Any, **kwargs: Any) -> None:
        try:
            usual(self, repo_id, *args, **kwargs)
        except ValueError:  # of what was given
            raise
        except Exception as error:
            root = getattr(self, "root", None)
            if root is None or (root / INFO_PATH).is_file():
                raise
            raise FileNotFoundError(explain(repo_id, root, error)) from None

    LeRobotDatasetMetadata.__init__ = load


def play_tasks_in_turn(is_needed: Callable[[Any], bool]) -> None:
    """Let LeRobot's evaluation of such a policy use no threads, whatever --env.max_parallel_tasks says.

    They would share its queue of actions. Commands that are imported later than this keep the original; doing
    it again changes nothing.
    """
    for name in ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train", "__main__"):
        module: Any = sys.modules.get(name)
        usual = getattr(module, "eval_policy_all", None)
        if usual is not None and not hasattr(usual, "plays_in_turn"):
            module.eval_policy_all = _in_turn(usual, is_needed)


def _in_turn(evaluate_all: Callable[..., Any], is_needed: Callable[[Any], bool]) -> Callable[..., Any]:
    @wraps(evaluate_all)
    def evaluate(envs: Any, policy: Any, *args: Any, max_parallel_tasks: int = 1, **options: Any) -> Any:
        if max_parallel_tasks > 1 and is_needed(policy):
            logging.warning(
                "--env.max_parallel_tasks=%s: tasks are played one after another; threads would share this "
                "policy's queue of actions. To play in several processes: lerobot-bomb sweep",
                max_parallel_tasks,
            )
            max_parallel_tasks = 1
        return evaluate_all(envs, policy, *args, max_parallel_tasks=max_parallel_tasks, **options)

    evaluate.plays_in_turn = True  # pyright: ignore[reportAttributeAccessIssue]
    return evaluate


def built_policies() -> list[PreTrainedPolicy]:
    """The policies that this process built and still holds, in that order.

    `config.pretrained_path` and `config.pretrained_revision` say where one was loaded from.
    """
    return [policy for built in _BUILT if (policy := built()) is not None]


def training_data(config: PreTrainedConfig) -> LeRobotDatasetMetadata | None:
    """The dataset that this process trains a config's policy on; None: it acts as it was loaded."""
    return getattr(config, "_runtime_dataset_meta", None)


def check_processors_before_use(
    check: Callable[[dict[str, Any], str, Path], Any],
    check_loaded: Callable[[Sequence[Any], str, Path], None],
) -> None:
    """Let LeRobot's loader build no step of a saved processor before `check(its JSON, where, config.json)`.

    Here what is checked is what will be built. Then `check_loaded(steps, where, config.json)`. From the Hub,
    states and config.json, which there may not be, are of the commit that the JSON is of.
    """
    from lerobot.processor import DataProcessorPipeline

    usual: Any = DataProcessorPipeline._build_steps_with_overrides

    def build(
        cls: type,
        loaded_config: dict[str, Any],
        overrides: dict[str, Any],
        model_id: str,
        base_path: Path,
        hub_download_kwargs: dict[str, Any],
        is_local_source: bool = False,
    ) -> Any:
        commits = [part for part in base_path.parts if re.fullmatch("[0-9a-f]{40}", part)]
        if commits and not is_local_source:
            hub_download_kwargs = hub_download_kwargs | {"revision": commits[-1]}
        config_file = base_path / CONFIG_NAME
        if not is_local_source and not config_file.is_file():
            with suppress(OSError):
                config_file = Path(hf_hub_download(model_id, CONFIG_NAME, **hub_download_kwargs))
        where = f"{model_id}, {loaded_config.get('name')}"
        check(loaded_config, where, config_file)
        steps, unused = usual.__func__(
            cls, loaded_config, overrides, model_id, base_path, hub_download_kwargs, is_local_source
        )
        check_loaded(steps, where, config_file)
        return steps, unused

    DataProcessorPipeline._build_steps_with_overrides = classmethod(build)  # pyright: ignore[reportAttributeAccessIssue]
