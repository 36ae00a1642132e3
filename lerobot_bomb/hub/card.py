"""Model card of our policy types: what the checkpoint is, how to use it, how good it is, whom to cite."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from huggingface_hub import ModelCard, ModelCardData, constants
from huggingface_hub.utils import get_session, hf_raise_for_status
from lerobot import __version__ as lerobot_version
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_bomb import __version__
from lerobot_bomb.bomb.environment import SUITE, Environment
from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.checkpoints.names import is_hub_id
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.environments import env_type
from lerobot_bomb.hub.evaluations import model_index
from lerobot_bomb.hub.markdown import code, command, fenced, plain
from lerobot_bomb.hub.method import Method
from lerobot_bomb.hub.training import peft_flags, train_command
from lerobot_bomb.results.groups import Group, by_condition, groups_of
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.summary import named_counts, summarise
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
    dataset_id: str | None
    training: TrainPipelineConfig | None = None
    dataset: DatasetFacts | None = None
    results: Sequence[list[Record]] = ()  # of each results file
    license: str | None = None
    tags: list[str] = field(default_factory=list)
    adapters_of: str | None = None  # Hub id of the checkpoint that these are adapters of; None: it is whole

    def card(self) -> PolicyCard:
        """Return the card, not validated."""
        return PolicyCard(f"---\n{self._metadata().to_yaml()}\n---\n\n{self._text()}")

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

    @property
    def _groups(self) -> list[Group]:
        return [group for records in self.results for group in groups_of(records)]

    def _metadata(self) -> ModelCardData:
        license, license_name = self._license()
        return ModelCardData(
            license=license,
            license_name=license_name,
            library_name="lerobot",
            pipeline_tag="robotics",
            tags=sorted({*self.tags, "robotics", "lerobot", "lerobot_bomb", self.config.type}),
            model_name=self.config.type,
            eval_results=model_index(self._groups) or None,
            datasets=self.dataset_id,
            base_model=self.adapters_of or self.backbone,
            base_model_relation="adapter" if self.adapters_of else None,
        )

    def _license(self) -> tuple[str | None, str | None]:
        """Return licence and name: as given, else those of the backbone's weights; None if unknown."""
        if self.license is not None:
            return self.license, None
        if self.backbone == self.method.backbone:
            return self.method.backbone_license, self.method.backbone_license_name
        is_nano = getattr(self.config, "vlm_model_name", None) == NANO
        return ("apache-2.0" if is_nano else None), None

    def _text(self) -> str:
        sections = {
            "Install": self._install(),
            "Evaluate": self._evaluate(),
            "Train": self._train(),
            "In Python": self._python(),
            "Data": self._data(),
            "Results": self._results(),
            "Citation": self._citation(),
        }
        start = f"# {self.repo_id.split('/')[-1]}\n\n{self._introduction()}\n"
        return start + "".join(f"\n## {title}\n\n{text}\n" for title, text in sections.items())

    def _introduction(self) -> str:
        benchmarks = {each.benchmark(): None for records in self.results for each in records}
        if self.environment is not None:
            benchmarks = {f"BOMB, task version {self.environment.task_version}": None}
        benchmark = f" Benchmark: {', and '.join(benchmarks)}." if benchmarks else ""
        is_trained = self.adapters_of or getattr(self.config, "trained_batches") > 0  # noqa: B009  our types'
        start = "" if is_trained else " LeRobot has not trained it: it is a start, or was converted."
        return (
            f"A checkpoint of LeRobot's policy type `{self.config.type}`, which the plugin "
            f"`lerobot_policy_bomb` adds.{start} {self._weights()}{benchmark}"
            f"\n\nThe policy type: {self.method.summary}{self._methods_used()}"
        )

    def _methods_used(self) -> str:
        used = self.config.methods_used() if isinstance(self.config, ConfigWithEnvironment) else ""
        return f"\n\nMethods used in this checkpoint: {used}." if used else ""

    def _weights(self) -> str:
        if self.adapters_of:
            contents = f"these are adapters, loaded on the checkpoint `{self.adapters_of}`."
        else:
            contents = "the checkpoint holds all that it needs, so nothing else is downloaded."
        if self.method.backbone is None:
            return contents[0].upper() + contents[1:]
        return f"Backbone: {self._backbone()}; {contents}"

    def _backbone(self) -> str:
        if self.backbone is not None:
            return f"`{self.backbone}`"
        name = getattr(self.config, "vlm_model_name", None)
        return "a small one, trained from random weights" if name == NANO else "a local one"

    def _install(self) -> str:
        package = "'.[lora]'" if self.adapters_of else "."
        return (
            f"The plugin, {__version__} or newer (with LeRobot {lerobot_version}), in a checkout of "
            "lerobot_bomb:\n\n" + fenced(f"pip install {package}\nlerobot-bomb doctor")
        )

    def _evaluate(self) -> str:
        flags = self._eval_flags()
        types = [flag.partition("=")[2] for flag in flags or () if flag.startswith("--env.type=")]
        is_ours = any(env_type(each).record.has_results_path for each in types)
        results = ["--env.results_path=results.jsonl"] if is_ours else []
        line = command(
            "lerobot-eval",
            f"--policy.path={self.repo_id}",
            *(["--env.type=ENV"] if flags is None else flags),
            "--eval.n_episodes=200" if is_ours else "--eval.n_episodes=50",
            "--eval.batch_size=10",
            *results,
        )
        if flags is None:
            return f"{fenced(line)}\n\n`ENV` is an environment with the dataset's cameras, state and action."
        text = fenced(f"{line}\nlerobot-bomb results results.jsonl" if is_ours else line)
        is_open = any(flag.endswith(f"={SUITE}") for flag in flags)
        return text + f"\n\n`{SUITE}` is that of its training, which the dataset does not say." * is_open

    def _eval_flags(self) -> list[str] | None:
        """Return the flags of the environment of the training, or else of the results; None if unknown."""
        knows_suite = self.environment is not None and self.environment.task is not None
        if self.environment is not None and (knows_suite or not self.results):
            return self.environment.eval_flags()
        if self.results:
            record_type = type(self.results[0][0])
            return record_type.eval_flags([each for each in self.results[0] if type(each) is record_type])
        return None if self.dataset is None else self.dataset.eval_flags()

    def _train(self) -> str:
        notes = []
        start = self.config.pretrained_path
        as_was = "As this checkpoint was"
        if start and not is_hub_id(start):
            as_was += ", but for its start, a checkpoint that has no name on the Hub"
        if self._backbone() == "a local one":
            notes.append(
                "Its backbone came from a folder; the command starts from the type's usual one."
                if not start
                else "Its backbone came from a folder."
            )
        dataset_id = self.dataset_id or NO_REPO_ID
        fine_tune = command(
            "lerobot-train",
            f"--policy.path={self.repo_id}",
            "--policy.repo_id=USER/NEW_NAME",
            "--policy.push_to_hub=true",
            f"--dataset.repo_id={dataset_id}",
            *peft_flags(self.training),
            f"--output_dir=outputs/{self.config.type}",
        )
        return "\n\n".join(
            [
                f"{as_was}; `train_config.json` has all values:",
                fenced(train_command(self.config, self.training, dataset_id)),
                *notes,
                "From this checkpoint on:",
                fenced(fine_tune),
            ]
        )

    def _python(self) -> str:
        load = f'policy = get_policy_class("{self.config.type}").from_pretrained("{self.repo_id}")\n'
        imported = ""
        if self.adapters_of:
            imported = "from peft import PeftConfig, PeftModel\n"
            load = (
                f'base = PeftConfig.from_pretrained("{self.repo_id}")\n'
                f'policy = get_policy_class("{self.config.type}").from_pretrained(\n'
                "    base.base_model_name_or_path, revision=base.revision\n"
                ")\n"
                f'policy = PeftModel.from_pretrained(policy, "{self.repo_id}")\n'
            )
        return fenced(
            "from lerobot.policies.factory import get_policy_class, make_pre_post_processors\n"
            f"from lerobot.utils.import_utils import register_third_party_plugins\n{imported}\n"
            f"register_third_party_plugins()\n{load}"
            'device = {"device_processor": {"device": policy.config.device}}\n'
            "preprocess, postprocess = make_pre_post_processors(\n"
            f'    policy.config, "{self.repo_id}", preprocessor_overrides=device\n'
            ")\n"
            "action = postprocess(policy.select_action(preprocess(observation)))",
            "python",
        )

    def _data(self) -> str:
        lines = [f"- environment: {plain(str(self.environment))}"] if self.environment is not None else []
        lines += [f"- dataset: {code(self.dataset_id)}"] if self.dataset_id else []
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
        return fenced("\n\n".join(paper.bibtex() for paper in self.method.papers), "bibtex")


def results_table(group: Group) -> str:
    """Return Markdown: the evaluation, and a row for each condition."""
    _, *settings = group.lines()  # the policy is the checkpoint
    measures = [
        f"{measure.name} ({measure.note})" if measure.note else measure.name
        for measure in group.record_type.measures
    ]
    summaries = {condition: summarise(records) for condition, records in by_condition(group.records).items()}
    intervals = ", ".join(dict.fromkeys(summary.rate.method for summary in summaries.values()))
    columns = ["condition", f"success ({intervals})", *measures, "failures"]
    lines = [
        plain(f"{group.record_type.describe_tasks(group.records)}; {'; '.join(settings)}:"),
        "",
        f"| {' | '.join(columns)} |",
        "|---" * len(columns) + "|",
    ]
    for condition, summary in summaries.items():
        cells = [f"perturbations={condition}", str(summary.rate), *summary.measures.values()]
        lines.append(f"| {' | '.join([*cells, named_counts(summary.failures)])} |")
    return "\n".join(lines)
