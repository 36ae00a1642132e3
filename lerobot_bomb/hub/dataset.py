"""Publishing of a recorded dataset, with its card, on the Hub."""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from huggingface_hub import CommitInfo, DatasetCardData, HfApi
from huggingface_hub.errors import RevisionNotFoundError

from lerobot_bomb.conditions import NONE
from lerobot_bomb.data.dataset_files import check_dataset
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.resumable import check_counts
from lerobot_bomb.data.statistics import check_statistics
from lerobot_bomb.data.unfinished import METADATA_FILE
from lerobot_bomb.hub.markdown import code, command, fenced, plain
from lerobot_bomb.hub.method import BOMB
from lerobot_bomb.hub.push import CARD
from lerobot_bomb.hub.upload import check_token, hub_errors, upload
from lerobot_bomb.report.cells import count
from lerobot_bomb.report.chart import standalone
from lerobot_bomb.report.sections.failures import stacked
from lerobot_bomb.report.table import Cell, Table
from lerobot_bomb.stats import format_rate

FIGURE, FIGURE_TITLE = "outcomes.svg", "How the expert's episodes ended"
FOLDERS = ("meta", "data", "videos")


@dataclass(frozen=True)
class RecordedDataset:
    """A checked dataset, as it is published."""

    repo_id: str
    files: dict[str, Path]  # by name on the Hub
    facts: DatasetFacts

    @property
    def card(self) -> str:
        return dataset_card(self.repo_id, self.facts)

    @property
    def contents(self) -> dict[str, Path | bytes]:
        """Return all that is published, by name on the Hub."""
        drawn = figure(self.facts)
        figures = {} if drawn is None else {FIGURE: drawn}
        return {**self.files, CARD: self.card.encode(), **figures}


def read_dataset(root: Path, repo_id: str) -> RecordedDataset:
    """Read and check the dataset in a folder.

    Raises:
        ValueError: the dataset is damaged, or lerobot-bomb did not write it, or not all of it.
    """
    facts = DatasetFacts.read(root)
    if not facts.bomb:
        raise ValueError(
            f"{root} holds no {METADATA_FILE}, so lerobot-bomb did not write it; "
            "LeRobotDataset.push_to_hub publishes other datasets"
        )
    check_dataset(root)
    check_counts(root)
    check_statistics(root)
    files = {
        path.relative_to(root).as_posix(): path
        for folder in FOLDERS
        for path in sorted((root / folder).rglob("*"))
        if path.is_file()
    }
    return RecordedDataset(repo_id, files, facts)


def publish_dataset(dataset: RecordedDataset, private: bool | None) -> CommitInfo:
    """Publish all of a dataset in one commit, and tag it for LeRobot.

    Raises:
        RuntimeError: the Hub cannot be reached or does not take it.
    """
    check_token()
    info = dataset.facts.info
    message = f"{info['total_episodes']} episodes and card"
    commit = upload(dataset.repo_id, "dataset", dataset.contents, _is_data, message, private=private)
    with hub_errors(dataset.repo_id):
        _tag(dataset.repo_id, info["codebase_version"])
    return commit


def _is_data(path: str) -> bool:
    """Return True for a figure, or a file that LeRobot reads: none is left of another recording."""
    return path == FIGURE or path.split("/")[0] in FOLDERS


