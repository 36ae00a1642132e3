"""Orientation of LIBERO's images, one of four, relative to what its environment shows.

No dataset or checkpoint states it. LeRobot's environment turns the simulator's images by 180 degrees, and a
policy that was trained on others fails without an error.
"""

import numpy as np

SAME = "as the environment shows them"
# steps over rows and columns
ORIENTATIONS = {
    SAME: (1, 1),
    "turned by 180 degrees, as the simulator gives them": (-1, -1),
    "upside down": (-1, 1),
    "left and right swapped": (1, -1),
}


def orientation(images: np.ndarray, shown: np.ndarray) -> str:
    """Return the orientation of images (N, H, W, 3), a key of `ORIENTATIONS`.

    It is relative to the environment's images ``shown`` (M, H, W, 3). Both are of one camera and one task, of
    any moments, because their means are compared.

    Raises:
        ValueError: the images differ in size.
    """
    if images.shape[1:] != shown.shape[1:]:
        raise ValueError(
            f"the images are {images.shape[1:]}, the environment's {shown.shape[1:]}; give it the flags "
            "--env.observation_height and --env.observation_width"
        )
    mean, expected = images.mean(axis=0), shown.mean(axis=0)
    distances = {
        name: np.abs(mean[::rows, ::columns] - expected).mean()
        for name, (rows, columns) in ORIENTATIONS.items()
    }
    return min(distances, key=lambda name: distances[name])
