"""Section `published`: other people's figures on these tasks and models; none was measured here."""

from dataclasses import dataclass

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table

TITLE = "Published, not measured here"
MARK = "published"

BOMB_BLOG = "Misterka, Jarosz and Alani: Towards generalist Vision Language Action models"
SMOL_BLOG = "Balakhnov, Skvortsov and Zarin: VLA-0-Smol (2025)"
SMOL_TABLE = f"{SMOL_BLOG}; its table of Goyal et al. (2025)"
FDVLA_TABLE = "FDVLA, a paper under review: table 1"
FDVLA_SPEED = "FDVLA, a paper under review: table 6 and section 4.7, one A800"
SPATIAL_SLIDES = "SpatialVLA: slides of 2025-03-03"
SPATIAL_PAPER = "SpatialVLA (arXiv 2501.15830)"


@dataclass(frozen=True)
class Figure:
    """A published figure: model, source, values."""

    model: str
    setting: str
    value: str
    source: str


# {task, which `bomb_pusht` and `bomb_libero` share with LeRobot's own: success rates}
SUCCESS = {
    "bomb": (
        Figure("OpenVLA", "without perturbations", "34 %", BOMB_BLOG),
        Figure("OpenVLA", "with perturbations", "0 %", BOMB_BLOG),
        Figure("OpenVLA-OFT", "with perturbations", "0 %", BOMB_BLOG),
        Figure("SpatialVLA", "with perturbations", "0 %", BOMB_BLOG),
        Figure("pi0", "with perturbations", "0 %", BOMB_BLOG),
    ),
    "pusht": (
        Figure("VLA-0-Smol", "absolute actions, no state", "29.7 %", SMOL_BLOG),
        Figure("VLA-0-Smol", "absolute actions, state", "45.3 %", SMOL_BLOG),
        Figure("VLA-0-Smol", "relative actions, no state", "57.8 %", SMOL_BLOG),
        Figure("VLA-0-Smol", "relative actions, state", "70.3 %", SMOL_BLOG),
        Figure("VLA-0-Smol", "relative actions, state, masked actions", "78.1 %", SMOL_BLOG),
        Figure("FDVLA-3B", "normalised", "0.89", FDVLA_TABLE),
        Figure("ARP", "normalised", "0.876", FDVLA_TABLE),
        Figure("Diffusion", "normalised", "0.788", FDVLA_TABLE),
        Figure("pi0", "normalised", "0.763", FDVLA_TABLE),
        Figure("ACT", "normalised", "0.69", FDVLA_TABLE),
        Figure("OpenVLA", "normalised", "0.597", FDVLA_TABLE),
    ),
    "libero": (
        Figure("VLA-0, 3B", "mean of four suites", "94.7 %", SMOL_TABLE),
        Figure("VLA-0-Smol, 0.5B", "mean of four suites, ensemble of 8", "94.1 %", SMOL_BLOG),
        Figure("VLA-0-Smol, 0.5B", "mean of four suites, 8 actions executed", "90.7 %", SMOL_BLOG),
        Figure("pi0.5-KI, 3.3B", "mean of four suites", "93.3 %", SMOL_TABLE),
        Figure("OpenVLA-OFT, 7B", "mean of four suites", "91.9 %", SMOL_TABLE),
        Figure("SmolVLA, 2.25B", "mean of four suites", "88.8 %", SMOL_TABLE),
        Figure("SmolVLA, 0.25B", "mean of four suites", "82.8 %", SMOL_TABLE),
        Figure("SpatialVLA, 4B", "mean of four suites", "78.1 %", SPATIAL_PAPER),
        Figure("Diffusion Policy, 0.15B", "mean of four suites", "72.4 %", SMOL_TABLE),
        Figure("pi0-FAST, 3B", "mean of four suites", "71.8 %", SMOL_TABLE),
    ),
}
NOTES = {
    "bomb": "The original BOMB is another environment: robosuite, a Panda arm at 8 Hz, 26 mm of tolerance.",
    "pusht": (
        "VLA-0-Smol: the best checkpoint on 64 episodes. FDVLA's table: means of three runs; how success is "
        "normalised is not said."
    ),
    "libero": "Of the four suites only means are given here: the source's columns stand in two orders.",
}
SPEED = (
    Figure("OpenVLA", "7B, 14 GB", "~3 Hz", BOMB_BLOG),
    Figure("OpenVLA-OFT", "7.7B, 16 GB", "~3 Hz", BOMB_BLOG),
    Figure("SpatialVLA", "4B, 8 GB", "~5 Hz", BOMB_BLOG),
    Figure("pi0", "3.3B, 7 GB", "~8 Hz", BOMB_BLOG),
    Figure("FDVLA", "3B", "66 Hz", FDVLA_SPEED),
    Figure("FDVLA", "7B", "31 Hz", FDVLA_SPEED),
    Figure("FDVLA", "32B", "7 Hz", FDVLA_SPEED),
    Figure("pi0", "2.6B", "21 Hz", FDVLA_SPEED),
    Figure("OpenVLA", "7B", "9 Hz", FDVLA_SPEED),
    Figure("SpatialVLA", "", "20.1 Hz", SPATIAL_SLIDES),
    Figure("OpenVLA", "", "6.5 Hz", SPATIAL_SLIDES),
    Figure("TraceVLA", "", "5.2 Hz", SPATIAL_SLIDES),
    Figure("RT-2-X", "", "5.0 Hz", SPATIAL_SLIDES),
)
SPEED_NOTE = (
    "What a source counts, actions or queries, is not always said, nor on which machine. SpatialVLA's "
    "20.1 Hz count every action of a chunk."
)


def section(report: Report) -> Section:
    """Write the section: published success rates on each environment's task, and speeds."""
    tasks = dict.fromkeys(group.record_type.env_type.removeprefix("bomb_") for group in report.groups)
    tables = [_table(f"Success: {each}", SUCCESS[each], NOTES[each]) for each in tasks if each in SUCCESS]
    return Section(TITLE, [*tables, _table("Speed", SPEED, SPEED_NOTE)], is_folded=True)


def _table(title: str, figures: tuple[Figure, ...], note: str) -> Table:
    rows = [
        [Cell(f"{each.model} ({MARK})"), *map(Cell, (each.setting, each.value, each.source))]
        for each in figures
    ]
    return Table(title, ["model", "setting", "figure", "source"], rows, note)
