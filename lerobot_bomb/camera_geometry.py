"""Flat observation keys that tell a camera's geometry: depth, intrinsics, extrinsics.

numpy only, as `schema`. A policy sees them under `observation.`: ``observation.depth.workspace``.
"""

from lerobot_bomb.schema import CAMERAS, RenderOptions


def geometry_shapes(options: RenderOptions) -> dict[str, tuple[int, int]]:
    """Shape of each float32 array by its key in the environment's observation; {} without depth.

    ``depth.CAMERA`` (H, W): metres along the optical axis.
    ``intrinsics.CAMERA`` (3, 3): pixels of this image; the centre of the top left pixel is (0, 0).
    ``extrinsics.CAMERA`` (4, 4): world_from_camera in metres; camera axes x right, y down, z forward.
    """
    if not options.depth:
        return {}
    shapes = {"depth": (options.image_size, options.image_size), "intrinsics": (3, 3), "extrinsics": (4, 4)}
    return {f"{kind}.{camera}": shape for kind, shape in shapes.items() for camera in CAMERAS}
