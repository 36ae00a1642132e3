"""Section `efficiency`: latency and cost of each policy's queries, and how smoothly it moves."""

from lerobot_bomb.bootstrap import Estimate
from lerobot_bomb.report.chart import MAX_BARS, Chart
from lerobot_bomb.report.dots import Block, Dot, DotColumn, dot_chart
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
    """Write charts of latency and smoothness, with a row per group, device and size of the batch."""
    found = [(report.label(group), each) for group in report.groups for each in efficiencies(group.records)]
    measures = {report.label(group): smoothness_of(group.records) for group in report.groups}
    smooth = {name: each for name, each in measures.items() if each}
    charts = [_latency_chart(found)] if found else []
    charts += [_smoothness_chart(smooth)] if smooth else []
    return Section("Efficiency", [], charts=charts)


def _latency_chart(found: list[tuple[str, Efficiency]]) -> Chart:
    title = "Latency of a query, and how many passes of the network it takes"
    table = Table(
        "Queries", QUERIES_HEADER, [[Cell(name), *_cells(each)] for name, each in found], QUERIES_NOTE
    )
    shown = found[:MAX_BARS]
    batches = {each.batch_size for _, each in shown}
    names = [
        name if len(batches) == 1 or each.batch_size is None else f"{name}, {each.batch_size} at once"
        for name, each in shown
    ]
    latency = [Dot(each.latency_p50_ms, each.latency_p50_ms, each.latency_p95_ms) for _, each in shown]
    columns = [
        DotColumn(
            "latency, ms: p50 to p95",
            {0: [*latency]},
            (0, 1.05 * max(each.latency_p95_ms for _, each in shown)),
        )
    ]
    passes = [None if each.passes is None else Dot(each.passes, None, None) for _, each in shown]
    if any(passes):
        columns.append(DotColumn("passes per query", {0: passes}))
    note = "Device: " + ", ".join(dict.fromkeys(each.device for _, each in shown)) + "."
    return Chart(title, dot_chart(title, [""], [Block("", names, columns)]), [table], note)


def _smoothness_chart(smooth: dict[str, dict[str, Estimate]]) -> Chart:
    title = "Smoothness of the executed actions; less is smoother"
    rows = [
        [Cell(name), *(Cell(str(found[each]), vars(found[each])) for each in SMOOTHNESS)]
        for name, found in smooth.items()
    ]
    table = Table("Smoothness", ["policy, suite", *SMOOTHNESS], rows, SMOOTHNESS_NOTE)
    shown = dict(list(smooth.items())[:MAX_BARS])
    columns = [
        DotColumn(f"{name}, per step", {0: [_dot(found[name]) for found in shown.values()]})
        for name in SMOOTHNESS
    ]
    return Chart(title, dot_chart(title, [""], [Block("", list(shown), columns)]), [table])


def _dot(estimate: Estimate) -> Dot:
    return Dot(estimate.mean, estimate.low, estimate.high)


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
