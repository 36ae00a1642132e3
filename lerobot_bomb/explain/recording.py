"""Explained moments as a recording for the viewer of Rerun: images, and over them the effects of patches."""

from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.maps import overlay
from lerobot_bomb.viewing.rerun_file import STEP, open_recording, png


def write_recording(path: Path, name: str, fps: int, moments: Sequence[ExplainedMoment]) -> None:
    """Write a new file, whose timeline has the moments at their control steps."""
    with open_recording(path, name, fps, _layout(moments[0])) as recording:
        for each in moments:
            recording.set_time(STEP, sequence=each.watched.step)
            recording.log("instruction", rr.TextDocument(each.watched.instruction), strict=True)
            recording.log("findings", rr.TextDocument("\n".join(map(str, each.findings))), strict=True)
            found = each.explanation
            for key, image in each.images.items():
                recording.log(f"image/{key}", png(image), strict=True)
                effects = overlay(found.patches[key].numpy(), found.largest_patch, image)
                recording.log(f"effect/{key}", png(effects), strict=True)


def _layout(moment: ExplainedMoment) -> rrb.ContainerLike:
    images = [
        rrb.Horizontal(
            *(rrb.Spatial2DView(origin=f"{kind}/{key}", name=f"{key}, {kind}") for key in moment.images)
        )
        for kind in ("image", "effect")
    ]
    words = [rrb.TextDocumentView(origin=entity, name=entity) for entity in ("instruction", "findings")]
    return rrb.Vertical(*images, rrb.Horizontal(*words), row_shares=[2, 2, 1])
