"""Wrong flags of LeRobot's commands that choose a type of ours: one line instead of all usage."""

import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields
from inspect import signature
from typing import Any, NoReturn, get_origin

from draccus.parsers import decoding
from draccus.wrappers.suppressing_argparse import SuppressingArgumentParser
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig

from lerobot_bomb.compat.hooks.paths import names_ours
from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_ours


def tell_wrong_flags(
    hint: Callable[[Sequence[str], Collection[str], Sequence[str]], str],
    refuse_unknown: Callable[[str, Collection[str], Sequence[str]], NoReturn],
) -> None:
    """Let LeRobot's commands say in one line which flag is wrong.

    Their parser prints hundreds of lines of usage first. `hint(words, flags, argv)` is added to its message;
    `refuse_unknown(flag, flags, argv)` raises for a flag that only other types than the chosen one have.
    """

    def around_error(usual: Callable[..., NoReturn]) -> Callable[..., NoReturn]:
        def error(self: Any, message: str) -> NoReturn:
            if not names_ours(sys.argv):
                usual(self, message)
            words = message.partition("unrecognized arguments: ")[2].split()
            flags = _flags_of_chosen_types(self._option_string_actions, sys.argv)
            known = [word for word in sys.argv if repr(word.partition("=")[2]) not in message]
            print(f"{self.prog}: error: {message}{hint(words, flags, known)}", file=sys.stderr)
            raise SystemExit(2)

        return error

    def around_decode(usual: Callable[..., Any]) -> Callable[..., Any]:
        def decode_dataclass(*args: Any, **kwargs: Any) -> Any:
            cls, values, *path = signature(usual).bind(*args, **kwargs).arguments.values()
            kind = get_origin(cls) or cls
            # without a path the values are of a checkpoint's file
            if path and path[0] and isinstance(values, dict) and is_ours(kind):
                names = [each.name for each in fields(kind)]
                unknown = [name for name in values if name not in names]
                if unknown:
                    flag, *flags = [f"--{'.'.join((*path[0], name))}" for name in (unknown[0], *names)]
                    refuse_unknown(flag, flags, sys.argv)
            return usual(*args, **kwargs)

        return decode_dataclass

    replace(SuppressingArgumentParser, "error", around_error)
    replace(decoding, "decode_dataclass", around_decode)


def _flags_of_chosen_types(flags: Collection[str], argv: Sequence[str]) -> list[str]:
    """Drop the flags of types that were not chosen: LeRobot's parser knows those of all."""
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
