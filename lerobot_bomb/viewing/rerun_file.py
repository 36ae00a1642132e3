"""An episode as a recording for the viewer of Rerun: images, curves, words; the rest is the environment's."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.results.record import Record

APPLICATION = "lerobot_bomb"
STEP, TIME = "step", "time"  # the timelines: control steps, seconds
CURVE_RGB = ((230, 75, 60), (70, 180, 90), (80, 140, 240), (240, 180, 50))


@contextmanager
def open_recording(
    path: Path, name: str, fps: int, layout: rrb.ContainerLike
) -> Iterator[rr.RecordingStream]:
    """Open an .rrd for writing; `layout` is what the viewer shows at first."""
    recording = rr.RecordingStream(APPLICATION)
    blueprint = rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline=STEP, fps=fps),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
    recording.save(path, default_blueprint=blueprint)
    recording.send_recording_name(name)
    try:
        yield recording
    finally:
        recording.flush()
        recording.disconnect()


class EpisodeLog[SpecT, ResultT: Record](ABC):
    """Writes moments of one episode to a recording, on the timelines `step` and `time`."""

    def __init__(self, recording: rr.RecordingStream, prefix: str, spec: SpecT) -> None:
        """`prefix` stands before every entity."""
        self._recording, self._prefix = recording, prefix
        self._fps, self._curves = self._timing_and_curves(spec)
        self._instruction: str | None = None
        for entity, names in self._curves.items():
            for name, color in zip(names, CURVE_RGB, strict=False):
                self._log(f"{entity}/{name}", rr.SeriesLines(colors=[color], names=[name]), static=True)

    def add(self, moment: Moment) -> None:
        """Log one moment; with the first also what does not move, and the instruction when it changes."""
        if moment.step == 0:
            self._log_still(moment)
        self._set_step(moment.step)
        if moment.instruction != self._instruction:
            self._instruction = moment.instruction
            self._log("instruction", rr.TextDocument(moment.instruction))
        self._log_moment(moment)
        if moment.action is not None:
            self._log_values("action", moment.action)

    def add_result(self, result: ResultT) -> None:
        """Log the episode's outcome, at the last step."""
        values: Any = result
        self._set_step(values.steps)
        self._log("result", rr.TextDocument(self.describe(result)))

    @staticmethod
    @abstractmethod
    def layout(prefix: str) -> rrb.Horizontal:
        """Return the viewer's first layout of the entities with this prefix."""

    @staticmethod
    @abstractmethod
    def describe(result: ResultT) -> str:
        """Describe in one line: success or class of failure, number of steps, how far from success."""

    @staticmethod
    @abstractmethod
    def _timing_and_curves(spec: SpecT) -> tuple[int, Mapping[str, Sequence[str]]]:
        """Return control steps per second, and {entity: names of its values}."""

    @abstractmethod
    def _log_still(self, moment: Moment) -> None:
        """Log everything that does not move, from the first moment."""

    @abstractmethod
    def _log_moment(self, moment: Moment) -> None:
        """Log the observation; the caller sets the time and logs the action."""

    def _log(self, entity: str, what: rr.AsComponents, static: bool = False) -> None:
        self._recording.log(f"{self._prefix}{entity}", what, static=static, strict=True)

    def _log_values(self, entity: str, values: np.ndarray) -> None:
        for name, value in zip(self._curves[entity], values, strict=True):
            self._log(f"{entity}/{name}", rr.Scalars(float(value)))

    def _set_step(self, step: int) -> None:
        self._recording.set_time(STEP, sequence=step)
        self._recording.set_time(TIME, duration=step / self._fps)


def text_views(prefix: str, *entities: str) -> list[rrb.TextDocumentView]:
    """Return a view for each entity's text, which stays until the next."""
    return [rrb.TextDocumentView(origin=f"{prefix}{entity}", name=entity) for entity in entities]


def curve_views(prefix: str, *entities: str) -> list[rrb.TimeSeriesView]:
    """Return a view for the curves below each entity."""
    return [rrb.TimeSeriesView(origin=f"{prefix}{entity}", name=entity) for entity in entities]


def describe_outcome(is_success: bool, failure: str | None, steps: int) -> str:
    """Describe as 'success after 20 steps', 'failed: dropped after 20 steps'."""
    return f"{'success' if is_success else f'failed: {failure}'} after {steps} steps"


def png(image: np.ndarray) -> rr.EncodedImage:
    """Encode (H, W, 3) uint8 without loss, in a third of its size."""
    _, content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return rr.EncodedImage(contents=content.tobytes(), media_type="image/png")
