"""Videos of failures, beside the page that shows them."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from lerobot_bomb.report.report import Sample
from lerobot_bomb.results.record import Record, different_fields
from lerobot_bomb.viewing.episode import write_episodes
from lerobot_bomb.viewing.replay import Replay


def with_videos(samples: Iterable[Sample], folder: Path, num_of_class: int) -> Iterator[Sample]:
    """Add a video, beside the page, to the first samples of each group's classes; yield the others unchanged.

    Where an episode cannot be run again, its note says why.
    """
    numbers = Counter[tuple[str, str]]()
    for sample in samples:
        group_class = sample.group, str(sample.record.failure)
        numbers[group_class] += 1
        yield sample if numbers[group_class] > num_of_class else _with_video(sample, folder)


def _with_video(sample: Sample, folder: Path) -> Sample:
    record = sample.record
    digest = hashlib.sha256(json.dumps(record.as_json(), sort_keys=True).encode()).hexdigest()
    path = folder / f"{record.failure}-seed{record.spec.seed}-{digest[:8]}.mp4"
    try:
        different = _write_video(record, path)
    except Exception as error:  # whatever it is: the page says it in the video's place
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return replace(sample, note=f"no video: {lines[-1]}")
    note = f"not as recorded: {different[0]} differs" if different else ""
    return replace(sample, video=quote(f"{folder.name}/{path.name}"), note=note)


def _write_video(record: Record, path: Path) -> list[str]:
    """Write the video of a record's episode; return the names of fields that differ from the record."""
    recording = path.with_suffix(".rrd")
    (result,) = write_episodes({"": Replay(record).viewed_run()}, path.stem, recording, path)
    recording.unlink()
    return different_fields(record, result)
