"""Videos and filmstrips of failures: videos beside the page that shows them, filmstrips in it."""

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
from lerobot_bomb.viewing.film import as_jpeg, run_filmed
from lerobot_bomb.viewing.replay import Replay


def with_pictures(
    samples: Iterable[Sample], folder: Path, num_films: int, num_videos: int
) -> Iterator[Sample]:
    """Add pictures to the first samples of each group's classes; yield the others unchanged.

    The first `num_videos` of a class get a video in `folder` and a filmstrip, those up to `num_films` a
    filmstrip alone. Where an episode cannot be run again, its note says why.
    """
    numbers = Counter[tuple[str, str]]()
    for sample in samples:
        group_class = sample.group, str(sample.record.failure)
        numbers[group_class] += 1
        number = numbers[group_class]
        yield sample if number > max(num_films, num_videos) else _run(sample, folder, number <= num_videos)


def _run(sample: Sample, folder: Path, has_video: bool) -> Sample:
    """Run a sample's episode again, and return the sample with its pictures."""
    record = sample.record
    path = folder / _file_name(record) if has_video else None
    try:
        run = Replay(record).viewed_run()
        if path is None:
            result, film = run_filmed(run)
        else:
            recording = path.with_suffix(".rrd")
            ((result, film),) = write_episodes({"": run}, path.stem, recording, path, with_films=True)
            recording.unlink()
    except Exception as error:  # whatever it is: the page says it in the pictures' place
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return replace(sample, note=f"no {'video' if has_video else 'filmstrip'}: {lines[-1]}")
    different = different_fields(record, result)
    note = f"not as recorded: {different[0]} differs" if different else ""
    video = None if path is None else quote(f"{folder.name}/{path.name}")
    return replace(sample, video=video, film=None if film is None else as_jpeg(film), note=note)


def _file_name(record: Record) -> str:
    digest = hashlib.sha256(json.dumps(record.as_json(), sort_keys=True).encode()).hexdigest()
    return f"{record.failure}-seed{record.spec.seed}-{digest[:8]}.mp4"
