"""Effects of patches as colours, for people.

Shapes: `G` cells along a side of a grid, `H`, `W` of an image in pixels.
"""

import base64

import cv2
import numpy as np

TINT_RGB = (213, 94, 0)  # seen by the colour-blind (Okabe and Ito)
STRENGTH = 0.75  # of the tint where the effect is largest


def strength(effect: float, largest: float) -> float:
    """Return how strongly an effect is coloured: 0 for none or a negative one, STRENGTH for the largest."""
    return STRENGTH * min(max(effect / largest, 0.0), 1.0) if largest > 0 else 0.0


def tinted(map_GG: np.ndarray, largest: float, image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the image, each cell of the map the more tinted the larger its effect."""
    shares = STRENGTH * np.clip(map_GG / largest, 0, 1) if largest > 0 else np.zeros_like(map_GG)
    height, width = image.shape[:2]
    size = (width, height)
    shares_HW = cv2.resize(shares.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)[..., None]
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    return ((1 - shares_HW) * grey + shares_HW * np.array(TINT_RGB)).round().astype(np.uint8)


def png_bytes(image: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 RGB as a PNG file."""
    _, content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return content.tobytes()


def data_url(image: np.ndarray) -> str:
    """Encode (H, W, 3) uint8 RGB as the URL of an image in a page."""
    return f"data:image/png;base64,{base64.b64encode(png_bytes(image)).decode()}"
