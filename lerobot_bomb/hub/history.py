"""History of a checkpoint: its trainings, as far as its files and its parents' on this machine tell."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from lerobot_bomb.checkpoints.checks import ADAPTERS
from lerobot_bomb.checkpoints.identity import sha256_of
from lerobot_bomb.checkpoints.names import CONFIG, WEIGHTS, is_hub_id, local_file
from lerobot_bomb.checkpoints.training import dataset_of, read_train_config
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.files import read_json
from lerobot_bomb.hub.markdown import code, plain
from lerobot_bomb.results.names import shipped_name

UNKNOWN = "not known"
NO_NAME = "CHECKPOINT"  # stands in a command for a checkpoint that no other machine has
BEFORE = "before"  # a number of batches that is not known
HEADER = ("batches", "data", "perturbations", "batch size", "seed", "ends in")


@dataclass(frozen=True)
class Training:
    """A training of a checkpoint's history, and the checkpoint that it ended in."""

    num_batches: int  # of this training and all before
    train_config: Mapping[str, Any]  # its train_config.json; {}: there is none
    facts: DatasetFacts | None = None  # of its dataset; None: not on this machine
    name: str | None = None  # of the checkpoint; None: one that no other machine has
    weights_sha256: str | None = None  # of the checkpoint; None: the card's own

    @property
    def dataset(self) -> str | None:
        """Name of the dataset, as the training has it."""
        return (self.train_config.get("dataset") or {}).get("repo_id")

    @property
    def num_before(self) -> int | None:
        """Batches before this training, below 0 if it was saved before its end; None if its file is gone."""
        steps = self.train_config.get("steps")
        return None if steps is None else self.num_batches - steps

    @property
    def is_published(self) -> bool:
        """Return True if its config has lost the paths of the machine, as a published one has."""
        return not self.train_config.get("output_dir")

    @property
    def perturbations(self) -> list[str] | None:
        """Conditions of the dataset's episodes; None if unknown."""
        return None if self.facts is None else self.facts.perturbations


