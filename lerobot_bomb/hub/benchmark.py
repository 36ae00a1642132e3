"""A benchmark's dataset on the Hub: the tasks of its leaderboard, a card, and records of episodes."""

from collections.abc import Sequence

from huggingface_hub import DatasetCardData

from lerobot_bomb.hub.evaluations import as_yaml, task_ids_of
from lerobot_bomb.hub.markdown import command, fenced, plain
from lerobot_bomb.hub.push import CARD
from lerobot_bomb.hub.rates import headline, results_table
from lerobot_bomb.results.groups import Group
from lerobot_bomb.results.reading import line_of

EVAL = "eval.yaml"
RECORDS = "records.jsonl"
CONFIG, SPLIT = "default", "test"  # of the records, as `datasets` reads them
ABOUT = {
    "bomb": "Put Go stones on named intersections, under perturbations that are turned on one by one.",
    "bomb_pusht": "PushT under perturbations that are turned on one by one.",
    "bomb_libero": "LIBERO under perturbations that are turned on one by one.",
}


def benchmark_files(benchmark_id: str, groups: Sequence[Group]) -> dict[str, str]:
    """Return {name: content} of the files of a benchmark's repository.

    Args:
        benchmark_id: USER/NAME of the dataset.
        groups: of one env type; their suites and conditions are the tasks of the leaderboard.

    Raises:
        ValueError: the records are of several env types.
    """
    records = [record for group in groups for record in group.records]
    types = sorted({record.env_type for record in records})
    if len(types) > 1:
        raise ValueError(f"--benchmark_id={benchmark_id}: the records are of {' and '.join(types)}; give one")
    name = benchmark_id.partition("/")[2]
    about = ABOUT.get(types[0], f"LeRobot's {types[0]}.")
    tasks = [{"id": task_id, "config": CONFIG, "split": SPLIT} for task_id in task_ids_of(groups)]
    versions = "; ".join(sorted({record.benchmark() for record in records}))
    evaluation = {"name": name, "description": f"{about} {versions}.", "tasks": tasks}
    return {
        EVAL: as_yaml(evaluation),
        CARD: _card(benchmark_id, about, groups),
        RECORDS: "".join(f"{line_of(record)}\n" for record in records),
    }


def _card(benchmark_id: str, about: str, groups: Sequence[Group]) -> str:
    metadata = DatasetCardData(
        license="apache-2.0",
        task_categories=["robotics"],
        tags=["LeRobot", "lerobot_bomb"],
        configs=[{"config_name": CONFIG, "data_files": [{"split": SPLIT, "path": RECORDS}]}],
    )
    ours = command(
        "lerobot-bomb", "export", "results.jsonl", f"--benchmark_id={benchmark_id}", "--output=export"
    )
    name = benchmark_id.partition("/")[2]
    paragraphs = [
        f"---\n{metadata.to_yaml()}\n---",
        f"# {name}",
        f"{about} `{RECORDS}` holds a record of every episode, with its seed and failure class: "
        f"`lerobot-bomb results {RECORDS}` prints the tables below, and `lerobot-bomb report {RECORDS}` "
        "makes a page of them. It needs `pip install lerobot_policy_bomb`.",
        "To add a model to the leaderboard, evaluate it with `--env.results_path=results.jsonl`, then add "
        "`.eval_results/lerobot_bomb.yaml`, which this command writes, to the model's repository:",
        fenced(ours),
    ]
    for group in groups:
        paragraphs += [f"## {plain(group.name)}", headline(group), results_table(group)]
    return "\n\n".join(paragraphs) + "\n"
