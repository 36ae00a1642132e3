"""How fast each policy answers, what that takes, and how smoothly it moves."""

from lerobot_bomb.evaluation.efficiency import Efficiency, efficiencies, smoothness_of
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.stats import Measure

NONE_CELL = Cell("-")
PREFIXES = ("", "k", "M", "G")
NOTE = (
    "A query is a call of the policy that runs its network, for all episodes of a batch at once; latencies "
    "are medians over episodes of their p50 and p95. Passes of the network and generated tokens are means "
    "per query. Hz: actions that an episode executes, by second of its queries. Memory: the peak, on CUDA of "
    "tensors, on a CPU of the whole process. J2, J3: mean second and third differences of the executed "
    "actions per step, in their own units, without the gripper, with 95 % intervals over episodes; less is "
    "smoother."
)
HEADER = [
    "policy, suite", "device", "batch", "p50, ms", "p95, ms", "queries", "passes", "tokens", "Hz",
    "parameters", "memory, MiB", "J2", "J3",
]  # fmt: skip


def section(report: Report) -> Section:
    """A line for each arm, device and size of the batch."""
    rows = [row for arm in report.arms for row in _rows(arm)]
    return Section("Efficiency", [Table("", HEADER, rows, NOTE)] if rows else [])


def _rows(arm: Arm) -> list[list[Cell]]:
    smooth = smoothness_of(arm.rows)
    ends = [_smoothness(smooth.get(name)) for name in ("J2", "J3")]
    found = [[Cell(arm.name), *_cells(each), *ends] for each in efficiencies(arm.rows)]
    if found or not smooth:
        return found
    return [[Cell(arm.name), *[NONE_CELL] * (len(HEADER) - 1 - len(ends)), *ends]]


def _cells(of: Efficiency) -> list[Cell]:
    mebibytes = None if of.peak_memory_bytes is None else of.peak_memory_bytes / 2**20
    return [
        Cell(of.device),
        _number(of.batch_size, "d"),
        _number(of.latency_p50_ms, ".3g"),
        _number(of.latency_p95_ms, ".3g"),
        _number(of.num_queries, "d"),
        _number(of.passes, ".3g"),
        _number(of.tokens, ".3g"),
        _number(of.actions_per_s, ".3g"),
        Cell(_short(of.num_parameters), of.num_parameters),
        _number(mebibytes, ".0f"),
    ]


def _number(value: float | None, form: str) -> Cell:
    return NONE_CELL if value is None else Cell(f"{value:{form}}", value)


def _smoothness(of: Measure | None) -> Cell:
    return NONE_CELL if of is None else Cell(str(of), vars(of))


def _short(number: float) -> str:
    """1_234_567 -> '1.23 M'."""
    place = 0
    while number >= 999.5 and place < len(PREFIXES) - 1:
        number, place = number / 1000, place + 1
    return f"{number:.3g} {PREFIXES[place]}".rstrip()