@dataclass(frozen=True)
class History:
    """Trainings of a checkpoint, the oldest known one first; the last ended in the checkpoint itself."""

    trainings: tuple[Training, ...]
    parent: str | None = None  # what the oldest known training says it started from, if that is not here

    @classmethod
    def of(cls, config: Any, train_config: Mapping[str, Any], facts: DatasetFacts | None) -> "History":
        """Follow the parents that a config names, while they are on this machine."""
        last = Training(getattr(config, "trained_batches", 0), train_config, facts)
        return cls._follow(last, config.pretrained_path, config.pretrained_revision)

    @classmethod
    def read(cls, folder: Path) -> "History":
        """Read the history of a checkpoint's folder, and follow its parents likewise."""
        values, train_config = read_json(folder / CONFIG), read_train_config(folder)
        facts = DatasetFacts.find(dataset_of(train_config))
        last = Training(values.get("trained_batches", 0), train_config, facts)
        return cls._follow(last, values.get("pretrained_path"), values.get("pretrained_revision"))

    @classmethod
    def _follow(cls, last: Training, path: Any, revision: str | None) -> "History":
        trainings = [last]
        while path and (folder := _folder(str(path), revision)):
            values = read_json(folder / CONFIG)
            number = values.get("trained_batches", 0)
            if number >= trainings[0].num_batches:  # it is itself, resumed, or that folder has changed since
                break
            trainings.insert(0, _read(folder, str(path), number))
            path, revision = values.get("pretrained_path"), values.get("pretrained_revision")
        return cls(tuple(trainings), str(path) if path else None)

    @property
    def datasets(self) -> list[str]:
        """Names of the datasets, the last one first."""
        return list(dict.fromkeys(each.dataset for each in reversed(self.trainings) if each.dataset))

    @property
    def start(self) -> str | None:
        """Name of the checkpoint that the last training started from, for a command; None: it had none."""
        if len(self.trainings) > 1:
            return self.trainings[-2].name or NO_NAME
        if self._unknown_until is None:
            return None
        return (None if self.parent is None else _name(self.parent)) or NO_NAME

    @property
    def showed_only_nominal(self) -> bool:
        """Return True if every training is known, and none showed perturbed scenes."""
        return self.is_whole and all(each.perturbations == ["none"] for each in self.trainings)

    @property
    def is_whole(self) -> bool:
        """Return True if no training is unknown."""
        return self._unknown_until is None and all(each.train_config for each in self.trainings)

    @property
    def seeds(self) -> list[int] | None:
        """Seeds that the trainings' datasets show, sorted; None if those of one are unknown."""
        found = [None if each.facts is None else each.facts.seeds for each in self.trainings]
        known = [seeds for seeds in found if seeds is not None]
        return sorted(set(chain(*known))) if self.is_whole and len(known) == len(found) else None

    @property
    def _unknown_until(self) -> str | None:
        """Batches of which nothing is known, before the oldest known training; None if there are none."""
        oldest = self.trainings[0]
        before = oldest.num_before
        if before is None or before == 0:
            return None
        if before > 0:
            return f"1 to {before:,}"
        return BEFORE if self.parent is not None or oldest.is_published else None

    def table(self, on_hub: frozenset[str]) -> str:
        """Write the trainings as Markdown; `on_hub`: names of datasets that the Hub has."""
        rows = [f"| {' | '.join(row)} |" for row in (HEADER, *self._rows(on_hub))]
        return "\n".join([rows[0], "|---" * len(HEADER) + "|", *rows[1:]])

    def _rows(self, on_hub: frozenset[str]) -> Iterator[tuple[str, ...]]:
        unknown, number = self._unknown_until, 0
        if unknown is not None:
            ended = UNKNOWN
            if self.parent is not None:
                named = _name(self.parent)
                ended = code(named) if named else "a checkpoint that is not here"
            yield unknown, *[UNKNOWN] * 4, ended
            number = max(0, self.trainings[0].num_before or 0)
        for each in self.trainings:
            last = each.num_batches
            batches = f"up to {last:,}" if unknown == BEFORE else f"{number + 1:,} to {last:,}"
            unknown, number = None, last
            yield batches, *_cells(each, on_hub)


def _cells(training: Training, on_hub: frozenset[str]) -> tuple[str, ...]:
    """Return what a training says of itself, as Markdown."""
    data, settings = UNKNOWN, [UNKNOWN, UNKNOWN]
    if training.dataset is not None:
        is_there = training.dataset in on_hub
        data = code(training.dataset) + ("" if is_there else ", a name on the machine of the training")
    if training.facts is not None:
        data += f": {training.facts.count}"
    if training.train_config:
        settings = [str(training.train_config.get(name)) for name in ("batch_size", "seed")]
    if training.weights_sha256 is None:
        ended = "this checkpoint"
    else:
        name = code(training.name) if training.name else "a checkpoint without a name on the Hub"
        ended = f"{name}, SHA-256 {code(training.weights_sha256)}"
    shown = training.perturbations
    return data, UNKNOWN if shown is None else plain(", ".join(shown)), *map(plain, settings), ended


def _name(path: str) -> str | None:
    """Return the name by which other machines have a checkpoint; None if they do not have it."""
    return shipped_name(path) or (path if is_hub_id(path) else None)


def _folder(path: str, revision: str | None) -> Path | None:
    """Return a checkpoint's folder, its own or that of a download; None if it is not here."""
    file = local_file(path, revision, CONFIG) if Path(path).is_dir() or is_hub_id(path) else None
    return None if file is None else file.parent


def _read(folder: Path, path: str, num_batches: int) -> Training:
    """Read the training that a parent's folder tells of."""
    train_config = read_train_config(folder)
    facts = DatasetFacts.find(dataset_of(train_config)) if train_config else None
    found = [folder / name for name in (WEIGHTS, ADAPTERS[1]) if (folder / name).is_file()]
    sha256 = sha256_of(found[0]) if found else UNKNOWN
    return Training(num_batches, train_config, facts, _name(path), sha256)
