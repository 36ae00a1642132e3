"""Draws the README's images: `python docs/media/render.py`."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.envs.rollout import expert_agent, play
from lerobot_env_bomb.bomb.env import BombEnv

SEED = 9  # many stones on the board
GIF_PAUSE = 8  # frames that the last image stays


def main() -> None:
    """Play one episode of the expert; write its first image and all of them as an animation."""
    folder = Path(__file__).parent
    spec = EpisodeSpec(seed=SEED)
    env = BombEnv(spec)
    images = [env.render() for _ in play(env, spec, expert_agent())]
    env.close()
    iio.imwrite(folder / "scene.png", images[0])
    frames = np.stack([*images, *[images[-1]] * GIF_PAUSE])
    iio.imwrite(folder / "episode.gif", frames[:, ::2, ::2], duration=100, loop=0)


if __name__ == "__main__":
    main()
