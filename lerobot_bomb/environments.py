"""Registry of the env types about which the tools know more than success and rewards."""

from collections.abc import Iterable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

from lerobot_bomb.registry import Registry

UNREGISTERED = "lerobot_bomb.results.stock:unregistered_result"


@dataclass(frozen=True)
class EnvType:
    """An env type and its parts, each given as "module:name" and imported on use.

    A type that is not registered has only what LeRobot reports of every episode: EnvType("aloha").
    """

    name: str  # of --env.type
    record_at: str = ""  # its `Record`, which knows spec, axes and measures
    view_at: str = ""  # its `EnvView`; empty: its episodes are not shown
    tiles_at: str = ""  # a function that draws an episode for `view gallery`; empty: there is none
    check_at: str = ""  # a function of tasks that raises a ValueError if they cannot be run here

    @property
    def record(self) -> Any:
        """Type of its episodes' records."""
        return resolve_name(self.record_at) if self.record_at else resolve_name(UNREGISTERED)(self.name)

    @property
    def view(self) -> Any:
        """View of its episodes."""
        return resolve_name(self.view_at)()

    def check(self, tasks: Iterable[str] = ()) -> None:
        """Raise a ValueError if these values of --env.task cannot be run here."""
        if self.check_at:
            resolve_name(self.check_at)(list(tasks))


def env_type(name: str) -> EnvType:
    """Return the env type of this name, which need not be registered."""
    return ENVIRONMENTS[name] if name in ENVIRONMENTS else EnvType(name)


BOMB = EnvType(
    "bomb",
    record_at="lerobot_bomb.results.bomb:EpisodeResult",
    view_at="lerobot_bomb.viewing.bomb:BombView",
    tiles_at="lerobot_bomb.viewing.bomb:bomb_tiles",
)
BOMB_PUSHT = EnvType(
    "bomb_pusht",
    record_at="lerobot_bomb.results.pusht:PushTResult",
    view_at="lerobot_bomb.viewing.pusht:PushTView",
    tiles_at="lerobot_bomb.viewing.pusht:pusht_tiles",
    check_at="lerobot_bomb.pusht.episode:check_installed",
)
BOMB_LIBERO = EnvType(
    "bomb_libero",
    record_at="lerobot_bomb.results.libero:LiberoResult",
    tiles_at="lerobot_bomb.viewing.libero:libero_tiles",
    check_at="lerobot_bomb.libero.assets:prepare_libero",
)
PUSHT = EnvType("pusht", record_at="lerobot_bomb.results.stock:StockPushTResult")
LIBERO = EnvType(
    "libero",
    record_at="lerobot_bomb.results.stock:StockLiberoResult",
    check_at="lerobot_bomb.libero.assets:prepare_libero",
)
LIBERO_PLUS = EnvType("libero_plus", record_at="lerobot_bomb.results.stock:StockLiberoPlusResult")
ENVIRONMENTS = Registry[EnvType](
    "lerobot_bomb.environments",
    {each.name: each for each in (BOMB, BOMB_PUSHT, BOMB_LIBERO, PUSHT, LIBERO, LIBERO_PLUS)},
)
