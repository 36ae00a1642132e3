"""Fields of the policies' configs by group, and those that several policies share."""

from collections.abc import Iterable

from config_fields import meaning_of, own_fields

from lerobot_bomb.policies.flag_groups import flags_of

LISTED = "Listed by `--help`"
RESEARCH = "For research, not in `--help`"
FILLED_IN = "Filled in by the code"


def groups_of(config_class: type) -> dict[str, list[str]]:
    """{title of a group: a policy's fields in it}."""
    names = [each.name for each in own_fields(config_class)]
    research, filled_in = (flags_of(config_class, group) for group in ("RESEARCH", "FILLED_IN"))
    return {
        LISTED: [each for each in names if each not in {*research, *filled_in}],
        RESEARCH: [each for each in names if each in research],
        FILLED_IN: [each for each in names if each in filled_in],
    }


def shared_fields(config_classes: Iterable[type]) -> dict[str, dict[str, str]]:
    """{title of a group: {field: its meaning}} of what several policies have, with one meaning.

    Fields that the code fills in are shared if all policies have them: their table has no column per policy.
    """
    meanings: dict[str, dict[str, list[str]]] = {LISTED: {}, RESEARCH: {}, FILLED_IN: {}}
    for config_class in (classes := [*config_classes]):
        for title, names in groups_of(config_class).items():
            for name in names:
                meanings[title].setdefault(name, []).append(meaning_of(config_class, name))
    return {
        title: {
            name: each[0]
            for name, each in fields.items()
            if len({*each}) == 1 and len(each) >= (len(classes) if title == FILLED_IN else 2)
        }
        for title, fields in meanings.items()
    }
