"""Frames per second of ``lerobot-bomb record`` against LeRobot's streaming writer fed from memory.

Both write the same episodes: 2 cameras, 256x256, video. The recorder's time holds everything but
Python's imports: starting its workers, simulation, encoding, merging. The peer gets frames that are
ready in memory. Two more rows show what one encoder thread per camera and H.264 change for the peer.

    OMP_NUM_THREADS=1 python benchmarks/record_speed.py --json record_speed.json
"""

import importlib
import statistics
import tempfile
import time
from pathlib import Path

from machine import make_parser, parse_on_idle_machine, positive, print_rows, write_figures

from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.rollout_pool import Rollout, RolloutSettings, collect
from lerobot_bomb.envs.rollout import make_env

TARGET = 0.8  # of the peer's frames per second
RECORDER, PEER = "lerobot-bomb record", "LeRobot's streaming writer"
ONE_THREAD, H264 = f"{PEER}, 1 encoder thread", f"{PEER}, h264"


def main() -> None:
    """Measure in turn, print medians and ratios."""
    parser = make_parser(__doc__)
    parser.add_argument("--episodes", type=positive, default=60, help="in each run (default: 60)")
    parser.add_argument("--repeats", type=positive, default=3, help="runs of each writer (default: 3)")
    args = parse_on_idle_machine(parser)

    # not at the top: the recorder's workers import this file's head and would load torch
    importlib.import_module("lerobot_bomb.data.blocks")
    importlib.import_module("datasets").disable_progress_bars()  # one bar per episode of the peer

    recording = Recording("benchmark/bomb", args.episodes)
    rollouts = successes(recording)
    num_frames = sum(rollout.result.steps for rollout in rollouts)
    seconds: dict[str, list[float]] = {name: [] for name in (RECORDER, PEER, ONE_THREAD, H264)}
    for _ in range(args.repeats):
        for name, runs in seconds.items():
            with tempfile.TemporaryDirectory() as folder:
                root = Path(folder) / "dataset"
                started = time.perf_counter()
                if name == RECORDER:
                    record(recording, root, num_workers=1)
                else:
                    write_with_lerobot(recording, root, rollouts, name)
                runs.append(time.perf_counter() - started)

    frames_per_s = {name: num_frames / statistics.median(runs) for name, runs in seconds.items()}
    rows = {
        name: {"frames_per_s": fps, "ratio": fps / frames_per_s[PEER]} for name, fps in frames_per_s.items()
    }
    print_rows(f"{len(rollouts)} episodes, {num_frames} frames of 2 cameras, {args.repeats} runs", rows)
    ratio = rows[RECORDER]["ratio"]
    print(f"target: a ratio of at least {TARGET}: {'reached' if ratio >= TARGET else 'missed'}")
    figures = {"frames": num_frames, "frames_per_s": frames_per_s, "ratio": ratio, "target": TARGET}
    write_figures(args.json, figures)


def successes(recording: Recording) -> list[Rollout]:
    """Collect the successful rollouts that the recording will hold."""
    env = make_env(recording.suite_specs[0], recording.render_options)
    settings = RolloutSettings(recording.render_options)
    rollouts: list[Rollout] = []
    specs = recording.specs(num_tried=0)
    while len(rollouts) < recording.episodes:
        rollout = collect(env, next(specs), settings)
        if rollout.result.is_success:
            rollouts.append(rollout)
    env.close()
    return rollouts


def write_with_lerobot(recording: Recording, root: Path, rollouts: list[Rollout], variant: str) -> None:
    """Feed LeRobot's streaming writer as its own recording loop does."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    from lerobot_bomb.data.rollout_dataset import rollout_layout

    dataset = LeRobotDataset.create(
        recording.repo_id,
        fps=recording.fps,
        features=rollout_layout(recording).features,
        root=root,
        streaming_encoding=True,
        encoder_queue_maxsize=0,  # with its default of 30 it drops frames that come faster than it encodes
        encoder_threads=1 if variant == ONE_THREAD else None,
        rgb_encoder=RGBEncoderConfig(vcodec="h264") if variant == H264 else None,
        video_backend="pyav",
    )
    for rollout in rollouts:
        for step in range(rollout.result.steps):
            frame = {f"observation.images.{camera}": f[step] for camera, f in rollout.frames.items()}
            frame |= {"observation.state": rollout.states[step], "action": rollout.actions[step]}
            dataset.add_frame({**frame, "task": rollout.result.instruction})
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    main()
