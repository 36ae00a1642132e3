"""Effects of patches as colours, for people.

Shapes: `G` cells along a side of a grid, `H`, `W` of an image in pixels.
"""

import base64

import cv2
import numpy as np

HEAT_SHARE = 0.6  # of an overlay that is the map


def heat(values: np.ndarray, largest: float) -> np.ndarray:
    """(H, W) -> (H, W, 3) uint8 RGB, dark at 0 and below, bright at the largest, in Cividis' colours."""
    scaled = np.clip(values / largest, 0, 1) if largest > 0 else np.zeros_like(values)
    colors = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    return cv2.cvtColor(colors, cv2.COLOR_BGR2RGB)


def cells(map_GG: np.ndarray, largest: float, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8, each cell in one colour."""
    return cv2.resize(heat(map_GG, largest), (width, height), interpolation=cv2.INTER_NEAREST)


def overlay(map_GG: np.ndarray, largest: float, image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8, the map interpolated over the image."""
    height, width = image.shape[:2]
    smooth = cv2.resize(map_GG.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.addWeighted(heat(smooth, largest), HEAT_SHARE, image, 1 - HEAT_SHARE, 0)


def png_bytes(image: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 RGB as a PNG file."""
    _, content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return content.tobytes()


def data_url(image: np.ndarray) -> str:
    """Encode (H, W, 3) uint8 RGB as the URL of an image in a page."""
    return f"data:image/png;base64,{base64.b64encode(png_bytes(image)).decode()}"