def dataset_card(repo_id: str, facts: DatasetFacts) -> str:
    """Write the dataset's card: its content, how to use it, what it does not hold, whom to cite."""
    metadata = DatasetCardData(
        # of episodes that this package simulated; a converted dataset keeps its own, which no file tells
        license="apache-2.0" if facts.recording else None,
        tags=["LeRobot", "lerobot_bomb"],
        task_categories=["robotics"],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    written = "converted" if facts.conversion else "recorded"
    sections = {
        "Use": _use(repo_id, facts),
        "What it does not hold": "\n".join(f"- {each}" for each in _limits(facts)),
        "Features": _features(facts),
        "Citation": _citation(facts),
    }
    lines = "\n".join(map(plain, facts.lines()))
    start = (
        f"# {repo_id.split('/')[-1]}\n\nA LeRobotDataset {facts.info['codebase_version']}, {written} by "
        f"`lerobot-bomb`.\n\n{_outcomes_text(facts)}{lines}\n"
    )
    text = start + "".join(f"\n## {title}\n\n{section}\n" for title, section in sections.items())
    return f"---\n{metadata.to_yaml()}\n---\n\n{text}"


def _outcomes(facts: DatasetFacts) -> Table | None:
    """Count how the expert's episodes ended, as a report does; None where the expert did not act."""
    if not _is_of_expert(facts):
        return None
    failures = Counter(each["failure"] for each in facts.bomb.get("failures", []))
    names = [name for name, _ in failures.most_common()]
    kept = facts.bomb["num_episodes"]
    total = kept + failures.total()
    row = [Cell("the expert's episodes"), Cell(str(total), total)]
    row += [count(number, total) for number in (kept, *(failures[name] for name in names))]
    return Table("", ["", "episodes", "success", *names], [row])


def _is_of_expert(facts: DatasetFacts) -> bool:
    """Return True if the scripted expert ran the episodes: no other policy did, and they are no scenes."""
    recording = facts.recording
    return bool(recording) and not recording.get("relabel") and not recording.get("static")


def _outcomes_text(facts: DatasetFacts) -> str:
    """Return the expert's rate of success in a sentence, and the figure, as Markdown."""
    table = _outcomes(facts)
    if table is None:
        return ""
    _, total, kept, *_ = (cell.value for cell in table.rows[0])
    rate = f"The scripted expert succeeded in {format_rate(kept, total)} of the episodes it ran"
    return f"{rate}; its successes are the dataset.\n\n![{FIGURE_TITLE}]({FIGURE})\n\n"


def figure(facts: DatasetFacts) -> bytes | None:
    """Draw how the expert's episodes ended, as an SVG file; None where the expert did not act."""
    table = _outcomes(facts)
    return None if table is None else standalone(stacked(FIGURE_TITLE, table.header[2:], table)).encode()


def _use(repo_id: str, facts: DatasetFacts) -> str:
    """Install, train and evaluate, as Markdown."""
    train = command(
        "lerobot-train",
        f"--dataset.repo_id={repo_id}",
        "--policy.type=TYPE",
        "--policy.push_to_hub=false",
        "--output_dir=outputs/train",
    )
    last = "--policy.path=outputs/train/checkpoints/last/pretrained_model"
    flags = facts.eval_flags()
    lines = ["pip install .  # in a checkout of lerobot_bomb", train]
    lines += [] if flags is None else [command("lerobot-eval", last, *flags)]
    return f"{fenced('\n'.join(lines))}\n\nTYPE is a policy type of lerobot_bomb, or of LeRobot's own."


def _limits(facts: DatasetFacts) -> Iterator[str]:
    shown = facts.perturbations
    if shown == [NONE]:
        yield "Perturbed scenes: all are unperturbed."
    if facts.recording:
        if _is_of_expert(facts):
            yield "Failed episodes: the scripted expert's successes alone were kept."
        yield "A robot's own data: all of it is simulated."
    if facts.conversion:
        yield f"A licence: that of its source holds ({plain(facts.conversion['source'])})."


def _features(facts: DatasetFacts) -> str:
    rows = [
        f"| {code(name)} | {feature['dtype']} | {tuple(feature['shape'])} |"
        for name, feature in facts.info["features"].items()
    ]
    return "\n".join(["| feature | type | shape |", "|---|---|---|", *rows])


def _citation(facts: DatasetFacts) -> str:
    theirs = " and the authors of the demonstrations that it was converted from" if facts.conversion else ""
    return f"Cite lerobot_bomb{theirs}:\n\n{fenced(BOMB.bibtex(), 'bibtex')}"


def _tag(repo_id: str, version: str) -> None:
    """Tag the commit with the dataset's version, the tag that LeRobot loads."""
    api = HfApi()
    with suppress(RevisionNotFoundError):
        api.delete_tag(repo_id, tag=version, repo_type="dataset")
    api.create_tag(repo_id, tag=version, repo_type="dataset")
