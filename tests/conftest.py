"""Fixtures that several test modules use."""

import functools
import gc
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fresh_processes import serving
from kept_work import (
    check_numbers_once,
    keep_contexts,
    keep_distributions,
    keep_flags,
    look_at_columns_once,
)
from recipes import POLICY_TYPES
from variants import variants_of

if TYPE_CHECKING:
    from pusht_cases import Demonstrations

    from lerobot_bomb.bomb.episode import EpisodeSpec
    from lerobot_bomb.libero.assets import Libero

# by CPU time; begun first, none of them is what a run waits for in the end
SLOWEST_FILES = (
    "test_long",
    "test_parity",
    "test_explain_command",
    "test_bomb_libero_env",
    "test_record_kill",
    "test_vla0_smol_checkpoint",
    "test_commands",
    "test_parts",
    "test_record",
    "test_replay",
    "test_independence",
    "test_shipped",
    "test_sweep",
    "test_sweep_manifest",
    "test_axes_env",
    "test_processes",
    "test_fdvla",
    "test_lora",
    "test_spatialvla_grid",
    "test_vla0_smol_backbones",
    "test_vla0_smol_pointing",
)

# runs the tests that are marked one_type in `make test`, too
FAST_TYPE = "vla0_smol"

os.environ.setdefault("OMP_NUM_THREADS", "1")
# without a GPU, OpenGL draws small images in a quarter less time if it starts no threads; not a bit differs
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ["HF_HUB_OFFLINE"] = "1"  # no test may need the network


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real tokenizers and demonstrations; a clone alone does not have them."""
    path = Path(os.environ.get("SHARED_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"{path} is absent; set SHARED_DATA to the folder of real inputs")
    return path.resolve()


def stop_fork_server() -> None:
    """Stop the fork server, whose workers get the environment variables of its start."""
    from multiprocessing import forkserver

    server: Any = forkserver._forkserver
    server._stop()


@pytest.fixture(scope="module")
def libero(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[Libero]":
    """The installed one with a config file in a folder of the tests."""
    from lerobot_bomb.libero.assets import Libero

    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.setenv("LIBERO_CONFIG_PATH", str(home / "libero"))
        if (found := Libero.find()) is None:
            pytest.skip("hf-libero is not installed")
        found.write_config()
        stop_fork_server()
        yield found
    stop_fork_server()


@pytest.fixture(scope="module")
def libero_with_assets(libero: "Libero", shared_data: Path) -> "Libero":
    """Return the LIBERO of `libero` with the assets of libero_spatial, and of no other suite."""
    assets = shared_data / "libero" / "assets"
    if not assets.is_dir():
        pytest.skip(f"{assets} is absent")
    libero.assets.parent.mkdir(parents=True)
    libero.assets.symlink_to(assets)
    return libero


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the path of a results file that a test may write."""
    return tmp_path / "results.jsonl"


@pytest.fixture(scope="session")
def pusht_demonstrations(shared_data: Path) -> "Demonstrations":
    """The first real PushT demonstrations."""
    from pusht_cases import NUM_EPISODES, ZARR, Demonstrations

    return Demonstrations.read(shared_data / ZARR, range(NUM_EPISODES))


