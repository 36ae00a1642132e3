"""Section `efficiency`: latency and cost of each policy's queries, and how smoothly it moves."""

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.efficiency import Efficiency, efficiencies, smoothness_of

NONE_CELL = Cell("-")
PREFIXES = ("", "k", "M", "G")
QUERIES_NOTE = (
    "A query is a call of the policy that runs its network, for all episodes of a batch at once; p50 and p95 "
    "are percentiles of an episode's latencies, and their medians over episodes are shown. Passes of the "
    "network and generated tokens are means per query. Hz: actions that an episode executes, by second of "
    "its queries. Memory: the peak, on CUDA of tensors, on a CPU of the whole process."
)
QUERIES_HEADER = [
    "policy, suite", "device", "batch", "p50, ms", "p95, ms", "queries", "passes", "tokens", "Hz",
    "parameters", "memory, MiB",
]  # fmt: skip
SMOOTHNESS = ("J2", "J3")
SMOOTHNESS_NOTE = (
    "J2, J3: mean second and third differences of the executed actions per step, in their own units, without "
    "the gripper, with 95 % intervals over episodes; less is smoother."
)


def section(report: Report) -> Section:
    """Write a row of queries per group, device and size of the batch, and a row of smoothness per group."""
    queries = [
        [Cell(group.name), *_cells(each)] for group in report.groups for each in efficiencies(group.records)
    ]
    measures = {group.name: smoothness_of(group.records) for group in report.groups}
    smooth = [
        [Cell(name), *(Cell(str(found[each]), vars(found[each])) for each in SMOOTHNESS)]
        for name, found in measures.items()
        if found
    ]
    tables = [
        Table("Queries", QUERIES_HEADER, queries, QUERIES_NOTE),
        Table("Smoothness", ["policy, suite", *SMOOTHNESS], smooth, SMOOTHNESS_NOTE),
    ]
    return Section("Efficiency", [table for table in tables if table.rows])


def is_measured(report: Report) -> bool:
    """Return True if the section has something to show."""
    records = (record for group in report.groups for record in group.records)
    return any(each.inference is not None or each.action_j2 is not None for each in records)


def _cells(efficiency: Efficiency) -> list[Cell]:
    mebibytes = None if efficiency.peak_memory_bytes is None else efficiency.peak_memory_bytes / 2**20
    return [
        Cell(efficiency.device),
        _number(efficiency.batch_size, "d"),
        _number(efficiency.latency_p50_ms, ".3g"),
        _number(efficiency.latency_p95_ms, ".3g"),
        _number(efficiency.num_queries, "d"),
        _number(efficiency.passes, ".3g"),
        _number(efficiency.tokens, ".3g"),
        _number(efficiency.actions_per_s, ".3g"),
        Cell(_short(efficiency.num_parameters), efficiency.num_parameters),
        _number(mebibytes, ".0f"),
    ]


def _number(value: float | None, form: str) -> Cell:
    return NONE_CELL if value is None else Cell(f"{value:{form}}", value)


def _short(number: float) -> str:
    """1_234_567 -> '1.23 M'."""
    place = 0
    while number >= 999.5 and place < len(PREFIXES) - 1:
        number, place = number / 1000, place + 1
    return f"{number:.3g} {PREFIXES[place]}".rstrip()
