"""Commands of ``lerobot-bomb``: group, name, summary and two examples of each.

A command such as ``checkpoint init`` is the module ``checkpoint_init`` in this folder, with
``add_arguments`` and ``run``. The module is imported when the command is called; its own imports are neither
torch nor LeRobot.
"""

from dataclasses import dataclass, field

PROGRAM = "lerobot-bomb"
# a group; a command; an example, without the command's name
TABLE = """
Datasets and episodes
  record: record the scripted expert as a LeRobotDataset
    $ --repo_id=me/bomb --root=data/bomb --episodes=10 --env.image_size=64 --images
    $ --repo_id=me/all --root=data/all --episodes=10 --env.task=all --env.perturbations=all:1-5
  record merge: join datasets, such as demonstrations and static scenes, into one
    $ data/shown data/scenes --repo_id=me/both --root=data/both
    $ data/a data/b data/c --repo_id=me/abc
  convert pusht-zarr: make a LeRobotDataset of Diffusion Policy's PushT demonstrations
    $ pusht_cchi_v7_replay.zarr --repo_id=me/pusht --root=data/pusht
    $ pusht_cchi_v7_replay.zarr --repo_id=me/pusht8 --root=data/pusht8 --copies=7 --resume
  convert libero-hdf5: make a LeRobotDataset of LIBERO's demonstrations, TASK_demo.hdf5 or a folder of them
    $ libero_spatial --repo_id=me/libero --root=data/libero
    $ libero_spatial --repo_id=me/moves --root=data/moves --skip_noops --images
  view: run one episode, or draw a dataset's; write a recording for Rerun and a video, or a sheet
    $ --policy.path=bomb:vla0_smol
    $ --seed=9 --env.perturbations=camera:3+light:2
    $ --dataset=data/bomb --episodes=0,5,7 --output=outputs/bomb.png
  view gallery: draw every perturbation axis, or a suite's tasks
    $ --axes=camera,light --seeds=2,3
    $ --env.task=object --output=outputs/tasks
Results
  results: files written by --env.results_path as one table of rates, or their failures
    $ results.jsonl
    $ vla0_smol.jsonl fdvla.jsonl --failures
  results add: append records of LeRobot's own pusht or libero, from the output of lerobot-eval
    $ act.jsonl --policy.path=outputs/act --env.type=pusht --output_dir=outputs/eval/act
    $ results.jsonl --policy.path=me/pi05 --env.type=libero --eval.batch_size=1
      --output_dir=outputs/eval/pi05
  results actions: run lerobot-eval, and also write the executed actions to a file
    $ actions.jsonl --policy.path=outputs/act --env.type=pusht --eval.use_async_envs=false
    $ expert.jsonl --policy.type=bomb_expert --env.type=bomb --eval.n_episodes=2 --eval.batch_size=2
  results smoothness: how smooth the actions of demonstrations and evaluations are
    $ --dataset.repo_id=me/bomb --dataset.root=data/bomb
    $ --dataset.repo_id=me/bomb --dataset.root=data/bomb expert.jsonl --per_second
  compare: compare two policies on the same episodes: difference, interval, test
    $ vla0_smol.jsonl fdvla.jsonl
    $ outputs/sweep/results.jsonl --non_inferior=5
  report: write results files as one page, with tables as JSON and CSV
    $ results.jsonl
    $ vla0_smol.jsonl fdvla.jsonl --output=outputs/report.html --films=2
  export: write results files as a LaTeX table, a model-index and the Hub's .eval_results
    $ results.jsonl
    $ vla0_smol.jsonl fdvla.jsonl --output=outputs/paper
Evaluate and diagnose
  sweep: evaluate policies x tasks x conditions; resumes after a kill
    $ outputs/sweep --policies=bomb:vla0_smol,bomb:fdvla --env.type=bomb --env.perturbations=none,all:3
    $ outputs/sweep
  replay: run an episode of a results file again, bit for bit or with other perturbations
    $ results.jsonl --line=26
    $ results.jsonl --line=26 --set=camera=0,light=0
  audit: check that a policy reads, looks and repeats itself
    $ outputs/audit --policy.path=bomb:fdvla --episodes=20
    $ outputs/audit2 --policy.path=bomb:vla0_smol --policy.device=cpu --workers=2
  explain: find what a policy's actions depend on: patches, objects, words, layers, heads
    $ --policy.path=bomb:fdvla --step=3
    $ --results=results.jsonl --line=26 --output=outputs/why
  app: show policies in a browser: run, perturb, compare, explain
    $
    $ --policy.path=outputs/train/checkpoints/last/pretrained_model --port=8000
Checkpoints
  checkpoint path: print the folders of the shipped checkpoints
    $
    $ vla0_smol
  checkpoint init: write a policy before its training, as a base for adapters
    $ --policy.type=fdvla --policy.vlm_model_name=nano --dataset.repo_id=me/bomb --dataset.root=data/bomb
      --output=outputs/base
    $ --policy.type=act --policy.push_to_hub=false --dataset.repo_id=me/bomb --dataset.root=data/bomb
      --output=outputs/act
  checkpoint merge: make one checkpoint of adapters and their base
    $ --policy.path=outputs/lora/checkpoints/last/pretrained_model --output=outputs/merged
    $ --policy.path=outputs/adapters --output=outputs/whole
  checkpoint export-backbone: write its vision-language model to a folder that other policies can start from
    $ --policy.path=bomb:vla0_smol --output=outputs/backbone
    $ --policy.path=outputs/train/checkpoints/last/pretrained_model --output=outputs/trained
  checkpoint convert-spatialvla: make a checkpoint of a published SpatialVLA folder
    $ spatialvla-4b-224-sft-bridge --output=outputs/spatialvla
    $ spatialvla-4b-224-pt --statistics=bridge_orig/1.0.0 --output=outputs/pretrained
  checkpoint fit-grid: fit an action grid to a dataset; print its edges and rounding errors
    $ --dataset.repo_id=me/bomb --dataset.root=data/bomb
    $ --dataset.repo_id=me/bomb --dataset.root=data/bomb --policy.grid_distribution=uniform
      --plot=outputs/grid.png
  checkpoint offline-metrics: loss, accuracy and L1 on recorded frames, beside trivial predictors
    $ --policy.path=bomb:vla0_smol --dataset.repo_id=me/bomb --dataset.root=data/bomb --val_episodes=0-9
    $ --policy.path=outputs/act --dataset.repo_id=me/bomb --dataset.root=data/bomb --val_episodes=[0,1]
      --json=outputs/metrics.json
  push: publish a checkpoint, a recorded dataset or an environment on the Hub, with a card
    $ outputs/train/checkpoints/last/pretrained_model --repo_id=me/policy --results results.jsonl
    $ data/bomb --repo_id=me/bomb --dry_run
    $ --env.type=bomb --env.task=goal --repo_id=me/goal
  serve: run LeRobot's policy server, for a robot on another machine
    $
    $ --socket=policy.socket
Installation
  config: list the presets of lerobot-train and lerobot-eval; print or copy one
    $
    $ train_fdvla_bomb --output=train_fdvla_bomb.yaml
  demo: evaluate a shipped policy on three suites, see a failure and a success
    $
    $ --episodes=2 --output_dir=outputs/demo
  doctor: check this installation
    $
    $ dataset data/bomb
  doctor dataset: compare a dataset's statistics with all of its frames, and correct them
    $ data/bomb
    $ data/bomb --mend
"""


