"""Draws the README's images: `python docs/media/render.py`."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.envs.rollout import expert_agent, run_episode
from lerobot_env_bomb.bomb.env import BombEnv

SEED = 9  # many stones on the board
SO101_STEP = 13  # with the stone over the board
GIF_PAUSE = 8  # frames that the last image stays


def episode_images(robot: str) -> list[np.ndarray]:
    """Return the images of one episode of the expert, each (H, W, 3) uint8."""
    spec = EpisodeSpec(seed=SEED, robot=robot)
    env = BombEnv(spec)
    images = [env.render() for _ in run_episode(env, spec, expert_agent())]
    env.close()
    return images


def main() -> None:
    """Play an episode of the expert; write its first image, all as an animation, and one of SO-101."""
    folder = Path(__file__).parent
    images = episode_images("scara")
    iio.imwrite(folder / "so101.jpg", episode_images("so101")[SO101_STEP], quality=88)
    iio.imwrite(folder / "scene.png", images[0])
    frames = np.stack([*images, *[images[-1]] * GIF_PAUSE])
    iio.imwrite(folder / "episode.gif", frames[:, ::2, ::2], duration=100, loop=0)


if __name__ == "__main__":
    main()
