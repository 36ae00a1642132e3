"""``docs/perturbations.md``, generated: every axis with its sheet, and example instructions."""

import os
from pathlib import Path

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import ALL, EACH, MAX_LEVEL, Axis
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.files import written_whole
from lerobot_bomb.tables import markdown_table

# the episode whose instructions the page quotes
SEED, TARGET, COLOR = 0, (3, 4), "black"
LEVELS = range(1, MAX_LEVEL + 1)

INTRODUCTION = f"""\
# Perturbations

How an episode may differ from the nominal one, and by how much.

```
lerobot-eval --policy.path=CHECKPOINT --env.type=bomb --eval.n_episodes=100 --eval.batch_size=10 \\
    --env.perturbations='["none","each:3","camera:2+light:3","all:1-5"]'
lerobot-bomb view --env.perturbations=camera:3 --seed=7
lerobot-bomb view gallery --axes=camera,light --seeds=2,3 --output=outputs/gallery
```

- An **axis** changes one thing only.
- A **level** is the strength of the change, from 0 (none) to {MAX_LEVEL}; `language` has five forms instead.
  The seed draws colours and directions, so its levels differ only in strength.
- A **condition** is `none`, or axes with levels, such as `camera:2+light:3`. `lerobot-eval` needs brackets
  around a list of conditions; our commands also take `none,camera:3`.
- A **range** such as `camera:1-5` draws the level from the seed, in `all:1-5` for each axis separately.
- `{ALL}:3` is one condition: every axis at level 3, except `goal_marker`, which makes the task easier.
- `{EACH}:3` stands for ten conditions, one for each axis of `{ALL}`; `{EACH}:1-5` for fifty.
- At level 5, a scripted expert still succeeds: [its rates](benchmark.md#what-an-expert-reaches).

Columns 1 to 5 of the tables are levels. [Axes of PushT and LIBERO](reference/axes.md).
"""


def write_page(path: Path, sheets: Path) -> None:
    """Write the page; it links the sheets in the folder `sheets`."""
    link = Path(os.path.relpath(sheets, path.parent)).as_posix()
    with written_whole(path) as (unfinished,):
        unfinished.write_text(page(example_instructions(), link))


def page(instructions: list[str], sheets: str) -> str:
    """Return the Markdown, with an instruction per level of `language` from 0 on and a link to the sheets."""
    sections = [axis_section(name, axis, sheets) for name, axis in AXES.items()]
    position = list(AXES).index("language")
    sections[position] += _forms(instructions)
    everything = f"## {ALL}\n\n{_image(ALL, sheets)}"
    return "\n".join([INTRODUCTION, *sections, everything])


def example_instructions() -> list[str]:
    """Return the instructions of one episode at the levels 0..5 of `language`."""
    instructions = []
    for level in (0, *LEVELS):
        spec = EpisodeSpec(SEED, target=TARGET, color=COLOR, perturbations=f"language:{level}")
        env = make_env(spec, RenderOptions(image_size=32))
        env.reset(seed=spec.seed)
        instructions.append(env.get_wrapper_attr("task_description"))
        env.close()
    return instructions


def axis_section(name: str, axis: Axis, sheets: str) -> str:
    """Write an axis' heading, what it changes by how much, and a link to its sheet."""
    return "\n".join([f"## {name}", "", summary_of(axis), "", *sizes_table(axis), _image(name, sheets)])


def summary_of(axis: Axis) -> str:
    """Return what an axis is, and what it changes."""
    return f"{axis.summary[0].upper()}{axis.summary[1:]}. Changes: {', '.join(axis.changes)}."


def sizes_table(axis: Axis) -> list[str]:
    """Return an axis's magnitudes as a table: a row for each quantity, a column for each level."""
    rows = [
        [quantity, *(f"{value:g}" for value in size.levels), size.unit, size.what]
        for quantity, size in axis.magnitudes.items()
    ]
    return markdown_table(" | ".join(["quantity", *map(str, LEVELS), "unit", "meaning"]), rows)


def _image(name: str, sheets: str) -> str:
    return f"![{name}]({sheets}/{name}.jpg)\n"


def _forms(instructions: list[str]) -> str:
    """Return the table of one goal, said in the form of each level."""
    rows = [(str(level), instruction) for level, instruction in enumerate(instructions)]
    head = "The instruction of one episode at each level:"
    return "\n".join(["", head, "", *markdown_table("level | instruction", rows)])
