"""Episodes that a visitor of the app chose, run by commands of this program.

The page shows each command, so what is seen can be repeated.
"""

import contextlib
import io
import shlex
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from tempfile import mkdtemp

from lerobot_bomb.bomb.episode import MAX_SEED
from lerobot_bomb.checkpoints.names import is_hub_id
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.commands.explain import PAGE
from lerobot_bomb.commands.table import PROGRAM
from lerobot_bomb.conditions import NONE
from lerobot_bomb.results.names import SHIPPED_PREFIX
from lerobot_bomb.viewing.episode import EXPERT

DRAWN = "drawn"  # choice of a target or colour: as the seed says
SUITE_WITH_TARGETS = "place"
MAX_CHARACTERS = 300  # of a policy's name or path


@dataclass(frozen=True)
class Choice:
    """Episode that a visitor chose, and the policy that acts in it."""

    policy: str
    suite: str
    seed: int
    row: str = DRAWN
    column: str = DRAWN
    color: str = DRAWN
    levels: Mapping[str, int] = field(default_factory=dict)

    @property
    def condition(self) -> str:
        """Condition as a flag writes it: none, or camera:3+light:1."""
        return "+".join(f"{axis}:{level}" for axis, level in self.levels.items() if level) or NONE

    def flags(self) -> list[str]:
        """Return the flags of `view` and `explain` for the episode.

        Raises:
            ValueError: names what cannot be run.
        """
        check_policy_name(self.policy)
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"seed {self.seed} must lie in 0..{MAX_SEED}")
        policy = f"--policy={EXPERT}" if self.policy == EXPERT else f"--policy.path={self.policy}"
        flags = [policy, f"--env.task={self.suite}", f"--seed={self.seed}"]
        if self.condition != NONE:
            flags.append(f"--env.perturbations={self.condition}")
        if self.suite != SUITE_WITH_TARGETS:
            return flags
        if (self.row == DRAWN) != (self.column == DRAWN):
            raise ValueError("choose both row and column, or neither")
        if self.row != DRAWN:
            flags.append(f"--env.target=[{self.row},{self.column}]")
        return flags if self.color == DRAWN else [*flags, f"--env.color={self.color}"]


def check_policy_name(policy: str) -> None:
    """Raise a ValueError unless this may be a policy: expert, bomb:NAME, a folder, or a name on the Hub."""
    if not policy or len(policy) > MAX_CHARACTERS:
        raise ValueError(f"a policy's name has 1 to {MAX_CHARACTERS} characters")
    if policy.startswith(SHIPPED_PREFIX):
        checkpoint_path(policy)
    elif policy != EXPERT and not Path(policy).is_dir() and not is_hub_id(policy):
        raise ValueError(f"{policy} is neither a folder nor a name on the Hub (USER/NAME)")


@dataclass(frozen=True)
class Shown:
    """Outcome of a command that was run for the page."""

    command: str
    text: str  # what it printed
    file: Path  # video or page


class Commands:
    """Commands of this program, run one after another in a process that keeps its imports.

    MuJoCo draws only in the thread that made its context, and a page has many threads.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pool = self._new_pool()

    @staticmethod
    def _new_pool() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn"))

    def __enter__(self) -> "Commands":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def view(self, choice: Choice) -> Shown:
        """Run an episode; return its video."""
        return self._run("view", choice, ".mp4")

    def explain(self, choice: Choice) -> Shown:
        """Explain an episode; return its page."""
        if choice.policy == EXPERT:
            raise ValueError("the expert reads the simulator's state; there is nothing to explain")
        return self._run("explain", choice, f"/{PAGE}")

    def _run(self, name: str, choice: Choice, ending: str) -> Shown:
        flags = choice.flags()
        output = Path(mkdtemp(dir=self._folder)) / name  # the folder may hold files of an earlier run
        try:
            code, text = self._pool.submit(run_here, [name, *flags, f"--output={output}"]).result()
        except BrokenProcessPool:
            self._pool = self._new_pool()
            raise RuntimeError("the simulator's process ended; is there enough memory? Try again") from None
        if code:
            raise ValueError(text.strip().splitlines()[-1] if text.strip() else f"{name} failed")
        return Shown(shlex.join([PROGRAM, name, *flags]), text, Path(f"{output}{ending}"))


def run_here(argv: Sequence[str]) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it printed, or else its errors."""
    from lerobot_bomb.commands.main import main

    printed, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            code = main([*map(local_path, argv)])
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
    return code, printed.getvalue() if code == 0 else errors.getvalue()


def local_path(flag: str) -> str:
    """Return a flag; a checkpoint on the Hub is downloaded, and the flag then names its folder.

    Raises:
        ValueError: it cannot be downloaded.
    """
    name, _, value = flag.partition("=")
    if name != "--policy.path" or value.startswith(SHIPPED_PREFIX) or Path(value).is_dir():
        return flag
    import httpx
    from huggingface_hub import snapshot_download

    try:
        return f"{name}={snapshot_download(value, allow_patterns=['*.json', '*.safetensors'])}"
    except (OSError, httpx.HTTPError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{value} cannot be downloaded from the Hub: {reason}") from None
