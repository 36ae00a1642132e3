"""The help of LeRobot's commands, which lists every field of a config as a flag."""

import copy
from argparse import SUPPRESS
from collections.abc import Iterable
from types import MappingProxyType

# argparse's mark of a flag that works and is not listed; draccus passes `custom_args` on to it. argparse
# compares by identity, so an equal text would be printed
NOT_LISTED = MappingProxyType({"custom_args": {"help": SUPPRESS}})


def leave_out_of_help(config_class: type, names: Iterable[str]) -> None:
    """Leave fields of a dataclass out of its help, though not those of its bases; their flags stay."""
    fields = config_class.__dict__["__dataclass_fields__"]
    for name in names:
        fields[name] = copy.copy(fields[name])
        fields[name].metadata = NOT_LISTED
