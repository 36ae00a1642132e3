"""An OpenGL context belongs to one process and one thread."""

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.render import CAPTION_BACKGROUND, CAPTION_MARGIN_PX, compose_caption

SMALL = RenderOptions(image_size=32)
STILL = np.zeros(4, dtype=np.float32)
HANGS_AFTER_S = 60

AFTER_RENDERING = """
import functools, gc, os, sys, threading
import gymnasium
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_env_bomb.bomb.env import BombEnv

make = functools.partial(BombEnv, EpisodeSpec(seed=0), RenderOptions(image_size=32))
env = make()
env.reset()
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    """Run it after an environment has rendered; fail, and end all its processes, where it hangs."""
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", AFTER_RENDERING + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        output, errors = process.communicate(timeout=HANGS_AFTER_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail(f"it hangs; so far: {process.communicate()}")
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def test_forked_workers_are_told_how_to_start_instead() -> None:
    finished = run("""
env.close()
envs = gymnasium.vector.AsyncVectorEnv([make] * 2, context="fork")
try:
    envs.reset(seed=[1, 2])
except RuntimeError as error:
    print(error)
envs.close(terminate=True)
""")
    assert "rendered; OpenGL does not survive a fork and would hang" in finished.stdout, finished.stderr
    assert "AsyncVectorEnv(..., context='forkserver')" in finished.stdout


def test_a_forked_process_neither_draws_nor_frees_what_it_inherits() -> None:
    finished = run("""
child = os.fork()
if not child:
    try:
        env.step([0, 0, 0, 0])
    except RuntimeError as error:
        print(error, flush=True)
    del env
    gc.collect()
    sys.exit()
_, status = os.waitpid(child, 0)
env.step([0, 0, 0, 0])
env.close()
print("status", status)
""")
    assert "does not survive a fork" in finished.stdout, finished.stderr
    assert "status 0" in finished.stdout and finished.stderr == ""


def test_a_process_exits_silently_after_the_thread_that_drew() -> None:
    finished = run("""
other = make()
threading.Thread(target=other.reset).start()
""")
    assert (finished.returncode, finished.stderr) == (0, "")


def in_another_thread(function) -> Exception | None:
    """Return what a function raises in another thread."""
    raised = []

    def call() -> None:
        try:
            function()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=call, name="helper")
    thread.start()
    thread.join()
    return raised[0] if raised else None


def test_another_thread_is_told_which_one_the_environment_belongs_to() -> None:
    env = BombEnv(EpisodeSpec(seed=0), SMALL)
    env.reset()
    for use in (lambda: env.step(STILL), env.render, env.reset, env.close):
        error = in_another_thread(use)
        assert isinstance(error, RuntimeError) and "'MainThread'" in str(error) and "'helper'" in str(error)
    assert env.reset(seed=1)[1]["seed"] == 1
    env.close()


def test_a_long_caption_is_written_smaller_and_none_of_it_is_cut_off() -> None:
    image = np.zeros((384, 384, 3), dtype=np.uint8)
    longer = compose_caption([image, image], ["one thing is asked for: " * 6 + "please"])
    cut = compose_caption([image, image], ["one thing is asked for: " * 6])
    assert longer.shape == cut.shape == (384 + 26 + 8, 768, 3)
    assert (longer[384:, -CAPTION_MARGIN_PX:] == CAPTION_BACKGROUND).all(), "the margin at the right"
    assert (longer != cut).any()
