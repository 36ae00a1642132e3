"""Title of a report: what was evaluated."""

from lerobot_bomb.report.report import Report
from lerobot_bomb.tables import in_a_row, shorten_all

MAX_NAMED = 3  # policies and suites that a title names


def title_of(report: Report) -> str:
    """Return 'act and pi0 on bomb (place): 400 episodes, 11 conditions'."""
    policies = list(report.policies)
    few = len(policies) <= MAX_NAMED
    who = in_a_row([*shorten_all(policies).values()]) if few else f"{len(policies)} policies"
    suites: dict[str, dict[str, None]] = {}
    for group in report.groups:
        of_type = suites.setdefault(group.record_type.env_type, {})
        if suite := group.settings.get("suite"):
            of_type[suite] = None
    where = in_a_row([_with_suites(env_type, list(names)) for env_type, names in suites.items()])
    conditions = {each.spec.perturbations for group in report.groups for each in group.records}
    number = sum(len(group.records) for group in report.groups)
    counts = f"{number:,} episode{'s' * (number != 1)}"
    counts += f", {len(conditions):,} conditions" if len(conditions) > 1 else ""
    return f"{who} on {where}: {counts}"


def _with_suites(env_type: str, suites: list[str]) -> str:
    if not suites:
        return env_type
    named = in_a_row(suites) if len(suites) <= MAX_NAMED else f"{len(suites)} suites"
    return f"{env_type} ({named})"
