"""Explained moments as a recording for the viewer of Rerun: images, and over them the effects of patches."""

from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.film import CAMERA
from lerobot_bomb.explain.maps import tinted
from lerobot_bomb.explain.moment_query import camera_name
from lerobot_bomb.viewing.rerun_file import STEP, open_recording, png


def write_recording(path: Path, name: str, fps: int, moments: Sequence[ExplainedMoment]) -> None:
    """Write a new file, whose timeline has the moments at their control steps."""
    with open_recording(path, name, fps, _layout(moments[0])) as recording:
        for each in moments:
            recording.set_time(STEP, sequence=each.snapshot.step)
            recording.log("instruction", rr.TextDocument(each.snapshot.instruction), strict=True)
            recording.log("findings", rr.TextDocument("\n".join(map(str, each.findings))), strict=True)
            found = each.explanation
            for key, image in each.images.items():
                recording.log(f"image/{key}", png(image), strict=True)
                _log_marks(recording, key, each)
                effects = tinted(found.measured.patches[key].numpy(), found.largest_patch, image)
                recording.log(f"effect/{key}", png(effects), strict=True)


def _log_marks(recording: rr.RecordingStream, key: str, moment: ExplainedMoment) -> None:
    """Log the places that the policy points at and that are meant, over the image of the whole board."""
    if moment.pointing is None or camera_name(key) != CAMERA:
        return
    camera, marks = moment.snapshot.cameras[CAMERA], moment.pointing.marks
    points = rr.Points2D(
        # Rerun counts pixels from their corners, the camera from their centres
        [camera.pixel_of(mark.xyz) + 0.5 for mark in marks],
        colors=[mark.rgb for mark in marks],
        labels=[mark.name for mark in marks],
        radii=rr.Radius.ui_points(4),
    )
    recording.log(f"image/{key}/pointing", points, strict=True)


def _layout(moment: ExplainedMoment) -> rrb.ContainerLike:
    images = [
        rrb.Horizontal(
            *(rrb.Spatial2DView(origin=f"{kind}/{key}", name=f"{key}, {kind}") for key in moment.images)
        )
        for kind in ("image", "effect")
    ]
    words = [rrb.TextDocumentView(origin=entity, name=entity) for entity in ("instruction", "findings")]
    return rrb.Vertical(*images, rrb.Horizontal(*words), row_shares=[2, 2, 1])
