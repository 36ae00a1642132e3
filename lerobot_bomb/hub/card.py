"""Model card of our policy types: what the checkpoint is, how good it is, how to use it, whom to cite."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from huggingface_hub import ModelCard, ModelCardData, constants
from huggingface_hub.utils import get_session, hf_raise_for_status
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.checkpoints.names import is_hub_id
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.hub.evaluations import model_index
from lerobot_bomb.hub.history import NO_NAME, History
from lerobot_bomb.hub.limits import limits
from lerobot_bomb.hub.markdown import code, command, fenced, plain
from lerobot_bomb.hub.method import BOMB, Method
from lerobot_bomb.hub.rates import FIGURE, headline, rates_chart, results_table
from lerobot_bomb.hub.training import peft_flags, train_command
from lerobot_bomb.hub.usage import how_to_use, in_python
from lerobot_bomb.report.chart import Chart, standalone
from lerobot_bomb.results.groups import Group, groups_of
from lerobot_bomb.results.record import Record
from lerobot_bomb.vlm.tokenizer import NANO

NO_REPO_ID = "USER/NAME"
BAD_REQUEST = 400


class PolicyCard(ModelCard):
    """A model card that is validated by the Hub in use, public or not."""

    def validate(self, repo_type: str | None = None) -> None:
        """Validate at HF_ENDPOINT; huggingface_hub's own method always asks the public Hub.

        Raises:
            ValueError: the Hub does not take the card's metadata.
        """
        response = get_session().post(
            f"{constants.ENDPOINT}/api/validate-yaml",
            json={"repoType": repo_type or self.repo_type, "content": str(self)},
            headers={"Accept": "text/plain"},
        )
        if response.status_code == BAD_REQUEST:
            raise ValueError(response.text)
        hf_raise_for_status(response)


@dataclass(frozen=True)
class Checkpoint:
    """Checkpoint with everything that its card tells."""

    config: PreTrainedConfig
    method: Method
    repo_id: str
    training: TrainPipelineConfig | None = None
    dataset: DatasetFacts | None = None
    results: Sequence[list[Record]] = ()  # of each results file
    license: str | None = None
    tags: list[str] = field(default_factory=list)
    adapters_of: str | None = None  # Hub id of the checkpoint that these are adapters of; None: it is whole
    num_parameters: int | None = None  # of the adapters, if they are some; None: not counted
    on_hub: frozenset[str] = frozenset()  # names of trainings' datasets that the Hub has

    def card(self) -> PolicyCard:
        """Return the card, not validated."""
        return PolicyCard(f"---\n{self._metadata().to_yaml()}\n---\n\n{self._text()}")

    def figure(self) -> bytes | None:
        """Return the SVG that the card shows; None if it has no rates."""
        return standalone(self._chart.svg).encode() if self.results else None

    @cached_property
    def history(self) -> History:
        """Trainings of the checkpoint, as far as files here tell."""
        values = {} if self.training is None else self.training.to_dict()
        return History.of(self.config, values, self.dataset)

    @property
    def environment(self) -> Environment | None:
        """Environment that the checkpoint was trained for, by its config or else by its dataset."""
        of_dataset = None if self.dataset is None else self.dataset.environment
        return getattr(self.config, "environment", None) or of_dataset

    @property
    def backbone(self) -> str | None:
        """Hub id of the backbone; None if there is none, or its id is unknown."""
        name = getattr(self.config, "vlm_model_name", None)
        return name if name and is_hub_id(name) else None

    @cached_property
    def _groups(self) -> list[Group]:
        return [group for records in self.results for group in groups_of(records)]

    def _metadata(self) -> ModelCardData:
        license, license_name = self._license()
        datasets = [name for name in self.history.datasets if name in self.on_hub]
        return ModelCardData(
            license=license,
            license_name=license_name,
            library_name="lerobot",
            pipeline_tag="robotics",
            tags=sorted({*self.tags, "robotics", "lerobot", "lerobot_bomb", self.config.type}),
            model_name=self.config.type,
            eval_results=model_index(self._groups) or None,
            datasets=datasets or None,
            base_model=self.adapters_of or self.backbone,
            base_model_relation="adapter" if self.adapters_of else None,
        )

    def _license(self) -> tuple[str | None, str | None]:
        """Return licence and name: as given, else those of the backbone's weights; None if unknown."""
        if self.license is not None:
            return self.license, None
        if self.backbone == self.method.backbone:
            return self.method.backbone_license, self.method.backbone_license_name
        return ("apache-2.0" if self._is_small else None), None

    @property
    def _is_small(self) -> bool:
        """Return True if the backbone is the small one, whose weights are random at first."""
        return getattr(self.config, "vlm_model_name", None) == NANO

    def _text(self) -> str:
        sections = {
            "Use": how_to_use(self.repo_id, self._eval_flags(), self.adapters_of is not None),
            "Results": self._results(),
            "What it cannot do": self._limits(),
            "Training": self._training(),
            "Data": self._data(),
            "In Python": in_python(self.config.type, self.repo_id, self.adapters_of is not None),
            "Citation": self._citation(),
        }
        start = f"# {self.repo_id.split('/')[-1]}\n\n{self._introduction()}\n"
        return start + "".join(f"\n## {title}\n\n{text}\n" for title, text in sections.items())

    def _introduction(self) -> str:
        benchmarks = {each.benchmark(): None for records in self.results for each in records}
        if self.environment is not None:
            benchmarks = {f"BOMB, task version {self.environment.task_version}": None}
        benchmark = f" Benchmark: {plain(', '.join(benchmarks))}." if benchmarks else ""
        paragraphs = [
            f"A checkpoint of LeRobot's policy type `{self.config.type}`, which the plugin "
            f"`lerobot_policy_bomb` adds{self._size()}. {self._weights()}{benchmark}",
            *(f"Success on {headline(group)}" for group in self._groups),
            *self._figure_text(),
            f"The policy type: {self.method.summary}{self._methods_used()}",
        ]
        return "\n\n".join(paragraphs)

    @cached_property
    def _chart(self) -> Chart:
        return rates_chart(self._groups)

    def _figure_text(self) -> list[str]:
        """Return the figure and its note, as Markdown; [] without rates."""
        if not self._groups:
            return []
        image = f"![Success by condition, as in the table below]({FIGURE})"
        return [image, plain(self._chart.note)]

    def _size(self) -> str:
        if self.num_parameters is None:
            return ""
        return f", with {self.num_parameters:,} parameters{' in adapters' if self.adapters_of else ''}"

    def _methods_used(self) -> str:
        used = self.config.methods_used() if isinstance(self.config, ConfigWithEnvironment) else ""
        return f"\n\nMethods used in this checkpoint: {plain(used)}." if used else ""

    def _weights(self) -> str:
        """Say where the weights come from, and what else must be downloaded."""
        if self.adapters_of:
            contents = f"these are adapters, loaded on the checkpoint {code(self.adapters_of)}."
        else:
            contents = "the checkpoint holds all that it needs, so nothing else is downloaded."
        if self.method.backbone is None:
            return contents[0].upper() + contents[1:]
        return f"Backbone: {self._backbone()}; {contents}"

    def _backbone(self) -> str:
        if self.backbone is not None:
            return code(self.backbone)
        if not self._is_small:
            return "a local one"
        return f"a small one, {'trained from random weights' if self._is_trained else 'of random weights'}"

    @property
    def _is_trained(self) -> bool:
        return bool(self.adapters_of or getattr(self.config, "trained_batches", 0) > 0)

    def _eval_flags(self) -> list[str] | None:
        """Return the flags of the environment of the training, or else of the results; None if unknown."""
        knows_suite = self.environment is not None and self.environment.task is not None
        if self.environment is not None and (knows_suite or not self.results):
            return self.environment.eval_flags()
        if self.results:
            record_type = type(self.results[0][0])
            return record_type.eval_flags([each for each in self.results[0] if type(each) is record_type])
        return None if self.dataset is None else self.dataset.eval_flags()

    def _limits(self) -> str:
        found = limits(self.environment, self.history, self._groups, self._is_small and self._is_trained)
        return "\n".join(f"- {each}" for each in found)

    def _training(self) -> str:
        """Tell the trainings, the command of the last one, and how to train on."""
        parts = [self._start()]
        if self._is_trained:
            parts.append(f"The trainings, the oldest first:\n\n{self.history.table(self.on_hub)}")
        dataset = next((name for name in self.history.datasets[:1] if name in self.on_hub), NO_REPO_ID)
        if self.training is not None:
            parts += self._last_training(self.training, dataset)
        fine_tune = command(
            "lerobot-train",
            f"--policy.path={self.repo_id}",
            "--policy.repo_id=USER/NEW_NAME",
            "--policy.push_to_hub=true",
            f"--dataset.repo_id={dataset}",
            *peft_flags(self.training),
            f"--output_dir=outputs/{self.config.type}",
        )
        return "\n\n".join([*filter(None, parts), "To train on from this checkpoint:", fenced(fine_tune)])

    def _start(self) -> str:
        if not self._is_trained:
            return "LeRobot has not trained it: it is a start, or was converted."
        if self.method.backbone is None:
            return ""
        if self._is_small:
            return "All weights were random before the first training."
        return f"Before the first training, its vision-language model was {self._backbone()}."

    def _last_training(self, training: TrainPipelineConfig, dataset: str) -> list[str]:
        """Return the command, and what stands in it for names that only one machine knows."""
        start, notes = self.history.start, []
        if start == NO_NAME:
            notes.append(f"`{NO_NAME}` stands for the checkpoint before, which has no name on the Hub.")
        if start is None and self._backbone() == "a local one":
            notes.append("Its backbone came from a folder; the command starts from the type's usual one.")
        if dataset == NO_REPO_ID:
            notes.append(f"`{NO_REPO_ID}` stands for its dataset, which is not known to be on the Hub.")
        trained = fenced(train_command(self.config, training, start, dataset))
        told = ["The command of the last training; `train_config.json` has all values:", trained]
        return [*told, " ".join(notes)]

    def _data(self) -> str:
        lines = [f"- environment: {plain(str(self.environment))}"] if self.environment is not None else []
        lines += map(plain, self.dataset.lines() if self.dataset is not None else [])
        features = {**(self.config.input_features or {}), **(self.config.output_features or {})}
        rows = [
            f"| {code(name)} | {each.type.value} | {tuple(each.shape)} |" for name, each in features.items()
        ]
        return "\n".join([*lines, "", "| feature | type | shape |", "|---|---|---|", *rows]).lstrip("\n")

    def _results(self) -> str:
        if not self.results:
            return "No evaluation is attached to this checkpoint."
        return "\n\n".join(map(results_table, self._groups))

    def _citation(self) -> str:
        return fenced("\n\n".join(paper.bibtex() for paper in (BOMB, *self.method.papers)), "bibtex")