@dataclass(frozen=True)
class Command:
    """A command, as the overview and its own help show it."""

    group: str
    summary: str
    examples: list[str] = field(default_factory=list)  # what follows the name


def _read(table: str) -> dict[str, Command]:
    commands, group, examples = dict[str, Command](), "", list[str]()
    for line in table.strip().splitlines():
        if line.startswith("      "):  # an example goes on
            examples[-1] += f" {line.strip()}"
        elif line.startswith("    $"):
            examples.append(line[6:])
        elif line.startswith("  "):
            name, _, summary = line.strip().partition(": ")
            commands[name] = Command(group, summary)
            examples = commands[name].examples
        else:
            group = line
    return commands


COMMANDS = _read(TABLE)
# first words that are no command alone
FAMILIES = {
    "convert": ("Datasets and episodes", "make a LeRobotDataset of published demonstrations"),
    "checkpoint": ("Checkpoints", "make, measure and find checkpoints"),
}
# what earlier releases called a command
RENAMED = {
    "lines": "results add",
    "eval": "results actions",
    "smoothness": "results smoothness",
    "offline-metrics": "checkpoint offline-metrics",
    "statistics": "doctor dataset",
    "fit-grid": "checkpoint fit-grid",
    "init": "checkpoint init",
    "merge": "checkpoint merge",
    "convert-spatialvla": "checkpoint convert-spatialvla",
    "export-backbone": "checkpoint export-backbone",
    "push-dataset": "push",
    "gallery": "view gallery",
    "completion": "--completion",
}


def subcommands(word: str) -> dict[str, Command]:
    """Return the commands of two words that begin with this one."""
    return {name: command for name, command in COMMANDS.items() if name.startswith(f"{word} ")}


def overview() -> str:
    """List the first words in their groups, each with the second words that it takes."""
    words = {name: (command.group, command.summary) for name, command in COMMANDS.items() if " " not in name}
    words |= FAMILIES
    lines = []
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", f"{group}:"]
        for word in dict.fromkeys(name.partition(" ")[0] for name in COMMANDS):
            if words[word][0] == group:
                lines.append(f"  {word:<11} {words[word][1]}")
                second = ", ".join(name.partition(" ")[2] for name in subcommands(word))
                lines += [f"  {'':<11} {'' if word in FAMILIES else 'also: '}{second}"] * bool(second)
    return "\n".join([*lines, "", f"`{PROGRAM} COMMAND --help` begins with two examples."]).lstrip("\n")
