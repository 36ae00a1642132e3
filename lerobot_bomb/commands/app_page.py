"""The page of ``lerobot-bomb app``: what a visitor chooses, and what is shown."""

import html
from dataclasses import replace
from functools import partial
from typing import Any

import gradio as gr
from gradio.themes import Default

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.episode import MAX_SEED, TEST_SEEDS
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.checkpoints.shipped import shipped_names
from lerobot_bomb.commands.app_runs import DRAWN, SUITE_WITH_TARGETS, Choice, Commands
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.results.names import SHIPPED_PREFIX
from lerobot_bomb.viewing.episode import EXPERT

AXES_IN_A_ROW = 4
SAME_CLEAN = "the same policy, unperturbed"
VIDEO_HEIGHT = 300  # in pixels
FIRST_LEVELS = {"camera": 3}  # so that the two first episodes differ
# fonts of the visitor's machine: nothing is loaded from others
THEME = Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])
ONE_AT_A_TIME: dict[str, Any] = {"concurrency_limit": 1, "concurrency_id": "simulator"}
TITLE = """# BOMB
A policy puts Go stones where an instruction says. Turn perturbations on, and see what happens."""


def describe_run(text: str) -> str:
    """Return instruction and outcome, which `view` prints before the names of its files, as Markdown."""
    lines = [line for line in text.splitlines() if line and not line.endswith((".mp4", ".rrd"))]
    instruction, outcome = map(html.escape, lines[-2:])
    return f"*{instruction}*\n\n**{outcome}**"


def choice_of(
    policy: str | None, suite: str, seed: float | None, row: str, column: str, color: str, *levels: float
) -> Choice:
    """Return what the page's fields hold, in their order.

    Raises:
        ValueError: the seed is no whole number.
    """
    if seed is None or seed != int(seed):
        raise ValueError(f"seed {seed} must be a whole number in 0..{MAX_SEED}")
    numbers = dict(zip(AXES, map(int, levels), strict=True))
    return Choice((policy or "").strip(), suite, int(seed), row, column, color, numbers)


def run_both(commands: Commands, other: str | None, *values: Any) -> list[str]:
    """Run the chosen episode and the one beside it; return video, outcome and command of each."""
    first = choice_of(*values)
    second = (
        replace(first, levels={}) if other == SAME_CLEAN else replace(first, policy=(other or "").strip())
    )
    shown = [commands.view(each) for each in (first, second)]
    return [text for each in shown for text in (str(each.file), describe_run(each.text), each.command)]


def explain_first(commands: Commands, *values: Any) -> list[str]:
    """Explain the chosen episode; return the page, framed, and the command."""
    shown = commands.explain(choice_of(*values))
    content = html.escape(shown.file.read_text())
    style = "width: 100%; height: 900px; border: 0; background: white"
    return [f'<iframe title="explanation" style="{style}" srcdoc="{content}"></iframe>', shown.command]


def command_box(label: str) -> gr.Textbox:
    """Return a field for a command line."""
    return gr.Textbox(label=label, lines=2, interactive=False, buttons=["copy"])


def app_page(commands: Commands, first_policy: str) -> gr.Blocks:
    """Build the page."""
    shipped = [f"{SHIPPED_PREFIX}{name}" for name in shipped_names()]
    policies = [*dict.fromkeys([first_policy, *shipped, EXPERT])]
    lines = [DRAWN, *map(str, range(BOARD.num_lines))]
    with gr.Blocks(title="BOMB", analytics_enabled=False) as blocks:
        gr.Markdown(TITLE)
        with gr.Row():
            about = "Policy: bomb:NAME, a folder, USER/NAME on the Hub, or expert"
            policy = gr.Dropdown(policies, value=first_policy, allow_custom_value=True, label=about)
            beside = [SAME_CLEAN, *policies]
            other = gr.Dropdown(
                beside, value=SAME_CLEAN, allow_custom_value=True, label="Beside it, same seed"
            )
            suite = gr.Dropdown([*OWN_SUITES], value=SUITE_WITH_TARGETS, label="Suite")
            seed = gr.Number(TEST_SEEDS[0], precision=0, minimum=0, maximum=MAX_SEED, label="Seed")
        with gr.Row() as targets:
            row = gr.Dropdown(lines, value=DRAWN, label="Row (0: far)")
            column = gr.Dropdown(lines, value=DRAWN, label="Column (0: left)")
            color = gr.Dropdown([DRAWN, *COLORS], value=DRAWN, label="Stone")
        suite.change(lambda name: gr.Row(visible=name == SUITE_WITH_TARGETS), suite, targets)
        with gr.Accordion("Perturbations: level of each axis"):
            sliders = []
            for start in range(0, len(AXES), AXES_IN_A_ROW):
                with gr.Row():
                    sliders += [
                        gr.Slider(
                            0, MAX_LEVEL, value=FIRST_LEVELS.get(axis, 0), step=1, label=axis, min_width=120
                        )
                        for axis in [*AXES][start : start + AXES_IN_A_ROW]
                    ]
        with gr.Row():
            run_button = gr.Button("Run both episodes", variant="primary")
            why_button = gr.Button("Explain the first (one to two minutes)")
        shown = []
        with gr.Row():
            for side in ("First", "Beside it"):
                with gr.Column():
                    shown += [
                        gr.Video(label=side, height=VIDEO_HEIGHT, autoplay=True, interactive=False),
                        gr.Markdown(),
                        command_box("The same as a command"),
                    ]
        explanation = [
            gr.HTML(),
            command_box("The explanation as a command"),
        ]
        chosen = [policy, suite, seed, row, column, color, *sliders]

        def told(act: Any, *values: Any) -> list[str]:
            """Call a function; its errors become a notice on the page."""
            try:
                return act(commands, *values)
            except (ValueError, RuntimeError, OSError) as error:
                raise gr.Error(html.escape(str(error)), duration=None, print_exception=False) from None

        run_button.click(partial(told, run_both), [other, *chosen], shown, api_name="run", **ONE_AT_A_TIME)
        why_button.click(
            partial(told, explain_first), chosen, explanation, api_name="explain", **ONE_AT_A_TIME
        )
    return blocks.queue(max_size=20)