@pytest.fixture(scope="session")
def pusht_zarr(pusht_demonstrations: "Demonstrations", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write these demonstrations as a zarr."""
    path = tmp_path_factory.mktemp("source") / "small.zarr"
    pusht_demonstrations.write(path)
    return path


@pytest.fixture(scope="session")
def pusht_dataset(pusht_zarr: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Convert these demonstrations to a LeRobotDataset, through the command line."""
    from pusht_cases import REPO_ID

    from lerobot_bomb.commands import main as cli
    from lerobot_bomb.data import resumable

    root = tmp_path_factory.mktemp("converted") / "pusht"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        command = ["convert", "pusht-zarr", str(pusht_zarr), f"--repo_id={REPO_ID}", f"--root={root}"]
        assert cli.main(command) == 0
    assert list(root.parent.iterdir()) == [root]
    return root


@pytest.fixture(scope="session", autouse=True)
def kept_work() -> Iterator[None]:
    """Let commands find what others before them have worked out."""
    with pytest.MonkeyPatch.context() as patch:
        keep_flags(patch)
        keep_distributions(patch)
        if "lerobot" in sys.modules:  # importing it takes seconds, and many tests do without
            look_at_columns_once(patch)
            check_numbers_once(patch)
        contexts = keep_contexts(patch) if "lerobot_env_bomb.bomb.render" in sys.modules else []
        yield
        for context in contexts:
            context.free()


@pytest.fixture(scope="session", autouse=True)
def small_pictures() -> Iterator[int | None]:
    """Draw small what is drawn for people alone, which takes longer than all else; yield the usual size."""
    env: Any = sys.modules.get("lerobot_env_bomb.bomb.env")
    with pytest.MonkeyPatch.context() as patch:
        usual = getattr(env, "PERSON_IMAGE_SIZE", None)
        if env is not None:
            patch.setattr(env, "PERSON_IMAGE_SIZE", 96)
        yield usual


@pytest.fixture
def usual_pictures(small_pictures: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw for people as large as users see it."""
    if small_pictures is not None:
        monkeypatch.setattr("lerobot_env_bomb.bomb.env.PERSON_IMAGE_SIZE", small_pictures)


@pytest.fixture(scope="session", autouse=True)
def recorded_here() -> Iterator[None]:
    """Run the episodes of a recording with one worker in this process: a worker's start takes longer."""
    from lerobot_bomb.data import recorded_blocks
    from lerobot_bomb.data.rollout_pool import RolloutPool, RolloutSettings, RolloutsHere

    def rollouts(
        settings: RolloutSettings, specs: "Iterator[EpisodeSpec]", num_workers: int
    ) -> RolloutPool | RolloutsHere:
        if num_workers == 1:
            return RolloutsHere(settings, specs)
        return RolloutPool(settings, specs, num_workers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded_blocks, "RolloutPool", rollouts)
        yield


@pytest.fixture(autouse=True)
def restored_logging() -> Iterator[None]:
    """LeRobot's commands log to this test's standard error, which pytest closes after it."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture
def stock_cli(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Run a stock LeRobot command in this process: stock_cli("lerobot-eval", "--env.type=bomb", ...)."""

    def run(command: str, *flags: str) -> None:
        module = importlib.import_module(f"lerobot.scripts.{command.replace('-', '_')}")
        monkeypatch.setattr(sys, "argv", [command, *flags])
        module.main()

    return run


@pytest.fixture(scope="module")
def loaded_policies() -> Iterator[None]:
    """Drop the policies of `explain_cases` at the end: results name a policy only if it is the only one."""
    import explain_cases  # loads LeRobot

    yield
    explain_cases.loaded.cache_clear()


def pytest_configure(config: pytest.Config) -> None:
    """Start the server of fresh processes; xdist's workers, which have the address, use it too."""
    if not hasattr(config, "workerinput"):
        started = ExitStack()
        started.enter_context(serving())
        config.add_cleanup(started.close)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--policy.type", dest="policy_type", choices=POLICY_TYPES, help="prove this one only")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect no garbage while modules are imported: there is hardly any, and it takes seconds."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the slowest files to the front, and leave the others as they are."""
    places = {name: place for place, name in enumerate(SLOWEST_FILES)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


def pytest_collection_finish() -> None:
    """Register the plugin, as LeRobot's commands do, whichever files are run and in whatever order.

    What is imported by now stays: no garbage collection need look at it again.
    """
    if "lerobot" in sys.modules:  # importing it takes seconds, and many tests do without
        importlib.import_module("lerobot_policy_bomb")
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, *gc.get_threshold()[1:])  # the usual 700 is soon reached


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that takes a `policy_type` on each policy that learns, or on --policy.type.

    A test that takes `options` too runs on the variants of each. One marked `one_type` is about what the
    types share, and is long on all but FAST_TYPE.
    """
    if "policy_type" not in metafunc.fixturenames:
        return
    chosen = metafunc.config.getoption("policy_type")
    types = [chosen] if chosen else POLICY_TYPES
    if "options" in metafunc.fixturenames:
        variants = [variant for each in types for variant in variants_of(each)]
        metafunc.parametrize(("policy_type", "options"), variants)
    else:
        one_type = not chosen and metafunc.definition.get_closest_marker("one_type")
        slow = {each for each in types if one_type and each != FAST_TYPE}
        metafunc.parametrize(
            "policy_type",
            [pytest.param(each, marks=pytest.mark.long if each in slow else ()) for each in types],
        )


@pytest.fixture
def report(tmp_path: Path) -> "Callable[..., dict[str, Any]]":
    """Return {title: section} of the report of rows, whose page is tmp_path / out / r.html."""
    from report_cases import section_by_title

    return functools.partial(section_by_title, tmp_path)
